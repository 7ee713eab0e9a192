"""The command line end to end on a tiny capture: build, go on, ask, evaluate, refuse."""

import json
import os
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import QUICK_BUILD as QUICK
from PIL import Image
from support.tiny_capture import write_capture

from lexsplat import cli, open_scene
from lexsplat.features import hub
from lexsplat.scenes.folder import BUNDLED_SCENE

pytestmark = pytest.mark.xdist_group("built")


def modified(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def test_build_writes_the_scene_folder_of_the_design(built):
    names = {p.name for p in built.iterdir()}
    assert {"scene.json", "cameras.json", "gaussians.ply", "language.safetensors"} <= names
    record = json.loads((built / "scene.json").read_text())
    assert list(record["stages"]) == ["reconstruct", "features", "language"]
    assert record["stages"]["language"]["codes"] == 16
    views = json.loads((built / "cameras.json").read_text())["views"]
    held_out = [v["name"] for v in views if v["split"] == "test"]
    assert held_out == ["view_02.png", "view_06.png", "view_10.png"], "views with masks are held out"
    assert not list((built / "checkpoints" / "features").glob("*.dino.*")), "averaged features need no DINO"


def test_a_language_made_of_codes_of_the_views_leaves_their_index_maps(built, tiny_capture, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK, "--method", "lifted"]) == 0
    record = json.loads((copy / "scene.json").read_text())
    assert set(record["stages"]) == {"reconstruct", "features", "codebook", "language"}
    assert list((copy / "checkpoints" / "features").glob("*.dino.*"))
    codes = {p.stem for p in (copy / "codes").iterdir()}
    assert codes.isdisjoint({"view_02", "view_06", "view_10"}), "held-out views take no part in the codebook"
    assert len(codes) == 9


def test_building_again_changes_no_result(built, tiny_capture):
    before = modified(built)
    assert cli.main(["build", str(tiny_capture), "--output", str(built), *QUICK]) == 0
    after = modified(built)
    changed = {name for name in before if after[name] != before[name]}
    assert changed <= {"scene.json", "cameras.json", ".lock"}


def test_a_changed_setting_redoes_only_what_it_touches(built, tiny_capture, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    before = modified(copy)
    # Features are averaged: no other way to the language, nor how much is kept in memory, has a part in it.
    idle = ["--trained.no-use-smoothing", "--tuning.iterations", "9", "--averaged.memory-bytes", "999999"]
    idle += ["--lifted.top", "3", "--features.dino-stride", "9"]
    idle += ["--features.random-crops", "7", "--reconstruction.image-memory", "999999", "--memory", "3GB"]
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK, *idle]) == 0
    after = modified(copy)
    assert {name for name in before if after[name] != before[name]} <= {"scene.json", "cameras.json", ".lock"}
    arguments = [*QUICK, "--averaged.top", "3"]
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *arguments]) == 0
    after = modified(copy)
    assert after["language.safetensors"] != before["language.safetensors"]
    for kept in before:
        if kept.startswith("checkpoints/features/") or kept == "gaussians.ply":
            assert after[kept] == before[kept], kept


def test_other_encoders_under_the_name_embedded_make_features_anew(
    built, tiny_capture, tmp_path, monkeypatch, capsys
):
    # As after an update of lexsplat: the scene was built with the encoders of the version before.
    copy, encoders = tmp_path / "copy", tmp_path / "encoders"
    shutil.copytree(built, copy)
    shutil.copytree(hub.BUNDLED_ENCODERS, encoders)
    monkeypatch.setattr(hub, "BUNDLED_ENCODERS", encoders)
    config = json.loads((encoders / "clip" / "config.json").read_text())
    (encoders / "clip" / "config.json").write_text(json.dumps(config | {"logit_scale_init_value": 2.5}))
    before = modified(copy)
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK]) == 0
    after = modified(copy)
    assert after["language.safetensors"] != before["language.safetensors"]
    assert after["gaussians.ply"] == before["gaussians.ply"]
    assert cli.main(["query", str(copy), "red ball", "--json"]) == 0


