"""``lexsplat edit``: steps by words, undone, saved and discarded."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.command_line import Terminal, fails_in_one_line, modified

from lexsplat import cli, open_scene
from lexsplat.cli.waiting import LateProgress
from lexsplat.queries.visibility import with_remains
from lexsplat.scenes import editing
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.scale import store_world
from lexsplat.scenes.unsaved import unsaved_steps


def without_texts(times):
    """Without the cache of texts, which every question may add to."""
    return {name: time for name, time in times.items() if not name.startswith("checkpoints/texts/")}


def test_an_edit_is_undone_redone_and_saved_and_the_new_scene_answers(built, tiny_capture, tmp_path, capsys):
    copy, saved = tmp_path / "copy", tmp_path / "saved"
    shutil.copytree(built, copy)
    before = without_texts(modified(copy))
    original = open_scene(built, device="cpu")
    answering = original.scores(["blue ball"])[0] >= 0.05
    found = original.find("blue ball", threshold=0.05)  # without the strays that belong to no thing
    rest = ~with_remains(found, original.hidden, original.field.segments).mask
    assert not (rest & found.mask).any()
    assert 20 < int((~rest).sum()) < len(rest) / 2
    strays = int((answering & rest).sum())
    assert strays < 0.3 * int(answering.sum())
    everything = f"{len(rest):,} Gaussians"

    def edit(*arguments: str) -> str:
        capsys.readouterr()
        assert cli.main(["edit", str(copy), *arguments]) == 0
        return capsys.readouterr().out.splitlines()[-1]

    less = f"{int(rest.sum()):,} Gaussians"
    delete = ("delete", "--select", "blue ball", "--threshold", "0.05", "--no-fill")
    assert edit(*delete) == f"{less}, 0 steps undone"
    assert edit("undo") == f"{everything}, 1 step undone"
    assert edit("redo") == f"{less}, 0 steps undone"
    edit("save", "--output", str(saved))
    assert edit("discard", "--yes") == f"{everything}, 0 steps undone"
    assert without_texts(modified(copy)) == before, "the scene itself stays as it was built"

    arguments = [
        "query",
        str(saved),
        "red apple",
        "blue ball",
        "--view",
        "view_06.png",
        "--threshold",
        "0.05",
        "--json",
    ]
    assert cli.main([*arguments, "--output", str(tmp_path / "answers")]) == 0
    prompts = json.loads(capsys.readouterr().out)["prompts"]
    assert [prompt["prompt"] for prompt in prompts] == ["red apple", "blue ball"]
    reopened = open_scene(saved, device="cpu")
    assert np.array_equal(reopened.gaussians.means, original.gaussians.means[rest])
    assert np.array_equal(reopened.field.code_probabilities(), original.field.code_probabilities()[rest])


def test_the_journal_holds_the_motions_of_the_command_line(built, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    thing = ("--select", "blue ball", "--threshold", "0.05", "--largest")
    motion = ("--by", "0.5", "0", "0.25", "--turn", "90", "--scale", "1.5")
    assert cli.main(["edit", str(copy), "move", *thing, *motion]) == 0
    assert cli.main(["edit", str(copy), "duplicate", *thing, "--by", "0", "0", "1"]) == 0
    _, moved, copied = map(json.loads, (copy / "edits.jsonl").read_text().splitlines())
    assert moved["step"] == "move"
    lift = np.array(moved["translation"]) - [0.5, 0.0, 0.25]
    up = open_scene(copy, device="cpu").world.up.direction
    assert lift @ up == pytest.approx(np.linalg.norm(lift)), "what stands on something stands there enlarged"
    assert 0 < np.linalg.norm(lift) < 1
    assert moved["scale"] == 1.5
    turn = np.array(moved["rotation"])
    assert np.trace(turn) == pytest.approx(1)  # 1 + 2 cos 90 degrees
    assert copied["step"] == "duplicate"
    assert copied["translation"] == [0.0, 0.0, 1.0]
    assert np.array(copied["rotation"]) == pytest.approx(np.eye(3))
    assert "2. duplicate blue ball" in capsys.readouterr().out


def test_lengths_with_units_are_meters_where_the_scale_is_known_and_refused_elsewhere(
    built, tmp_path, capsys
):
    copy = shutil.copytree(built, tmp_path / "scene")
    thing = ("--select", "blue ball", "--threshold", "0.05")
    command = ["edit", str(copy), "duplicate", *thing]
    refused = "0.2 m: expected a scene with a known scale, found none; set it with: lexsplat scale"
    fails_in_one_line(capsys, [*command, "--by", "20cm", "0", "0"], refused)
    fails_in_one_line(capsys, [*command, "--by", "1", "0", "0", "--grow", "20cm"], refused)
    assert not (copy / "edits.jsonl").exists(), "no step"
    store_world(SceneFolder.open(copy), meters_per_unit=0.5)
    assert cli.main([*command, "--by", "20cm", "0", "-10in"]) == 0
    assert cli.main([*command, "--by", "20", "0", "-10", "--grow", "1m"]) == 0
    _, by_meters, by_units = map(json.loads, (copy / "edits.jsonl").read_text().splitlines())
    assert by_meters["translation"] == pytest.approx([0.4, 0.0, -0.508])
    assert by_units["translation"] == [20.0, 0.0, -10.0], "plain numbers are scene units, as before"


def test_steps_are_applied_within_a_stage_of_progress(built, tmp_path, monkeypatch):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    running: list[str] = []
    applied: list[list[str]] = []

    def listen(self, event):
        if event.total == 1:
            (running.remove if event.done else running.append)(event.stage)

    def apply(*step):
        applied.append([*running])
        return original(*step)

    monkeypatch.setattr(LateProgress, "__call__", listen)
    original = editing.apply
    monkeypatch.setattr(editing, "apply", apply)
    move = ("move", "--select", "blue ball", "--threshold", "0.05", "--by", "0", "0", "1", "--no-fill")
    for words in (move, move, ("undo",), ("redo",)):
        assert cli.main(["edit", str(copy), *words]) == 0
    assert len(applied) == 1 + 2 + 3 + 2, "each command replays the steps so far"
    assert all("steps" in stages for stages in applied)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["move", "--select", "red apple"], "move needs --by, --turn or --scale"),
        (["duplicate", "--select", "red apple"], "duplicate needs --by, --turn or --scale"),
        (["move", "--select", "red apple", "--scale", "-1"], "scale must be positive"),
        (["move", "--select", "red apple", "--by", "nan", "0", "0"], "finite"),
        (
            ["move", "--select", "red apple", "--by", "20cm", "0.5", "0"],
            "a unit with each length or with none",
        ),
        (
            ["move", "--select", "red apple", "--by", "20ells", "0", "0"],
            "expected a length such as 0.095 or 9.5cm",
        ),
        (["recolor", "--select", "red apple", "--color", "2", "0", "0"], "in 0..1, got 2 0 0"),
        (["recolor", "--select", "red apple", "--color", "1", "0", "0", "--strength", "3"], "in 0..1, got 3"),
        (["delete", "--select", "red apple", "--threshold", "3"], "in 0..1"),
        (["delete", "--select", "red apple", "--grow", "-1"], "not be negative"),
        (["undo", "--select", "red apple"], "undo takes no --select"),
        (["list", "--output", "list.txt"], "list takes no --output"),
        (["keep", "--select", "red apple", "--no-fill"], "keep takes no --no-fill"),
        (
            ["recolor", "--select", "red apple", "--color", "red", "--by", "1", "0", "0"],
            "recolor takes no --by",
        ),
    ],
)
def test_invalid_edits_are_wrong_usage(built, arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["edit", str(built), *arguments])
    assert ended.value.code == 2
    assert words in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not (built / "edits.jsonl").exists()


def test_an_edit_that_selects_nothing_states_a_remedy(built, capsys):
    assert cli.main(["edit", str(built), "delete", "--select", "red apple", "--threshold", "1"]) == 1
    assert "found nothing; try other words or a lower threshold" in capsys.readouterr().err


def test_an_edit_with_an_invalid_result_ends_in_one_line_and_adds_no_step(built, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    thing = ("--select", "blue ball", "--threshold", "0.05", "--largest")
    for motion in (["--by", "1e300", "0", "0"], ["--scale", "1e30"]):
        fails_in_one_line(capsys, ["edit", str(copy), "move", *thing, *motion], "move", "Gaussians")
    assert cli.main(["edit", str(copy), "list"]) == 0
    assert not (copy / "edits.jsonl").exists()


@pytest.mark.slow
def test_edits_of_the_bundled_scene_are_kept_in_the_working_directory(tmp_path, monkeypatch, capsys):
    before = {path: path.stat().st_mtime_ns for path in BUNDLED_SCENE.rglob("*")}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lexsplat.scenes.editing.keep_for", lambda *_: None)  # no question is asked of it
    assert cli.main(["edit", "demo", "delete", "--select", "red apple"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["demo_edits.jsonl"]
    less = capsys.readouterr().out.splitlines()[-1]
    assert cli.main(["edit", "demo", "list"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == less
    assert cli.main(["edit", "demo", "save", "--output", "mine"]) == 0
    assert "demo_edits.jsonl" in capsys.readouterr().out, "the steps are kept"
    mine, shipped = (open_scene(name).gaussians.means for name in ("mine", "demo"))
    kept = np.isin(shipped[:, 0].numpy(), mine[:, 0].numpy()).mean()
    assert 0.9 < kept < 1, "without the apple; its place is filled"
    assert cli.main(["edit", "demo", "discard", "--yes"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert {path: path.stat().st_mtime_ns for path in BUNDLED_SCENE.rglob("*")} == before


@pytest.mark.slow
def test_an_edit_of_what_the_scene_may_lack_says_so_and_how_to_take_it_back(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["edit", "demo", "recolor", "--select", "bear eye", "--color", "red"]) == 0
    told = "note: bear eye: perhaps not in this scene; names of other parts fit this place better"
    assert f"{told}; lexsplat edit demo undo takes the step back" in capsys.readouterr().err
    assert cli.main(["edit", "demo", "recolor", "--select", "bear nose", "--color", "red"]) == 0
    assert "perhaps" not in capsys.readouterr().err


def test_discard_asks_before_it_deletes_steps(built, tmp_path, monkeypatch, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    discard = ["edit", str(copy), "discard"]
    assert cli.main(discard) == 0, "nothing to discard"
    assert cli.main(["edit", str(copy), "delete", "--select", "blue ball", "--threshold", "0.05"]) == 0
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))  # not a terminal
    fails_in_one_line(capsys, discard, "--yes")
    monkeypatch.setattr("sys.stdin", Terminal("n\n"))
    fails_in_one_line(capsys, discard, "--yes")
    assert (copy / "edits.jsonl").exists()
    monkeypatch.setattr("sys.stdin", Terminal("y\n"))
    assert cli.main(discard) == 0
    assert not (copy / "edits.jsonl").exists()


def test_an_edited_scene_is_saved_neither_in_a_folder_nor_over_a_file_that_exists(built, tmp_path, capsys):
    command = ["edit", str(built), "save", "--output"]
    fails_in_one_line(capsys, [*command, str(tmp_path)], "expected a new folder, found a folder that exists")
    (tmp_path / "notes.txt").write_text("mine")
    taken = str(tmp_path / "notes.txt")
    fails_in_one_line(capsys, [*command, taken], "expected a new folder, found a file that exists")


@pytest.fixture
def with_a_step(built, tmp_path, capsys):
    """A copy of the scene with a step that no scene holds."""
    copy = shutil.copytree(built, tmp_path / "my scene")
    chosen = ("--select", "blue ball", "--threshold", "0.05", "--largest")
    assert cli.main(["edit", str(copy), "recolor", *chosen, "--color", "red"]) == 0
    told = capsys.readouterr().err
    assert told.count(f"lexsplat edit '{copy}' save --output SCENE2 makes a scene with it") == 1
    return copy


@pytest.mark.parametrize(
    "command",
    [
        ["export", "SCENE", "OUT.ply"],
        ["export", "SCENE", "OUT.ply", "--select", "blue ball", "--threshold", "0.05"],
        ["find", "SCENE", "blue ball", "--json"],
        ["ask", "SCENE", "blue ball"],
    ],
)
def test_a_command_that_reads_a_scene_notes_once_that_steps_are_not_in_it(
    with_a_step, tmp_path, capsys, command
):
    told = f"note: 1 step of lexsplat edit is not in this scene; lexsplat edit '{with_a_step}' save --output SCENE2"
    places = {"SCENE": str(with_a_step), "OUT": str(tmp_path / "out"), "OUT.ply": str(tmp_path / "a.ply")}
    assert cli.main([places.get(word, word) for word in command]) == 0
    captured = capsys.readouterr()
    assert captured.err.count(told) == 1
    assert "note: 1 step" not in captured.out
    assert cli.main(["edit", str(with_a_step), "undo"]) == 0
    assert cli.main(["edit", str(with_a_step), "list"]) == 0
    capsys.readouterr()
    assert (
        cli.main([places.get(word, word) for word in command] + ["--force"] * (command[0] == "export")) == 0
    )
    assert "of lexsplat edit" not in capsys.readouterr().err


def test_info_counts_the_steps_that_the_scene_does_not_hold(with_a_step, capsys):
    assert cli.main(["info", str(with_a_step)]) == 0
    captured = capsys.readouterr()
    line = next(line for line in captured.out.splitlines() if line.startswith("unsaved steps"))
    assert line.split(maxsplit=2)[2].startswith("1; lexsplat edit ")
    assert "note:" not in captured.err
    assert cli.main(["info", str(with_a_step), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unsaved_steps"] == 1


@pytest.mark.parametrize(
    "content", [b"", b"\xff\n", b"{}\n3\n", b'{}\n{"undo": true}\n', b"{}\n{\n", b"{}\n{}\n{}\n3\n"]
)
def test_a_damaged_journal_has_no_steps_to_note(tmp_path, content):
    folder = SceneFolder(tmp_path)
    (tmp_path / "edits.jsonl").write_bytes(content)
    assert unsaved_steps(folder) == 0


def test_edits_are_saved_beside_a_scene_and_where_folders_can_be_made(with_a_step, capsys):
    inside = str(with_a_step / "edited")
    fails_in_one_line(capsys, ["edit", str(with_a_step), "save", "--output", inside], "one in the scene")
    if Path("/proc/self").exists():
        save = ["edit", str(with_a_step), "save", "--output", "/proc/edited"]
        fails_in_one_line(
            capsys, save, "/proc/edited: expected a path that exists or can be made, found none"
        )
