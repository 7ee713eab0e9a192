"""A library of scenes: it agrees with its scenes, keeps encoders apart, and is whole whatever happens to it."""

import json
import shutil

import numpy as np
import pytest
import torch
from support.forks import PROCESSES
from support.library_scenes import OTHERS, contents, hits, write_scene

import lexsplat
from lexsplat import open_scene
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.grammar import understand
from lexsplat.queries.presence import NO_PART, NO_SEGMENT
from lexsplat.queries.relevancy import gaussian_relevancy
from lexsplat.runtime.errors import LibraryError, QueryError, SceneFolderError
from lexsplat.runtime.files import read_json, write_json
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.bounds import SURELY_NOT, phrase_bound, presence_bounds
from lexsplat.scenes.library.entries import Codes
from lexsplat.scenes.library.searching import spellings_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("room_encoders")]


# -- searching


def test_scenes_that_hold_a_thing_are_found_whatever_their_encoder(rooms):
    library = lexsplat.open_library(rooms / "library")
    found = library.search("mug")
    assert {hit.scene for hit in found.hits} == {"kitchen", "lab"}
    assert {hit.to_dict()["encoder"] for hit in found.hits} == {"models/abc", "models/def"}
    assert (found.scenes, found.opened, found.unopened, found.skipped) == (3, 2, 0, {})
    assert sorted(hits(library, "candle")) == ["lab", "office"]
    assert hits(library, "piano") == []


def test_a_library_answers_as_its_scenes_do(rooms):
    library = lexsplat.open_library(rooms / "library")
    for phrase in ("mug", "mug and vase", "largest chair", "vase next to lamp", "dog"):
        expected = {}
        for name in ("kitchen", "office", "lab"):
            answer = find_phrase(open_scene(rooms / name), phrase)
            if answer["present"] != "no":
                expected[name] = answer
        assert {hit.scene: hit.answer for hit in library.search(phrase).hits} == expected, phrase


def test_no_scene_is_ruled_out_that_holds_the_thing():
    """The bound is at least the strength of presence, for any word: otherwise the two stages would disagree."""
    scene, words = open_scene("demo"), list(everyday_words()[::20])
    question = scene.question(words)
    scores = gaussian_relevancy(scene.field, question)
    strengths = [
        each.strength for each in scene.presence_classifier.evidence(words, question.positives, scores)
    ]
    bounds = presence_bounds([Codes.of(scene)], scene.embed(words))[0]
    assert (bounds >= np.array(strengths) - 0.005).all()
    assert np.corrcoef(bounds, strengths)[0, 1] > 0.95
    assert sum(strength >= NO_SEGMENT for strength in strengths) > 2  # both kinds are among the words
    assert (bounds < NO_SEGMENT).sum() > 30


def test_bounds_are_those_of_a_loop_in_float64():
    rng = np.random.default_rng(0)
    units = rng.normal(size=(7, 5))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    mean, limits, shares = (
        rng.normal(size=5) / 5,
        rng.uniform(0.1, 0.3, 7),
        np.array([0.5, 0, 0.1, 0.1, 0.1, 0.1, 0.1]),
    )
    tensors = [torch.from_numpy(array).float() for array in (units, units @ mean, limits, shares)]
    codes, text = Codes(tensors[0].half(), *tensors[1:], torch.zeros(6)), rng.normal(size=5)
    unit = text / np.linalg.norm(text)
    cosines = [float(np.float16(units[k]) @ unit) - float(units[k] @ mean) for k in range(7)]
    offset = np.quantile(cosines, 0.4)
    expected = max(0.0, *((cosines[k] - offset) / limits[k] for k in range(7) if shares[k] > 0))
    found = presence_bounds([codes, codes], torch.from_numpy(text)[None])
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize(
    ("phrase", "bound"),
    [
        ("mug", 0.9),
        ("mug on the table", 0.5),
        ("mug or dog", 0.9),
        ("mug without the dog", 0.9),
        ("largest dog", 0.1),
        ("two mugs next to the table", 0.5),
        ("what is on the table?", 0.5),
        ("everything", 2.0),
    ],
)
def test_the_bound_of_a_phrase_follows_from_those_of_its_things(phrase, bound):
    known = {"mug": np.array([0.9]), "table": np.array([0.5]), "dog": np.array([0.1])}
    assert np.max(phrase_bound(understand(phrase).phrase, known)) == pytest.approx(bound)


