"""Edits of the bundled scene, and what it answers then about things that are gone or have another color."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.gone import gone_nouns, noun_of
from lexsplat.scenes.library import Library
from lexsplat.scenes.scene import Scene, open_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo", device="cpu")


@pytest.fixture(scope="module")
def edited(demo, tmp_path_factory) -> tuple[Scene, Scene]:
    """The demo without its apple, its mug red; in the editor, and saved and opened again."""
    editor = Editor(demo)
    editor.delete(demo.select("apple"))
    editor.recolor(editor.scene.select("blue mug"), (0.8, 0.05, 0.05))
    folder = tmp_path_factory.mktemp("edits") / "saved"
    editor.save(folder)
    return editor.scene, open_scene(folder, device="cpu")


@pytest.mark.parametrize("saved", [False, True], ids=["in the editor", "saved"])
def test_a_thing_that_an_edit_took_is_not_found_in_another_one(edited, saved):
    scene = edited[saved]
    assert scene.select("banana").present == "yes", "language takes it for an apple where none is left"
    for phrase in ("apple", "apples", "red apple", "the apple on the table", "apple stem"):
        assert scene.find(phrase).present == "no", phrase
        assert not scene.find(phrase)
    assert "an edit took the apple away" in scene.find("apple").note
    assert gone_nouns(scene) == {"apple"}


@pytest.mark.parametrize("saved", [False, True], ids=["in the editor", "saved"])
def test_a_recolored_thing_is_found_in_its_color(edited, saved):
    scene = edited[saved]
    for phrase in ("red mug", "is the mug red?"):
        assert (scene.find(phrase).present, scene.find(phrase).count) == ("yes", 1), phrase
    assert scene.find("blue mug").present != "yes"
    assert "mug" in [each.phrase for each in scene.find("red thing").instances]


def test_a_recolored_thing_is_preferred_to_another_one_of_that_color(demo):
    editor = Editor(demo)
    editor.recolor(demo.select("apple"), "yellow")
    for phrase in ("yellow apple", "is the apple yellow?"):  # language finds the duck and the banana
        found, apple = editor.scene.find(phrase).mask, editor.scene.find("apple").mask
        assert int((found & apple).sum()) > 0.99 * int((found | apple).sum())


def test_remains_too_faint_to_be_seen_are_nothing_whatever_they_are_called(demo):
    editor = Editor(demo)
    editor.delete(demo.select("bottle"))
    for phrase in ("bottle", "glass", "green glass", "bottle of wine"):
        assert editor.scene.find(phrase).present == "no", phrase


def test_the_mask_of_a_recolored_thing_is_that_of_the_thing(edited):
    scene = edited[0]
    red, mug = (scene.relevancy(phrase, "view_057")[0] >= 0.5 for phrase in ("red mug", "mug"))
    assert int(mug.sum()) > 500
    assert int((red & mug).sum()) > 0.9 * int((red | mug).sum())


def test_the_built_scene_knows_its_apple_and_undo_brings_it_back(demo):
    editor = Editor(demo)
    editor.delete(demo.select("apple"), fill=False)
    assert editor.scene.find("apple").present == "no"
    editor.undo()
    assert editor.scene.find("apple").present == "yes"
    assert not gone_nouns(demo)


def test_what_is_left_of_two_is_not_gone(demo):
    editor = Editor(demo)
    editor.duplicate(demo.select("apple"), Motion((1.3, 0, 0)))
    copy = max(editor.scene.select("apple").instances, key=lambda each: each.center[0])
    editor.delete(copy, fill=False)
    assert editor.scene.find("apple").count == 1
    assert not gone_nouns(editor.scene)


def test_a_library_answers_as_the_edited_scene_does(edited, tmp_path):
    folder = edited[1].folder
    library = Library.create(tmp_path / "library")
    library.add(folder.root)
    assert [hit.answer["present"] for hit in library.search("banana").hits] == ["yes"]
    assert not library.search("apple").hits
    assert [hit.answer["present"] for hit in library.search("red mug").hits] == ["yes"]


def test_damaged_records_of_what_is_gone_are_left_out(edited, tmp_path):
    copy = Path(shutil.copytree(edited[1].folder.root, tmp_path / "copy"))
    record = json.loads((copy / "scene.json").read_text())
    assert record["gone"] == ["apple"]
    for damaged in ({"apple": 1}, "apple", [["apple"], 3], None):
        (copy / "scene.json").write_text(json.dumps({**record, "gone": damaged}))
        assert open_scene(copy, device="cpu").find("banana").present == "yes"


@pytest.mark.parametrize(
    ("phrase", "noun"),
    [
        ("red apples", "apple"),
        ("apple stem", "apple"),
        ("toy car", "car"),
        ("stack of books", "stack"),
        ("Mug", "mug"),
        ("bottle of wine", "bottle"),
        (" of mug", "mug"),
        ("plant leaves", "plant"),
        ("something made of glass", "made"),
    ],
)
def test_the_noun_of_a_phrase_is_its_thing_in_the_singular(phrase, noun):
    assert noun_of(phrase) == noun