def without_texts(times):
    """Without the cache of texts, which every question may add to."""
    return {name: time for name, time in times.items() if not name.startswith("checkpoints/texts/")}


def test_an_edit_by_words_is_undone_done_again_saved_and_the_new_scene_answers_rightly(
    built, tiny_capture, tmp_path, capsys
):
    copy, saved = tmp_path / "copy", tmp_path / "saved"
    shutil.copytree(built, copy)
    before = without_texts(modified(copy))
    original = open_scene(built, device="cpu")
    answering = original.scores(["blue ball"])[0] >= 0.13
    rest = ~original.find("blue ball", threshold=0.13).mask  # without the strays that belong to no thing
    assert 20 < int((~rest).sum()) < len(rest) / 2
    strays = int((answering & rest).sum())
    assert strays < 0.3 * int(answering.sum())
    everything = f"{len(rest):,} Gaussians"

    def edit(*arguments: str) -> str:
        capsys.readouterr()
        assert cli.main(["edit", str(copy), *arguments]) == 0
        return capsys.readouterr().out.splitlines()[-1]

    less = f"{int(rest.sum()):,} Gaussians"
    assert edit("delete", "--select", "blue ball", "--threshold", "0.13") == f"{less}, 0 steps undone"
    assert edit("undo") == f"{everything}, 1 steps undone"
    assert edit("redo") == f"{less}, 0 steps undone"
    edit("save", "--output", str(saved))
    assert edit("discard") == f"{everything}, 0 steps undone"
    assert without_texts(modified(copy)) == before, "the scene itself stays as it was built"

    arguments = [
        "query",
        str(saved),
        "red apple",
        "blue ball",
        "--view",
        "view_06.png",
        "--threshold",
        "0.13",
        "--json",
    ]
    assert cli.main([*arguments, "--output", str(tmp_path / "answers")]) == 0
    apple, ball = json.loads(capsys.readouterr().out)["prompts"]
    assert ball["gaussians"] == strays
    column, row = apple["views"]["view_06.png"]["peak_pixel"]
    ground_truth = tiny_capture / "segmentations" / "view_06"
    assert np.asarray(Image.open(ground_truth / "red apple.png"))[row, column], (
        "the apple is still found where it is"
    )
    reopened = open_scene(saved, device="cpu")
    assert np.array_equal(reopened.gaussians.means, original.gaussians.means[rest])
    there = np.asarray(Image.open(ground_truth / "blue ball.png")) > 0
    with_ball, without = (
        s.relevancy(["blue ball"], "view_06.png")[0].numpy()[there].mean() for s in (original, reopened)
    )
    assert without < 0.67 * with_ball, "what stood behind answers less"


@pytest.mark.parametrize("method", ["lifted", "lifted+tuned"])
def test_every_method_makes_a_scene_that_answers(built, tiny_capture, tmp_path, method):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK, "--method", method]) == 0
    scene = open_scene(copy, device="cpu")
    assert scene.field.method == method
    relevancy = scene.relevancy(["red apple"], "view_02")
    assert relevancy.shape == (1, 72, 96)
    assert float(relevancy.max()) > float(relevancy.min())