def test_a_scene_is_not_ruled_out_for_a_part_that_it_may_hold():
    for text, strength in (("mug handle", NO_PART), ("mug", NO_SEGMENT), ("candle holder", NO_SEGMENT)):
        held, missing = (np.array([strength + change]) for change in (0.0, -0.02))
        phrase = understand(text).phrase
        assert float(phrase_bound(phrase, {text: held})[0]) >= SURELY_NOT
        assert float(phrase_bound(phrase, {text: missing})[0]) < SURELY_NOT


def test_a_kind_is_compared_by_the_names_of_its_members_as_the_scenes_answer_it():
    compared = spellings_of(understand("toy next to mug").phrase, "bundled")
    assert {"toy", "rubber duck", "teddy bear", "toy car"} <= set(compared["toy"])
    assert compared["mug"] == ("mug",)
    typed = spellings_of(understand("tyos").phrase, "bundled")["tyos"]
    assert {"toy", "rubber duck", "teddy bear"} <= set(typed), "corrections are compared as well"


def test_the_order_and_the_bits_of_an_answer_do_not_depend_on_the_number_of_threads(rooms):
    library = lexsplat.open_library(rooms / "library")
    codes, texts = [library.codes(record) for record in library.records()], torch.randn(3, 96)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(presence_bounds(codes, texts))
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(*found)


@pytest.mark.parametrize("limit", [0, 1.5, "3", None])
def test_a_limit_that_is_no_number_of_scenes_is_refused(rooms, limit):
    with pytest.raises(QueryError, match="limit: expected a whole number of at least 1"):
        lexsplat.open_library(rooms / "library").search("mug", limit=limit)


def test_a_search_is_for_one_phrase(rooms):
    library = lexsplat.open_library(rooms / "library")
    assert library.search(["mug"]) == library.search("mug")
    with pytest.raises(QueryError, match="expected one phrase, found 2"):
        library.search(["mug", "violin"])


def test_a_device_that_is_none_is_refused_at_once(rooms):
    with pytest.raises(ValueError, match="device"):
        lexsplat.open_library(rooms / "library", device="gpu")


def test_a_limit_leaves_the_best_scenes_and_reports_of_the_others(rooms):
    library = lexsplat.open_library(rooms / "library")
    found = library.search("mug", limit=1)
    assert len(found.hits) == 1
    assert found.hits[0].bound == max(hit.bound for hit in library.search("mug").hits)
    assert (found.opened, found.unopened) == (1, 1)


def test_a_hit_has_a_picture_with_a_frame_around_the_thing(rooms, tmp_path):
    hit = lexsplat.open_library(rooms / "library").search("mug").hits[0]
    path = hit.write_picture(tmp_path)
    assert path == tmp_path / hit.scene / "mug.jpg"
    assert (
        np.array(hit.picture()).tolist()
        != np.array(hit.opened.render(hit.answer["best_view"]).image).tolist()
    )
    red = (np.array(hit.picture()) == (255, 0, 0)).all(-1)
    assert 20 < red.sum() < red.size / 2


@pytest.mark.parametrize("phrase", ["", "   ", 7, ["mug"] * 0])
def test_no_phrase_is_refused(rooms, phrase):
    with pytest.raises(QueryError):
        lexsplat.open_library(rooms / "library").search(phrase)


def test_scenes_whose_encoder_is_gone_are_reported_and_the_others_answer(rooms_copy, monkeypatch):
    from lexsplat.runtime.errors import ModelError

    known = Library.create.__globals__["load_text"]

    def load(name, *rest):
        if "def" in name:
            raise ModelError(name, expected="a model", found="nothing")
        return known(name, *rest)

    monkeypatch.setattr("lexsplat.scenes.library.library.load_text", load)
    found = Library(rooms_copy / "library").search("mug and griffin")  # a word that is in no cache
    assert [hit.scene for hit in found.hits] == ["kitchen"]
    assert "expected a model" in found.skipped["lab"]


