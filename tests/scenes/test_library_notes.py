"""A library tells what it searched, what it did not understand, and where it is gone."""

import json
import shutil
from pathlib import Path

import pytest
from support.library_scenes import OTHERS, copied, install, write_scene
from support.schemas import validated

from lexsplat import cli, open_scene
from lexsplat.runtime.errors import LibraryError
from lexsplat.runtime.files import read_json, write_json
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.library import Library

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("room_encoders")]

QUESTIONS = ("🍎🦆", "где утка", "why is the sky blue", "bananna", "mug or dog", "unicorn", "red apple")


@pytest.fixture(scope="module")
def two_rooms(tmp_path_factory) -> Path:
    """A kitchen with a mug and a banana, an office with neither, and a library of them; read-only."""
    root = tmp_path_factory.mktemp("rooms")
    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        library = Library.create(root / "library")
        for name, things in (("kitchen", None), ("office", OTHERS)):
            library.add(write_scene(root / name, *([things] if things else [])))
    return root


@pytest.mark.parametrize("phrase", QUESTIONS)
def test_a_library_of_one_scene_reports_of_a_phrase_what_the_scene_reports(demo_library, phrase):
    expected, found = find_phrase(open_scene("demo"), phrase), demo_library.search(phrase).to_dict()
    validated("library", {"library": "x", "phrases": [found]})
    told = ("present", "understood", "note")
    assert {key: found[key] for key in told} == {key: expected[key] for key in told}
    for hit in found["hits"]:
        assert {key: hit[key] for key in told} == {key: expected[key] for key in told}


def test_a_word_that_is_corrected_without_success_is_reported_with_what_was_searched(two_rooms):
    library = Library(two_rooms / "library")
    library.search("bananna")
    assert library.search("bananna").understood == '"banana"'
    missed = library.search("drumset or pinao")  # no scene has either
    assert (missed.present, missed.hits) == ("no", ())
    assert missed.note == 'also searched as ("drumset" or "piano")'
    assert library.search('"pinao"').note == ""  # in quotation marks: as it is


def test_an_encoder_without_a_hit_that_does_not_know_a_word_is_reported(tmp_path, demo_library_copy):
    library = Library(demo_library_copy)
    library.add(write_scene(tmp_path / "office", OTHERS))
    found = library.search("clock or 🍎🦆")
    assert [hit.scene for hit in found.hits] == ["office"]
    unknown = 'the bundled encoder knows English words alone, not "🍎🦆"'
    assert found.note == f'nothing fits "🍎🦆"; {unknown}'


def test_an_encoder_of_two_names_counts_as_one_encoder(tmp_path):
    library = Library.create(tmp_path / "library")
    for room, clip in (("office", "models/abc"), ("kitchen", "elsewhere/abc")):
        path = write_scene(tmp_path / room) / "scene.json"
        write_json(path, {**read_json(path), "config": {"clip": clip}})
        library.add(path.parent)
    assert {record.clip for record in library.records()} == {"models/abc", "elsewhere/abc"}
    found = library.search("dog")
    assert len(found.encoders) == len(library.groups()) == 1
    assert "in 0 of 2 scenes (" in repr(found)


def test_a_note_that_holds_for_some_scenes_alone_names_them(two_rooms):
    found = Library(two_rooms / "library").search("mug or candle")
    assert [hit.scene for hit in found.hits] == ["kitchen", "office"]
    assert set(found.note.split("; ")) == {
        'nothing fits "candle" (in kitchen)',
        'nothing fits "mug" (in office)',
    }


def test_no_is_said_only_if_all_scenes_were_asked_or_ruled_out(two_rooms, tmp_path):
    copy = copied(two_rooms, tmp_path / "rooms")
    library = Library(copy / "library")
    assert library.search("dog").present == "no"
    assert library.search("mug").present == "yes"
    shutil.rmtree(copy / "kitchen")
    found = library.search("mug")
    assert (found.present, found.hits, list(found.skipped)) == ("unsure", (), ["kitchen"])


def test_people_read_presence_and_what_was_understood(two_rooms, demo_library, capsys):
    library = str(two_rooms / "library")
    assert cli.main(["library", "search", library, "bananna", "mug", "--thumbnails", "none"]) == 0
    said = capsys.readouterr().out
    assert 'bananna: present: yes, in 1 of 2 scenes (understood as "banana")' in said
    assert '"bananna" may be a typing error: asked for "banana"' in said
    assert said.count("typing error") == 1
    assert 'mug: present: yes, in 1 of 2 scenes (understood as "mug")\n' in said
    assert cli.main(["library", "search", str(demo_library.root), "🍎🦆", "--json"]) == 0
    (answer,) = json.loads(capsys.readouterr().out)["phrases"]
    assert (answer["present"], answer["understood"]) == ("no", '"🍎🦆"')
    assert "English words alone" in answer["note"]
    assert "in 0 of 1 scene (" in repr(demo_library.search("🍎🦆"))
    assert "English words alone" in repr(demo_library.search("🍎🦆"))


@pytest.mark.parametrize("gone", ["library", "library/scenes"])
def test_a_library_that_is_gone_while_it_is_open_is_reported_until_it_is_back(two_rooms, tmp_path, gone):
    copy = copied(two_rooms, tmp_path / "rooms")
    library = Library(copy / "library")
    assert library.search("mug").present == "yes"
    (copy / gone).rename(copy / "elsewhere")
    for question in (lambda: library.search("mug"), library.names, library.records):
        with pytest.raises(LibraryError) as error:
            question()
        assert str(copy / gone) in str(error.value)
        assert "moved or deleted" in error.value.found
        assert "restore the folder" in error.value.remedy
    assert not (copy / gone).exists()
    assert repr(library).endswith("gone)")
    (copy / "elsewhere").rename(copy / gone)
    assert library.search("mug").present == "yes"


def test_a_new_library_holds_no_scene(tmp_path):
    library = Library.create(tmp_path / "library")
    assert library.names() == []
    found = library.search("mug")
    assert (found.present, found.scenes) == ("no", 0)
    assert repr(found).startswith("mug: present: no, in 0 of 0 scenes")