def test_query_writes_pictures_and_json(built, tmp_path, capsys):
    arguments = ["query", str(built), "red apple", "blue ball", "--view", "view_02.png", "--json"]
    assert cli.main([*arguments, "--output", str(tmp_path)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [p["prompt"] for p in answer["prompts"]] == ["red apple", "blue ball"]
    for prompt in answer["prompts"]:
        view = prompt["views"]["view_02.png"]
        heatmap, mask = Image.open(view["heatmap"]), np.array(Image.open(view["mask"]))
        assert heatmap.size == (96, 72)
        assert set(np.unique(mask)) <= {0, 255}
        assert view["mask_share"] == pytest.approx((mask > 0).mean(), abs=1e-4)
        assert 0 <= prompt["threshold"] <= 1


def test_find_says_where_things_are_in_3d(built, capsys):
    assert cli.main(["find", str(built), "red apple", "red apple left of the blue ball", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    scene = open_scene(built)
    first, second = answer["phrases"]
    assert answer["up"]["direction"] == pytest.approx([0, 0, 1], abs=1e-3), (
        "the cameras of the capture are level"
    )
    apple = scene.select("red apple")
    expected = [] if apple.present == "no" else apple.instances
    assert first["present"] == apple.present
    assert first["count"] == len(first["instances"]) == len(expected)
    for found, instance in zip(first["instances"], expected):
        assert np.allclose(found["center"], instance.center, atol=1e-4)
    assert second["understood"] == '("red apple" left of "blue ball")'
    assert first["present"] in ("yes", "no", "unsure")
    assert cli.main(["find", str(built), "red apple"]) == 0
    assert f"{first['count']} found" in capsys.readouterr().out
    assert cli.main(["find", str(built), "on the table"]) == 1


def test_evaluate_writes_metrics_and_a_report_that_stands_alone(built, capsys):
    assert cli.main(["evaluate", str(built), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((built / "metrics.json").read_text())
    assert printed == written
    assert written["quality"]["psnr"] > 15
    strict = written["language"]["strict"]
    for form in ("auto", "fixed", "oracle"):
        assert set(strict[form]) >= {"mIoU", "mPA", "mP"}
    assert strict["oracle"]["mIoU"] >= max(strict["auto"]["mIoU"], strict["fixed"]["mIoU"])
    assert set(written) >= {"quality", "language", "speed", "size", "config", "machine"}
    html = (built / "report.html").read_text()
    HTMLParser().feed(html)
    assert 'src="http' not in html
    assert "red apple" in html


def test_info_tells_what_is_there(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["views"] == {"training": 9, "held out": 3}
    assert facts["gaussians"] > 0
    assert cli.main(["info", str(built)]) == 0
    assert "gaussian bytes" in capsys.readouterr().out


def test_export_writes_the_standard_ply(built, tmp_path):
    assert cli.main(["export", str(built), str(tmp_path / "a.ply")]) == 0
    assert (tmp_path / "a.ply").read_bytes() == (built / "gaussians.ply").read_bytes()


def fails_in_one_line(capsys, arguments: list[str], *words: str) -> None:
    assert cli.main(arguments) == 1
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    for word in words:
        assert word in lines[0], lines[0]


def test_an_empty_prompt_is_refused(built, capsys):
    fails_in_one_line(capsys, ["query", str(built), "  "], "prompt")


def test_an_unknown_view_names_views_there_are(built, capsys):
    fails_in_one_line(capsys, ["query", str(built), "x", "--view", "nowhere"], "nowhere", "view_01.png")


def test_an_unknown_model_says_the_three_ways_to_get_one(tiny_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    output = tmp_path / "out"
    arguments = [
        "language",
        str(tiny_capture),
        "--output",
        str(output),
        "--iterations",
        "2",
        "--device",
        "cpu",
    ]
    fails_in_one_line(capsys, [*arguments, "--clip", "nobody/nothing"], "nobody/nothing", "bundled", "folder")
    assert not (output / "language.safetensors").exists()
    arguments = [
        "build",
        *arguments[1:],
        "--clip",
        "bundled",
        "--dino",
        "nobody/nothing",
        "--method",
        "lifted",
    ]
    fails_in_one_line(capsys, arguments, "nobody/nothing", "--dino bundled")
    assert not (output / "gaussians.ply").exists(), "it is told before the long part"


def broken(tmp_path: Path, damage) -> Path:
    capture = write_capture(tmp_path / "capture", views=4, width=32, height=24)
    damage(capture)
    return capture


def truncate_image(capture: Path) -> None:
    path = capture / "images" / "view_01.png"
    path.write_bytes(path.read_bytes()[:300])


def resize_image(capture: Path) -> None:
    path = capture / "images" / "view_01.png"
    Image.open(path).resize((32, 40)).save(path)


def poison_pose(capture: Path) -> None:
    path = capture / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    parts = lines[0].split()
    parts[5] = "nan"
    path.write_text("\n".join([" ".join(parts), *lines[1:]]) + "\n")


def orphan_mask(capture: Path) -> None:
    path = capture / "segmentations" / "view_77" / "mug.png"
    path.parent.mkdir(parents=True)
    Image.new("L", (32, 24)).save(path)


DAMAGES = {
    "no such folder": (shutil.rmtree, "capture"),
    "empty folder": (lambda c: [shutil.rmtree(c), os.mkdir(c)], "capture"),
    "no cameras": (lambda c: shutil.rmtree(c / "sparse"), "capture"),
    "truncated image": (truncate_image, "view_01.png"),
    "image of another shape": (resize_image, "view_01.png"),
    "NaN in a pose": (poison_pose, "view_01.png"),
    "mask without a view": (orphan_mask, "view_77"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_bad_captures_end_in_one_line_and_no_half_written_output(tmp_path, capsys, kind):
    damage, word = DAMAGES[kind]
    capture, output = broken(tmp_path, damage), tmp_path / "out"
    arguments = ["build", str(capture), "--output", str(output), *QUICK, "--iterations", "5"]
    fails_in_one_line(capsys, arguments, word)
    assert not output.exists(), sorted(output.rglob("*"))


def test_a_bad_capture_takes_nothing_from_a_folder_that_was_there(built, tmp_path, capsys):
    capture, output = broken(tmp_path, poison_pose), tmp_path / "out"
    shutil.copytree(built, output)
    before = {
        path: path.read_bytes() for path in output.rglob("*") if path.is_file() and path.name != ".lock"
    }
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(output), *QUICK], "view_01.png")
    assert {path: path.read_bytes() for path in before} == before
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(mine), *QUICK], "view_01.png")
    assert (mine / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "arguments",
    [
        ["build"],
        ["build", "x", "--output", "y", "--memory", "plenty"],
        ["build", "x", "--output", "y", "--downscale", "-1"],
        ["build", "x", "--output", "y", "--iterations", "0"],
        ["build", "x", "--output", "y", "--reconstruction.iterations", "5"],
        ["build", "x", "--output", "y", "--features.memory", "5"],
        ["build", "x", "--output", "y", "--test-every", "1"],
        ["build", "x", "--output", "y", "--codebook.num-codes", "300"],
        ["query", "x", "apple", "--threshold", "nan"],
        ["query", "x", "apple", "--template", "no braces"],
        ["query", "x", "apple", "--temperature", "-1"],
        ["build", "x", "--output", "y", "--seed", "-1"],
        ["build", "x", "--output", "y", "--seed", str(2**70)],
        ["build", "x", "--output", "y", "--reconstruction.max-gaussians", "0"],
        ["language", "x", "--output", "y", "--splats", "z.ply", "--joint", "--method", "trained"],
        ["poses", "x", "--output", "y", "--memory", "plenty"],
        ["poses", "x", "--output", "y", "--seed", "-1"],
        ["demo", "--iterations", "0"],
        ["demo", "--seed", "-1"],
        ["compare", "x", "--output", "y", "--seeds", "-1"],
        ["edit", "x", "delete", "--select", "a", "--threshold", "nan"],
        ["edit", "x", "delete", "--select", "a", "--grow", "-1"],
        ["edit", "x", "delete", "--select", "a", "--shrink", "inf"],
        ["edit", "x", "move", "--select", "a", "--by", "nan", "0", "0"],
        ["edit", "x", "move", "--select", "a", "--turn", "inf"],
        ["edit", "x", "move", "--select", "a", "--scale", "0"],
        ["edit", "x", "recolor", "--select", "a", "--color", "255", "0", "0"],
        ["edit", "x", "recolor", "--select", "a", "--color", "1", "0", "0", "--strength", "2"],
        ["export", "x", "a.ply", "--select", "a", "--threshold", "nan"],
        ["scale", "x", "--up", "0,0,0"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_status_2_and_words(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_an_edit_that_leads_nowhere_ends_in_one_line_and_is_no_step(built, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    thing = ("--select", "blue ball", "--threshold", "0.13", "--largest")
    for motion in (["--by", "1e300", "0", "0"], ["--scale", "1e30"]):
        fails_in_one_line(capsys, ["edit", str(copy), "move", *thing, *motion], "move", "Gaussians")
    assert cli.main(["edit", str(copy), "list"]) == 0
    assert not (copy / "edits.jsonl").exists()


@pytest.mark.parametrize("name", ["gaussians.ply", "codes/../gaussians.ply", "metrics.json", "scene.json"])
def test_an_export_never_takes_the_place_of_a_file_of_its_scene(built, tmp_path, capsys, name):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    before = (copy / "gaussians.ply").read_bytes()
    fails_in_one_line(
        capsys, ["export", str(copy), str(copy / name), "--select", "blue ball"], "another name"
    )
    assert (copy / "gaussians.ply").read_bytes() == before
    assert cli.main(["export", str(copy), str(copy / "copy.ply")]) == 0


@pytest.mark.parametrize("name", ["gaussians.ply", "cameras.json"])
def test_a_build_never_takes_the_place_of_files_of_another_program(tiny_capture, tmp_path, capsys, name):
    """The folder of a 3DGS training has a cameras.json, too."""
    output = tmp_path / "output"
    output.mkdir()
    (output / name).write_text("mine")
    arguments = ["build", str(tiny_capture), "--output", str(output), *QUICK]
    fails_in_one_line(capsys, arguments, name, "another --output")
    assert [path.name for path in output.iterdir()] == [name]
    assert (output / name).read_text() == "mine"


def test_a_capture_worked_on_too_small_is_told_before_the_training(tiny_capture, tmp_path, capsys):
    arguments = ["build", str(tiny_capture), "--output", str(tmp_path / "out"), *QUICK]
    fails_in_one_line(capsys, [*arguments, "--downscale", "100"], "6 pixels", "--downscale")
    # Eight pixels are enough, though half of them, as in the warm-up of a training, are not.
    assert cli.main(["reconstruct", *arguments[1:], "--downscale", "9", "--iterations", "10"]) == 0


def test_names_that_are_no_text_end_in_one_line(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture\udcff", views=4, width=32, height=24)
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(tmp_path / "out"), *QUICK], "UTF-8")


STOPPED = "stopped; run the same command again to go on\n"


def test_the_second_of_two_at_one_output_says_who_holds_it_and_stops(tiny_capture, tmp_path, capsys):
    from lexsplat.scenes.folder import SceneFolder

    with SceneFolder(tmp_path / "out").locked():
        for arguments in (["poses", str(tiny_capture / "images")], ["build", str(tiny_capture), *QUICK]):
            arguments += ["--output", str(tmp_path / "out")]
            fails_in_one_line(capsys, arguments, f"process {os.getpid()} at work", "another --output")


def test_ctrl_c_while_arguments_are_read_ends_in_a_line(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.tyro, "cli", interrupted)
    assert cli.main(["info", "demo"]) == 130
    assert capsys.readouterr().err == STOPPED


def test_ctrl_c_while_the_libraries_load_ends_in_a_line():
    interrupting = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background is started with it ignored
from lexsplat.__main__ import main
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", interrupting], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stderr) == (130, STOPPED)


def test_version_is_printed(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("lexsplat 0.")


def test_moves_of_the_command_line_are_those_of_the_journal(built, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    thing = ("--select", "blue ball", "--threshold", "0.13", "--largest")
    motion = ("--by", "0.5", "0", "0.25", "--turn", "90", "--scale", "1.5")
    assert cli.main(["edit", str(copy), "move", *thing, *motion]) == 0
    assert cli.main(["edit", str(copy), "duplicate", *thing, "--by", "0", "0", "1"]) == 0
    _, moved, copied = map(json.loads, (copy / "edits.jsonl").read_text().splitlines())
    assert moved["step"] == "move"
    assert moved["translation"] == [0.5, 0.0, 0.25]
    assert moved["scale"] == 1.5
    turn = np.array(moved["rotation"])
    assert np.trace(turn) == pytest.approx(1)  # 1 + 2 cos 90 degrees
    assert copied["step"] == "duplicate"
    assert copied["translation"] == [0.0, 0.0, 1.0]
    assert np.array(copied["rotation"]) == pytest.approx(np.eye(3))
    assert "2. duplicate blue ball" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["move", "--select", "red apple"], "move needs --by, --turn or --scale"),
        (["duplicate", "--select", "red apple"], "duplicate needs --by, --turn or --scale"),
        (["move", "--select", "red apple", "--scale", "-1"], "scale must be positive"),
        (["move", "--select", "red apple", "--by", "nan", "0", "0"], "finite"),
        (["recolor", "--select", "red apple", "--color", "2", "0", "0"], "in 0..1"),
        (["recolor", "--select", "red apple", "--color", "1", "0", "0", "--strength", "3"], "in 0..1"),
        (["delete", "--select", "red apple", "--threshold", "3"], "in 0..1"),
        (["delete", "--select", "red apple", "--grow", "-1"], "not be negative"),
    ],
)
def test_edits_that_mean_nothing_are_wrong_usage(built, arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["edit", str(built), *arguments])
    assert ended.value.code == 2
    assert words in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not (built / "edits.jsonl").exists()


def test_an_edit_of_nothing_says_what_could_be_done(built, capsys):
    assert cli.main(["edit", str(built), "delete", "--select", "red apple", "--threshold", "1"]) == 1
    assert "found nothing; try other words or a lower threshold" in capsys.readouterr().err


def test_the_scene_that_ships_is_edited_in_a_journal_beside_the_user(tmp_path, monkeypatch, capsys):
    before = {path: path.stat().st_mtime_ns for path in BUNDLED_SCENE.rglob("*")}
    monkeypatch.chdir(tmp_path)
    assert cli.main(["edit", "demo", "delete", "--select", "red apple"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["demo_edits.jsonl"]
    less = capsys.readouterr().out.splitlines()[-1]
    assert cli.main(["edit", "demo", "list"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == less
    assert cli.main(["edit", "demo", "save", "--output", "mine"]) == 0
    assert "demo_edits.jsonl" in capsys.readouterr().out, "it says that the steps are still there"
    assert len(open_scene("mine").gaussians) < len(open_scene("demo").gaussians)
    assert cli.main(["edit", "demo", "discard"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert {path: path.stat().st_mtime_ns for path in BUNDLED_SCENE.rglob("*")} == before


def test_the_package_runs_as_a_module_too():
    answer = subprocess.run([sys.executable, "-m", "lexsplat", "--version"], capture_output=True, text=True)
    assert (answer.returncode, answer.stdout.split()[0]) == (0, "lexsplat")


@pytest.mark.parametrize("arguments", [("build", "--help"), ("info", "demo")])
def test_a_reader_that_has_seen_enough_ends_a_command_quietly(arguments):
    command = [sys.executable, "-m", "lexsplat", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()  # as `| head` does, before the first line
        error = process.stderr.read()
    assert "Traceback" not in error
    assert "Broken pipe" not in error
    assert process.returncode == 0


def test_info_says_what_averaged_features_are_made_of(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["method"], facts["codes"], facts["dino"]) == ("averaged", 16, "not used")
    assert "weight_dropped" not in facts