def test_another_encoder_under_the_same_name_is_refused(rooms_copy, monkeypatch):
    from support.library_scenes import Tower

    monkeypatch.setattr("lexsplat.scenes.library.library.load_text", lambda *_: Tower("other"))
    found = Library(rooms_copy / "library").search("griffin")
    assert set(found.skipped) == {"kitchen", "office", "lab"}
    assert all("found another one" in problem for problem in found.skipped.values())


# -- changing


def test_equal_additions_make_equal_files_and_touch_no_other_scene(rooms_copy):
    first, second = Library.create(rooms_copy / "first"), Library.create(rooms_copy / "second")
    first.add(rooms_copy / "kitchen")
    before = contents(first.stage)
    first.add(rooms_copy / "office")
    after = contents(first.stage)
    assert {name: after[name] for name in before} == before
    for name in ("office", "kitchen"):
        second.add(rooms_copy / name)
    assert contents(second.stage) == after


def test_scenes_of_one_name_get_numbers_and_one_folder_is_one_scene(tmp_path):
    for place in ("north", "south"):
        write_scene(tmp_path / place / "room 1")
    library = Library.create(tmp_path / "library")
    assert library.add(tmp_path / "north" / "room 1").name == "room_1"
    assert library.add(tmp_path / "south" / "room 1").name == "room_1-2"
    assert library.add(tmp_path / "north" / ".." / "north" / "room 1").name == "room_1"
    assert library.names() == ["room_1", "room_1-2"]


def test_a_removed_scene_leaves_no_file_and_stays_itself(rooms_copy):
    library = Library(rooms_copy / "library")
    assert library.remove(str(rooms_copy / "kitchen")) == "kitchen"
    assert not list(library.stage.glob("kitchen*"))
    assert hits(library, "vase") == []
    open_scene(rooms_copy / "kitchen")
    with pytest.raises(LibraryError, match="no such scene; it has 2 scenes: lab, office"):
        library.remove("kitchen")


def test_an_open_library_sees_what_another_process_adds_and_removes(rooms_copy):
    reader, writer = Library(rooms_copy / "library"), Library(rooms_copy / "library")
    assert hits(reader, "vase") == ["kitchen"]
    writer.remove("kitchen")
    assert hits(reader, "vase") == []
    writer.add(rooms_copy / "kitchen")
    assert hits(reader, "vase") == ["kitchen"]


def test_the_bundled_scene_is_known_by_its_word(demo_library_copy):
    library = Library(demo_library_copy)
    (record,) = library.records()
    assert (record.name, record.path, record.folder(library.root)) == ("demo", "demo", BUNDLED_SCENE)
    assert library.remove("demo") == "demo"


# -- what happens to scenes


def test_a_library_that_moved_with_its_scenes_finds_them(rooms_copy):
    moved = rooms_copy.rename(rooms_copy.with_name("elsewhere"))
    library = Library(moved / "library")
    assert hits(library, "vase") == ["kitchen"]
    events = []
    library.listener = events.append
    assert library.verify() == {}
    steps = [(event.stage, event.done) for event in events]
    assert steps == [("verify", done) for done in range(len(library.names()) + 1)]


def test_a_scene_that_moved_alone_is_reported_and_added_under_its_name(rooms_copy):
    library = Library(rooms_copy / "library")
    (rooms_copy / "kitchen").rename(rooms_copy / "galley")
    for told in (library.search("griffin").skipped["kitchen"], library.verify()["kitchen"]):
        assert "no such folder; if it was moved: lexsplat library add" in told
        assert told.endswith(f"if it is gone: lexsplat library remove {library.root} kitchen")
    assert library.verify(repair=True).keys() == {"kitchen"}  # nothing is dropped
    assert library.add(rooms_copy / "galley").name == "kitchen"
    assert library.verify() == {}
    assert hits(library, "vase") == ["kitchen"]


