"""A library answers from what it keeps of a scene, as the scene itself would."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from support.language_scene import CENTERS, RADIUS
from support.library_scenes import OTHERS, THINGS, copied, install, write_scene

import lexsplat
from lexsplat import cli, open_scene
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.phrases import Thing
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.files import read_json, write_json
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.contents import Contents
from lexsplat.scenes.library.indexed import decidable

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("room_encoders")]


@pytest.fixture(scope="module")
def segmented_rooms(tmp_path_factory) -> Path:
    """Two scenes of five balls, each of them a segment, and a library of them; read-only."""
    root = tmp_path_factory.mktemp("rooms")
    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        library = Library.create(root / "library")
        for name, things in (("kitchen", ()), ("office", (OTHERS,))):
            write_scene(root / name, *things, segments=True)
            library.add(root / name)
    return root


@pytest.fixture
def segmented_copy(segmented_rooms, tmp_path) -> Path:
    return copied(segmented_rooms, tmp_path / "rooms")


@pytest.mark.parametrize("phrase", ["mug 3", "qzx", "which tyos are here?", "the first mug"])
def test_words_that_an_encoder_does_not_know_are_left_to_the_scene(phrase):
    assert decidable("mug", "bundled") == Thing("mug")
    assert decidable(phrase, "bundled") is None


def closed(library: Library) -> Library:
    """The library, that opens no scene."""
    fresh = Library(library.root)
    fresh.scene = lambda name: pytest.fail(f"{name} was opened")
    return fresh


# -- it answers as the scene does


@pytest.mark.slow
def test_presence_is_that_of_the_scene_and_counts_and_places_nearly_always(demo_library):
    scene = open_scene("demo")
    colored = ["green apple", "red apple", "yellow banana", "white vase", "mug handle", "toy", "fruit"]
    colored += [
        f"{color} {name}" for color in ("blue", "red", "yellow") for name in ("apple", "teddy bear", "mug")
    ]
    words = list(dict.fromkeys([*default_vocabulary("bundled"), *everyday_words()[::9], *colored]))
    scene.embed(words)
    presences, counts, apart, sizes, scores = [], [], [], [], []
    for word in words:
        expected = find_phrase(scene, word)
        hits = demo_library.search(word).hits
        found = hits[0].answer if hits else {"present": "no", "count": 0, "instances": []}
        presences.append(found["present"] == expected["present"])
        if hits and hits[0].source == "index":
            counts.append(found["count"] == expected["count"])
            for one, other in zip(found["instances"], expected["instances"] if counts[-1] else ()):
                away = np.linalg.norm(np.subtract(one["center"], other["center"]))
                apart.append(away / max(other["size"]))
                sizes.append(np.prod(one["size"]) ** (1 / 3) / np.prod(other["size"]) ** (1 / 3))
                scores.append(abs(one["score"] - other["score"]))
    assert len(words) > 120
    assert len(counts) > 25
    assert np.mean(presences) >= 0.98
    assert np.mean(counts) >= 0.9
    assert np.median(apart) < 0.05
    assert np.quantile(apart, 0.9) < 0.15
    assert 0.8 < np.quantile(sizes, 0.1) <= np.quantile(sizes, 0.9) < 1.2
    assert np.median(scores) < 0.006
    assert np.quantile(scores, 0.9) < 0.03


@pytest.mark.parametrize(
    ("word", "ball"), [("apple", 0), ("mug", 1), ("banana", 2), ("vase", 3), ("lamp", 4)]
)
def test_a_ball_is_where_it_was_made(segmented_rooms, word, ball):
    (hit,) = closed(Library(segmented_rooms / "library")).search(word).hits
    assert (hit.scene, hit.source, hit.present, hit.count) == ("kitchen", "index", "yes", 1)
    (thing,) = hit.answer["instances"]
    np.testing.assert_allclose(thing["center"], CENTERS[ball], atol=0.2 * RADIUS)
    np.testing.assert_allclose(thing["size"], 2 * RADIUS, rtol=0.3)
    (expected,) = find_phrase(open_scene(segmented_rooms / "kitchen"), word)["instances"]
    np.testing.assert_allclose(thing["center"], expected["center"], atol=0.01 * RADIUS)
    np.testing.assert_allclose(thing["size"], expected["size"], rtol=0.01)
    assert thing["gaussians"] == expected["gaussians"]


def test_things_of_one_name_that_are_apart_are_several(tmp_path):
    write_scene(tmp_path / "room", ("mug", "mug", "banana", "vase", "lamp"), segments=True)
    library = Library.create(tmp_path / "library")
    library.add(tmp_path / "room")
    (hit,) = closed(library).search("mug").hits
    assert hit.count == 2
    found = sorted(thing["center"][0] for thing in hit.answer["instances"])
    np.testing.assert_allclose(found, sorted(CENTERS[:2, 0]), atol=0.2 * RADIUS)


def test_a_thing_that_is_in_no_scene_is_in_none_without_opening_one(segmented_rooms):
    found = closed(Library(segmented_rooms / "library")).search("piano")
    assert (found.hits, found.opened) == ((), 0)


def test_a_picture_frames_the_thing_without_opening_the_scene(segmented_rooms, tmp_path):
    (hit,) = closed(Library(segmented_rooms / "library")).search("mug").hits
    scene = open_scene(segmented_rooms / "kitchen")
    camera = scene.camera(hit.answer["best_view"])
    middle = camera.K @ (camera.viewmat[:3, :3] @ CENTERS[1] + camera.viewmat[:3, 3])
    x, y = middle[:2] / middle[2]
    left, upper, right, lower = hit.indexed.frame
    assert left < x < right
    assert upper < y < lower
    assert (right - left) < 2.2 * (2 * RADIUS * camera.K[0, 0] / middle[2])
    red = np.array(hit.picture()).astype(int)
    assert ((red[..., 0] > 200) & (red[..., 1] < 60)).sum() > 10
    assert hit.write_picture(tmp_path) == tmp_path / "kitchen" / "mug.jpg"


def test_kinds_are_answered_by_the_names_of_objects(demo_library):
    (hit,) = closed(demo_library).search("toy").hits
    expected = find_phrase(open_scene("demo"), "toy")
    assert hit.count == expected["count"]
    assert [one["name"] for one in hit.answer["instances"]] == [one["name"] for one in expected["instances"]]


# -- what it leaves to the scene


@pytest.mark.parametrize(
    "phrase", ["mug next to the vase", "mug or candle", "largest mug", "two mugs", "mugg"]
)
def test_relations_and_corrected_words_are_answered_by_the_scenes(segmented_rooms, phrase):
    library = Library(segmented_rooms / "library")
    for name in ("kitchen", "office"):
        expected = find_phrase(open_scene(segmented_rooms / name), phrase)
        found = {hit.scene: hit for hit in library.search(phrase).hits}
        assert (name in found) == (expected["present"] != "no")
        if name in found:
            assert found[name].source == "scene"
            assert found[name].answer == expected


def test_to_confirm_is_to_ask_the_scene(segmented_rooms):
    library = lexsplat.open_library(segmented_rooms / "library")
    found = library.search("mug", confirm=True)
    assert [hit.source for hit in found.hits] == ["scene"]
    assert found.opened >= 1
    assert found.hits[0].answer == find_phrase(open_scene(segmented_rooms / "kitchen"), "mug")


def test_a_rebuilt_scene_is_asked_itself(segmented_copy):
    write_scene(segmented_copy / "kitchen", THINGS[::-1], build=2, segments=True)
    (hit,) = Library(segmented_copy / "library").search("mug").hits
    assert (hit.scene, hit.source) == ("kitchen", "scene")
    np.testing.assert_allclose(hit.answer["instances"][0]["center"], CENTERS[3], atol=0.2 * RADIUS)


def test_a_vanished_scene_is_reported_and_not_answered_from_memory(segmented_copy):
    shutil.rmtree(segmented_copy / "kitchen")
    found = Library(segmented_copy / "library").search("mug")
    assert found.hits == ()
    assert "no such folder" in found.skipped["kitchen"]


def test_a_scale_that_was_set_after_adding_gives_meters(segmented_copy):
    library = closed(Library(segmented_copy / "library"))
    record = read_json(segmented_copy / "kitchen" / "scene.json")
    (before,) = library.search("mug").hits[0].answer["instances"]
    world = {**open_scene(segmented_copy / "kitchen").world.to_json(), "meters_per_unit": 0.5, "poses": "x"}
    write_json(segmented_copy / "kitchen" / "scene.json", {**record, "world": world})
    hit = library.search("mug").hits[0]
    assert hit.to_dict()["meters_per_unit"] == 0.5
    assert hit.answer["instances"][0]["size_meters"] == pytest.approx(
        [side / 2 for side in before["size"]], abs=1e-4
    )
    assert "m." in repr(hit)


def test_boxes_stand_upright_after_the_up_direction_was_set(segmented_copy):
    assert cli.main(["scale", str(segmented_copy / "kitchen"), "--up", "1,0,0"]) == 0
    hit = Library(segmented_copy / "library").search("mug").hits[0].to_dict()
    assert hit["up"]["direction"] == pytest.approx([1, 0, 0])
    assert hit["instances"][0]["axes"][2] == pytest.approx([1, 0, 0], abs=1e-4)


def test_entries_of_a_library_without_segments_answer_by_their_scenes(segmented_copy):
    for path in (segmented_copy / "library" / "scenes").glob("*.json"):
        record = read_json(path)
        record.pop("contents"), record.pop("hash")
        write_json(path, record)
    (hit,) = Library(segmented_copy / "library").search("mug").hits
    assert (hit.scene, hit.source) == ("kitchen", "scene")


def test_a_scene_that_was_built_as_in_the_paper_is_asked_as_when_it_is_opened(tmp_path):
    room = write_scene(tmp_path / "room", segments=True)
    record = read_json(room / "scene.json")
    write_json(room / "scene.json", {**record, "config": {**record["config"], "as_in_paper": True}})
    library = Library.create(tmp_path / "library")
    library.add(room)
    assert library.scene("room").query == open_scene(room, device="cpu").query
    (hit,) = library.search("mug").hits
    assert hit.source == "scene", "what is kept would be asked by segments"


# -- damage


@pytest.mark.parametrize("harm", ["bit", "cut", "gone", "empty"])
def test_damaged_objects_are_refused_and_repaired(segmented_copy, harm):
    (path,) = (segmented_copy / "library" / "scenes").glob("kitchen.*.objects.safetensors")
    before = path.read_bytes()
    middle = len(before) // 2
    changed = {
        "bit": before[:middle] + bytes([before[middle] ^ 1]) + before[middle + 1 :],
        "cut": before[:-9],
    }
    path.write_bytes(changed.get(harm, b"")) if harm != "gone" else path.unlink()
    library = Library(segmented_copy / "library")
    found = library.search("mug")
    assert found.hits == ()
    assert "--repair" in found.skipped["kitchen"]
    assert "\n" not in found.skipped["kitchen"]
    assert library.verify().keys() == {"kitchen"}
    assert library.verify(repair=True) == {}
    assert path.read_bytes() == before
    assert [hit.source for hit in Library(library.root).search("mug").hits] == ["index"]


def test_equal_scenes_have_equal_bytes(demo_library):
    record = demo_library.record("demo")
    first, second = Contents.of(open_scene(BUNDLED_SCENE)), demo_library.contents(record)
    assert first.content() == second.content() == record.contents
    assert all(torch.equal(first.tensors()[name], value) for name, value in second.tensors().items())


# -- what people and programs read


def test_an_answer_is_read_by_people_and_by_programs(segmented_rooms):
    found = lexsplat.open_library(segmented_rooms / "library").search("mug")
    said = repr(found)
    assert said.startswith(
        'mug: present: yes, in 1 of 2 scenes (understood as "mug")\n  1. kitchen: present: yes. 1 found'
    )
    assert "Size: 0." in said
    assert "best seen in view" in said
    (row,) = found.rows()
    assert (row["phrase"], row["scene"], row["present"], row["count"]) == ("mug", "kitchen", "yes", 1)
    assert [row["x"], row["y"], row["z"]] == found.hits[0].answer["instances"][0]["center"]
    assert json.loads(json.dumps(found.to_dict()))["hits"][0]["source"] == "index"
