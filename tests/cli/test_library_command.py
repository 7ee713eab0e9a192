"""``lexsplat library``: many scenes from the command line."""

import errno
import json
import os
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.command_line import fails_in_one_line
from support.library_scenes import OTHERS, copied, install, write_scene
from support.schemas import validated

from lexsplat import cli

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def kept_rooms(tmp_path_factory):
    """Two scenes and a library of them; read-only."""
    root = tmp_path_factory.mktemp("rooms")
    write_scene(root / "kitchen")
    write_scene(root / "office", OTHERS)
    assert (
        cli.main(["library", "add", str(root / "library"), str(root / "kitchen"), str(root / "office")]) == 0
    )
    return root


@pytest.fixture
def rooms(kept_rooms, tmp_path, monkeypatch) -> Path:
    install(monkeypatch)
    return copied(kept_rooms, tmp_path / "rooms")


def run(capsys, action, rooms, *arguments):
    capsys.readouterr()
    assert cli.main(["library", action, str(rooms / "library"), *map(str, arguments)]) == 0
    return capsys.readouterr().out


def document(capsys, *arguments):
    found = json.loads(run(capsys, *arguments, "--json"))
    validated("library", found)
    return found


def test_all_actions_answer_in_their_schema(rooms, capsys):
    assert [scene["name"] for scene in document(capsys, "list", rooms)["scenes"]] == ["kitchen", "office"]
    mug, candle, dog = document(capsys, "search", rooms, "mug", "candle", "dog")["phrases"]
    assert [[hit["scene"] for hit in each["hits"]] for each in (mug, candle, dog)] == [
        ["kitchen"],
        ["office"],
        [],
    ]
    assert (mug["scenes"], mug["opened"], mug["unopened"], mug["skipped"]) == (2, 1, 0, [])
    assert mug["hits"][0]["thumbnail"] == str(rooms / "library" / "thumbnails" / "kitchen" / "mug.jpg")
    assert Image.open(mug["hits"][0]["thumbnail"]).size == (32, 24)
    assert document(capsys, "verify", rooms) == {"library": str(rooms / "library"), "problems": []}
    assert document(capsys, "remove", rooms, "office")["removed"] == ["office"]
    assert [scene["name"] for scene in document(capsys, "add", rooms, rooms / "office")["scenes"]] == [
        "office"
    ]


def test_people_read_where_things_are(rooms, capsys, tmp_path):
    said = run(capsys, "search", rooms, "mug", "--thumbnails", tmp_path / "found")
    assert "mug: present: yes, in 1 of 2 scenes" in said
    assert '1. kitchen: present: yes. 1 found for "mug": mug at (0.9' in said
    assert str(tmp_path / "found" / "kitchen" / "mug.jpg") in said
    assert "2 scenes, 1 encoder\n" in run(capsys, "list", rooms)
    assert "2 scenes are sound" in run(capsys, "verify", rooms)


def test_without_thumbnails_a_search_writes_nothing(rooms, capsys):
    before = {path: path.stat().st_mtime_ns for path in (rooms / "library").rglob("*")}
    (found,) = document(capsys, "search", rooms, "mug", "--thumbnails", "none")["phrases"]
    assert "thumbnail" not in found["hits"][0]
    assert {path: path.stat().st_mtime_ns for path in (rooms / "library").rglob("*")} == before


def test_what_is_wrong_is_reported_in_one_line_with_its_remedy(rooms, capsys):
    library = str(rooms / "library")
    fails_in_one_line(
        capsys, ["library", "search", str(rooms), "mug"], "library.json", "lexsplat library add"
    )
    fails_in_one_line(capsys, ["library", "add", library, str(rooms / "nowhere")], "no such folder")
    fails_in_one_line(capsys, ["library", "remove", library, "attic"], "no such scene", "kitchen, office")
    index = ["--index", "http://127.0.0.1:9"]
    fails_in_one_line(capsys, ["library", "search", library, "mug", *index], "no connection", "chroma run")
    shutil.rmtree(rooms / "kitchen")
    fails_in_one_line(capsys, ["library", "verify", library], "1 of 2 with a problem", "--repair")
    fails_in_one_line(capsys, ["library", "verify", library, "--repair"], "1 of 2 with a problem")
    (hit,) = document(capsys, "search", rooms, "candle")["phrases"][0]["hits"]
    assert hit["scene"] == "office"
    assert document(capsys, "search", rooms, "mug")["phrases"][0]["skipped"][0]["scene"] == "kitchen"


def test_the_commands_that_are_proposed_quote_paths_with_spaces(rooms, capsys):
    library = shutil.copytree(rooms / "library", rooms / "my library")
    shutil.rmtree(rooms / "office")
    assert cli.main(["library", "verify", str(library)]) == 1
    assert f"if it is gone: lexsplat library remove '{library}' office" in capsys.readouterr().out
    (library / "library.json").unlink()
    fails_in_one_line(
        capsys, ["library", "list", str(library)], f"; lexsplat library verify '{library}' --repair writes"
    )