def test_a_rebuilt_scene_is_reported_and_its_old_codes_are_dropped(rooms_copy):
    library = Library(rooms_copy / "library")
    write_scene(rooms_copy / "kitchen", OTHERS, build=2)
    assert "rebuilt since it was added" in library.verify()["kitchen"]
    assert hits(library, "vase") == []  # the scene itself is asked
    assert sorted(hits(library, "candle")) == ["kitchen", "lab", "office"]  # its old codes lack a candle
    found = Library(library.root).search("candle")
    assert found.rebuilt.keys() == {"kitchen"}
    assert f"note: {found.rebuilt['kitchen']}" in repr(found)
    assert f"lexsplat library add {library.root} {rooms_copy / 'kitchen'}" in found.rebuilt["kitchen"]
    assert library.verify(repair=True) == {}
    assert library.search("candle").rebuilt == {}
    assert sorted(hits(library, "candle")) == ["kitchen", "lab", "office"]
    assert len(list(library.stage.glob("kitchen.*.safetensors"))) == 1


def moved_edit(source, output, by):
    """A copy of a scene whose mug is moved; all of them have as many Gaussians."""
    editor = Editor(open_scene(source))
    editor.move(editor.scene.find("mug"), Motion(translation=by), fill=False)
    editor.save(output)


def test_another_edit_of_the_same_scene_is_not_taken_for_the_one_that_was_added(rooms_copy):
    library, place = Library(rooms_copy / "library"), rooms_copy / "edited"
    moved_edit(rooms_copy / "kitchen", place, (5.0, 0.0, 0.0))
    library.add(place)
    shutil.rmtree(place)
    moved_edit(rooms_copy / "kitchen", place, (0.0, 5.0, 0.0))
    assert "rebuilt since it was added" in library.verify()["edited"]
    expected = find_phrase(open_scene(place), "mug")
    found = {hit.scene: hit.answer for hit in library.search("mug").hits}
    assert found["edited"] == expected, "the scene itself is asked"
    moved_edit(rooms_copy / "kitchen", rooms_copy / "third", (0.0, 0.0, 5.0))
    place.rename(rooms_copy / "elsewhere")
    assert library.add(rooms_copy / "third").name == "third", "not the name of the lost one"


def test_edits_of_an_edited_scene_are_listed_after_its_own(rooms_copy):
    for source, output in (("kitchen", "once"), ("once", "twice")):
        moved_edit(rooms_copy / source, rooms_copy / output, (1.0, 0.0, 0.0))
    once, twice = (SceneFolder.open(rooms_copy / name).record for name in ("once", "twice"))
    assert len(once["edits"]) == 1
    assert twice["edits"] == once["edits"] * 2
    assert twice["edits_fingerprint"] != once["edits_fingerprint"]


def test_a_scene_that_was_only_copied_is_not_rebuilt(rooms_copy):
    (rooms_copy / "kitchen" / "scene.json").touch()
    library = Library(rooms_copy / "library")
    assert library.search("mug").rebuilt == library.verify() == {}


def test_a_scene_with_a_cut_record_is_reported_with_a_remedy(rooms_copy):
    (rooms_copy / "kitchen" / "scene.json").write_text("{")
    library = Library(rooms_copy / "library")
    for told in (library.search("griffin").skipped["kitchen"], library.verify()["kitchen"]):
        assert "scene.json: expected JSON" in told
        assert told.endswith(f" run the build again, or: lexsplat library remove {library.root} kitchen")


def test_a_scene_of_another_format_version_is_reported(rooms_copy):
    record = read_json(rooms_copy / "kitchen" / "scene.json")
    write_json(rooms_copy / "kitchen" / "scene.json", {**record, "format_version": 99})
    library = Library(rooms_copy / "library")
    assert "format_version 1, found 99" in library.search("vase").skipped["kitchen"]
    with pytest.raises(SceneFolderError, match="found 99"):
        library.add(rooms_copy / "kitchen")