def test_one_of_several_scenes_that_cannot_be_added_stops_no_other(rooms, capsys):
    library = str(rooms / "library")
    arguments = ["library", "add", library, str(rooms / "nowhere"), str(rooms / "office")]
    assert cli.main(arguments) == 1
    said = capsys.readouterr()
    assert said.out.startswith(f"not added: {rooms / 'nowhere'}: expected a scene folder")
    assert "office: added from" in said.out
    assert "found 1 of 2 that cannot; see above" in said.err
    assert cli.main([*arguments, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    validated("library", found)
    assert [each["scene"] for each in found["failed"]] == [str(rooms / "nowhere")]


def test_nothing_is_removed_unless_all_are_known(rooms, capsys):
    fails_in_one_line(
        capsys, ["library", "remove", str(rooms / "library"), "office", "attic"], "no such scene"
    )
    assert "2 scenes" in run(capsys, "list", rooms)
    assert "removed: office, kitchen" in run(capsys, "remove", rooms, "office", "kitchen")


@pytest.mark.parametrize("code", [errno.EROFS, errno.ENOSPC])
def test_an_answer_is_given_where_its_thumbnails_cannot_be_written(rooms, capsys, caplog, monkeypatch, code):
    def refused(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("lexsplat.scenes.library.found.atomic_path", refused)
    assert cli.main(["library", "search", str(rooms / "library"), "mug"]) == 0
    assert "1. kitchen: present: yes" in capsys.readouterr().out
    assert f"no thumbnails, {os.strerror(code)}; give --thumbnails FOLDER or none" in caplog.text
    (mug,) = document(capsys, "search", rooms, "mug")["phrases"]
    assert "thumbnail" not in mug["hits"][0]


@pytest.mark.parametrize("text", [None, "{"])
def test_a_lost_library_file_is_repaired_by_verify(rooms, capsys, text):
    path = rooms / "library" / "library.json"
    path.unlink() if text is None else path.write_text(text)
    fails_in_one_line(capsys, ["library", "search", str(rooms / "library"), "mug"], "verify", "--repair")
    assert "2 scenes are sound" in run(capsys, "verify", rooms, "--repair")
    assert "in 1 of 2" in run(capsys, "search", rooms, "mug")


def test_a_scene_whose_folder_is_gone_is_marked_in_the_list(rooms, capsys):
    (rooms / "office").rename(rooms / "study")
    try:
        assert cli.main(["library", "list", str(rooms / "library")]) == 0
    finally:
        (rooms / "study").rename(rooms / "office")
    marked = [line for line in capsys.readouterr().out.splitlines() if line.endswith("no such folder")]
    assert [line.split(":")[0] for line in marked] == ["office"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["list", "x", "--repair"], "--repair is for verify, not for list"),
        (["verify", "x", "--confirm"], "--confirm is for search, not for verify"),
        (["add", "x", "demo", "--thumbnails", "y"], "--thumbnails is for search, not for add"),
    ],
)
def test_an_option_of_another_action_is_refused(arguments, told, capsys):
    with pytest.raises(SystemExit):
        cli.main(["library", *arguments])
    assert told in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["search", "LIB", "mug", " "], "PHRASE 2 of 2: expected a word or phrase, found an empty text"),
        (["search", "LIB"], "PHRASE"),
        (["add", "LIB"], "SCENE"),
        (["remove", "LIB"], "SCENE"),
        (["list", "LIB", "x"], "list takes no SCENE"),
        (["search", "LIB", "mug", "--limit", "0"], "limit must be at least 1"),
        (["sing", "LIB"], "sing"),
        ([], "LIB"),
    ],
)
def test_wrong_usage_is_refused(capsys, arguments, told):
    with pytest.raises(SystemExit) as refusal:
        cli.main(["library", *arguments])
    assert refusal.value.code == 2
    error = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert told.lower() in error.lower()


def test_a_library_notes_once_that_steps_of_an_edit_are_not_in_a_scene(rooms, capsys):
    made = json.loads((rooms / "kitchen" / "scene.json").read_text())["stages"]["reconstruct"]["fingerprint"]
    header = json.dumps({"reconstruction": made})
    (rooms / "kitchen" / "edits.jsonl").write_text(header + '\n{"kind": "recolor"}\n')
    told = "note: 1 step of lexsplat edit is not in this scene; lexsplat edit "
    for action, words in (("add", [rooms / "kitchen"]), ("search", ["mug", "mug"])):
        capsys.readouterr()
        assert cli.main(["library", action, str(rooms / "library"), *map(str, words)]) == 0
        captured = capsys.readouterr()
        assert captured.err.count(told) == 1, action
        assert told not in captured.out
    assert "lexsplat edit" not in run(capsys, "search", rooms, "candle")