def test_long_names_of_any_alphabet_are_names(tmp_path):
    library = Library.create(tmp_path / "library")
    name = library.add(write_scene(tmp_path / ("写" * 80))).name
    assert name == "写" * 26
    assert hits(library, "mug") == [name]


def test_people_read_a_few_problems_and_their_number(rooms_copy):
    for number in range(8):
        shutil.copytree(rooms_copy / "kitchen", rooms_copy / f"room{number}")
    library = Library(rooms_copy / "library")
    for number in range(8):
        library.add(rooms_copy / f"room{number}")
    for number in range(8):
        shutil.rmtree(rooms_copy / f"room{number}")
    found = library.search("griffin")
    assert len(found.skipped) == 8
    assert repr(found).count("\n  skipped: ") == 6
    assert repr(found).endswith("3 more; lexsplat library verify LIB names them")
    assert found.encoders == ("models/abc", "models/def")
    assert "scenes of 2 encoders" in repr(found)


def test_a_folder_that_is_no_library_is_refused(tmp_path, rooms_copy):
    with pytest.raises(LibraryError, match="no such folder; make one with: lexsplat library add"):
        lexsplat.open_library(tmp_path / "nowhere")
    with pytest.raises(LibraryError, match="other files"):
        Library.create(rooms_copy / "kitchen")
    for facts in ({"format_version": 1, "name": "../x"}, [], {}, {"a": "\ud800"}):
        (rooms_copy / "library" / "library.json").write_text(json.dumps(facts))
        with pytest.raises(LibraryError, match=r"expected format_version 1 .* --repair"):
            Library(rooms_copy / "library")
    later = {"format_version": 2, "name": "x"}
    write_json(rooms_copy / "library" / "library.json", {**later, "hash": fingerprint(later)})
    for make in (Library, Library.create):
        with pytest.raises(LibraryError, match="found version 2; add the scenes to a new library"):
            make(rooms_copy / "library")


def test_a_scene_that_is_not_finished_is_refused_and_nothing_changes(rooms_copy):
    before = contents(rooms_copy / "library" / "scenes")
    SceneFolder(rooms_copy / "begun").save()
    with pytest.raises(SceneFolderError, match="finished stages"):
        Library(rooms_copy / "library").add(rooms_copy / "begun")
    assert contents(rooms_copy / "library" / "scenes") == before


def _hold(root, ready, release):
    with Library(root).changing():
        ready.set()
        release.wait(60)


@pytest.mark.slow
def test_a_second_writer_is_refused_and_readers_are_not(rooms_copy):
    ready, release = PROCESSES.Event(), PROCESSES.Event()
    process = PROCESSES.Process(target=_hold, args=(rooms_copy / "library", ready, release))
    process.start()
    try:
        assert ready.wait(120)
        library = Library(rooms_copy / "library")
        for change in (lambda: library.add(rooms_copy / "kitchen"), lambda: library.remove("kitchen")):
            with pytest.raises(LibraryError, match=f"process {process.pid} at work"):
                change()
        assert sorted(hits(library, "mug")) == ["kitchen", "lab"]
    finally:
        release.set()
        process.join()
    library.add(rooms_copy / "kitchen")


def test_a_full_disk_is_reported_and_the_entry_stays(rooms_copy, monkeypatch):
    before = contents(rooms_copy / "library" / "scenes")
    write_scene(rooms_copy / "kitchen", OTHERS, build=2)
    library = Library(rooms_copy / "library")
    full = OSError(28, "No space left on device", "scenes/kitchen.json")
    for step in ("write_tensors", "write_record"):
        with monkeypatch.context() as patch:
            patch.setattr(f"lexsplat.scenes.library.entries.{step}", lambda *_: (_ for _ in ()).throw(full))
            with pytest.raises(LibraryError, match="No space left on device; run the command again"):
                library.add(rooms_copy / "kitchen")
        kept = {name: data for name, data in contents(library.stage).items() if name in before}
        assert kept == before
    library.add(rooms_copy / "kitchen")
    assert library.verify() == {}
