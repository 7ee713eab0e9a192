"""The language that the embedded encoders are trained on says what is true: phrases, crops, held-out pairs."""

from __future__ import annotations

import json
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

TOOLS = Path(__file__).resolve().parents[1] / "tools"
SCENES = Path(str(resources.files("lexsplat"))) / "demo" / "scenes"


@pytest.fixture(scope="module", autouse=True)
def tools_on_path():
    sys.path[:0] = [str(TOOLS / "train_encoders"), str(TOOLS / "demo_scene")]
    yield
    for folder in ("train_encoders", "demo_scene"):
        sys.path.remove(str(TOOLS / folder))


def labels():
    from words import COLOURS, NAMES, OWNERS, Label

    finishes = {"table": "wooden", "wall": "brick", "cloth": "checkered", "floor": "tiled"}
    parts = {kind: [None] + [part for part, owners in OWNERS.items() if kind in owners] for kind in NAMES}
    return [
        Label(kind, colour, finishes.get(kind), part)
        for kind in NAMES
        for colour in COLOURS
        for part in parts[kind]
    ]


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_phrase_made_for_a_label_is_true_of_it(seed):
    from words import TRUE, phrase_for

    rng = np.random.default_rng(seed)
    everything = labels()
    label = everything[int(rng.integers(len(everything)))]
    assert phrase_for(label, rng).of(label) == TRUE


@pytest.mark.parametrize(
    ("words", "wanted", "truth"),
    [
        ("red mug", {"kind": "mug", "colour": "red"}, {"red mug": 1, "blue mug": 0, "red apple": 0}),
        ("mug handle", {"kind": "mug", "part": "handle"}, {"red mug": 0, "red mug handle": 1}),
        ("something red", {"colour": "red"}, {"red apple": 1, "red apple stalk": -1, "blue mug": 0}),
        ("fruit", {"quality": "fruit"}, {"red apple": 1, "red apple stalk": 1, "orange pumpkin": 0}),
        ("metal", {"quality": "metal"}, {"gold ring": 1, "white candle saucer": 1, "white candle": 0}),
        ("yellow thing", {"colour": "yellow"}, {"gold ring": -1}),
    ],
)  # fmt: skip
def test_phrases_are_true_false_or_open_of_what_they_should(words, wanted, truth):
    from words import Label, Phrase

    phrase = Phrase(words, **wanted)
    for thing, expected in truth.items():
        colour, kind, *part = thing.split()
        assert phrase.of(Label(kind, colour, part=part[0] if part else None)) == expected, thing


def test_words_of_things_that_no_scene_holds_are_true_of_nothing():
    from words import FALSE, NAMES, UNKNOWN_TESTED, UNKNOWN_TRAINED, Phrase

    assert not set(UNKNOWN_TESTED) & set(UNKNOWN_TRAINED)
    known = {name for names in NAMES.values() for name in names}
    assert not known & {*UNKNOWN_TESTED, *UNKNOWN_TRAINED}
    assert all(Phrase("zebra", unknown=True).of(label) == FALSE for label in labels())


def test_no_scene_that_ships_holds_a_pair_kept_from_training():
    from layouts import LAYOUTS
    from words import HELD_OUT_PAIRS

    for layout in LAYOUTS.values():
        assert not HELD_OUT_PAIRS & {(place.kind, place.colour) for place in layout.placements}


def test_the_scene_for_choosing_shares_no_thing_place_or_camera_with_the_demo():
    from layouts import SECOND, TABLETOP

    for what in (
        lambda scene: {(place.kind, place.colour) for place in scene.placements},
        lambda scene: {(place.x, place.y) for place in scene.placements},
        lambda scene: {scene.cloth[0], scene.wall, scene.key_light, scene.seed},
        lambda scene: {pose.tobytes() for pose in scene.path.poses(scene.views)},
    ):
        assert not what(TABLETOP) & what(SECOND)
    # Words for one thing alone are of that scene alone; those of both mean other things in each.
    both = TABLETOP.prompts.keys() & SECOND.prompts.keys()
    assert all(TABLETOP.prompts[words].kind not in ("name", "colour") for words in both)


@pytest.mark.parametrize("scene", ["tabletop", "second"])
def test_the_language_covers_every_prompt_of_the_scenes_that_ship(scene):
    from words import COLOURS, NAMES, PARTS, QUALITIES

    single = {
        w
        for group in (NAMES, PARTS, COLOURS)
        for names in group.values()
        for name in names
        for w in name.split()
    }
    qualities = {
        w for q in QUALITIES.values() for phrase in (*q.phrases, *q.adjectives) for w in phrase.split()
    }
    for prompt in json.loads((SCENES / scene / "prompts.json").read_text()):
        assert set(prompt.split()) <= single | qualities, prompt


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_phrase_is_trained_that_names_a_pair_kept_from_training(seed):
    # It could only be wrong, and would be learnt as the name of nothing.
    from words import HELD_OUT_PAIRS, any_phrase, near_miss

    rng = np.random.default_rng(seed)
    shown = [label for label in labels() if (label.kind, label.colour) not in HELD_OUT_PAIRS]
    label = shown[int(rng.integers(len(shown)))]
    for phrase in (near_miss(label, rng), any_phrase(rng)):
        assert (phrase.kind, phrase.colour) not in HELD_OUT_PAIRS, phrase


def test_a_made_up_word_is_none_that_means_something():
    from words import _KNOWN_WORDS, _made_up_word

    rng = np.random.default_rng(0)
    words = {_made_up_word(rng) for _ in range(500)}
    assert len(words) > 300
    assert not words & _KNOWN_WORDS
    assert {"metal", "paper", "fur", "wooden"} <= _KNOWN_WORDS, "of these some can come of the syllables"


def test_turned_hues_take_red_to_green_and_leave_grey():
    from train_clip import turned_hues

    colours = np.array([[[200, 0, 0], [90, 90, 90], [0, 200, 0]]], np.uint8)
    turned = turned_hues(colours, 120.0).astype(int)
    assert np.abs(turned - [[[0, 200, 0], [90, 90, 90], [0, 0, 200]]]).max() <= 1


def test_no_hue_is_turned_so_that_a_kind_looks_as_it_was_kept_from_training():
    from train_clip import fair_angle
    from words import Label

    rng = np.random.default_rng(0)
    # Held out: the blue bear, at 220 degrees; a red one starts at 0.
    angles = [fair_angle([Label("teddy", "red")], rng) for _ in range(300)]
    assert all(abs(angle - 220) >= 25 for angle in angles)
    assert max(angles) > 250
    assert min(angles) < 60


def test_what_is_blue_is_not_told_to_be_no_bear_since_blue_bears_are_kept_from_training():
    from crops import cut
    from train_clip import leave_open
    from truth import TruthTable
    from words import FALSE, OPEN, TRUE, Label, Phrase

    shown = [Label("mug", "red"), Label("table", "blue")]
    crops = [cut(frame_of_two_halves(), left, 5.0, 20.0) for left in (0.0, 40.0)]
    phrases = [
        Phrase("bear", kind="teddy"), Phrase("something fluffy", quality="fluffy"), Phrase("red ball", kind="ball"),
        Phrase("table", kind="table"), Phrase("red", colour="red"),
    ]  # fmt: skip
    truth = TruthTable(shown).of(phrases, crops)
    assert truth.tolist() == [[FALSE, FALSE, FALSE, FALSE, TRUE], [FALSE, FALSE, FALSE, TRUE, FALSE]]
    leave_open(truth, phrases, crops, shown, np.zeros(2))
    assert truth.tolist() == [[FALSE, FALSE, FALSE, FALSE, TRUE], [OPEN, OPEN, FALSE, TRUE, FALSE]]


def test_texts_whose_colours_add_to_kinds_alike_cost_nothing():
    import torch
    from train_clip import composition_loss

    kinds, colours = torch.randn(2, 8), torch.randn(2, 8)
    corners = torch.stack([kinds[k] + colours[c] for k in (0, 1) for c in (0, 1)])
    assert float(composition_loss(corners)) == pytest.approx(0, abs=1e-10)
    corners[3] += torch.eye(8)[0]
    assert float(composition_loss(corners)) == pytest.approx(1, abs=1e-5)


def frame_of_two_halves():
    """Left half a red mug (thing 1), right half a blue table (thing 2)."""
    from crops import Frame

    things = np.ones((40, 60), np.uint8)
    things[:, 30:] = 2
    return Frame("scene", Image.new("RGB", (60, 40)), things.astype(np.int32) - 1, things)


def test_a_crop_shows_what_lies_around_its_middle():
    from crops import cut
    from truth import TruthTable
    from words import FALSE, OPEN, TRUE, Label, Phrase

    table = TruthTable([Label("mug", "red"), Label("table", "blue")])
    phrases = [Phrase("mug", kind="mug"), Phrase("blue table", kind="table", colour="blue")]
    frame = frame_of_two_halves()
    crops = [cut(frame, left, 5.0, 20.0) for left in (0.0, 40.0, 17.0, 23.5)]
    assert table.of(phrases, crops).tolist() == [[TRUE, FALSE], [FALSE, TRUE], [TRUE, OPEN], [OPEN, TRUE]]
    for crop in crops:
        assert crop.weights.sum() == pytest.approx(1)
        position = (np.arange(24) + 0.5) / 24 - 0.5
        line = np.exp(-(position**2) / (2 * 0.22**2))
        in_mug = crop.box[0] + (np.arange(24) + 0.5) * 20 / 24 < 30
        expected = line[in_mug].sum() / line.sum()
        assert float(crop.weights[crop.codes == 0].sum()) == pytest.approx(expected)


def frames_with_a_handle(scale=1):
    """A red mug with a handle of three by five pixels, times ``scale``, on a blue table."""
    from crops import Frame, Frames
    from words import Label

    frames = object.__new__(Frames)
    frames.labels = [Label("mug", "red"), Label("mug", "red", part="handle"), Label("table", "blue")]
    codes = np.full((60, 80), 2, np.int32)
    codes[20:40, 30:50] = 0
    codes[27:32, 50:53] = 1
    codes = codes.repeat(scale, 0).repeat(scale, 1)
    things = np.where(codes == 2, 2, 1).astype(np.uint8)
    frames.frames = [Frame("scene", Image.new("RGB", codes.shape[::-1]), codes, things)]
    return frames


def test_crops_of_parts_come_with_the_rest_of_the_thing_and_with_what_is_near():
    from crops import part_crops

    frames = frames_with_a_handle()
    assert list(frames.of_parts) == ["handle"], "the table and the mug's body are no parts"

    def middles(near):
        crops = part_crops(frames, 60, np.random.default_rng(0), near=near)
        return crops, [int(crop.grid[12, 12]) for crop in crops]

    crops, shown = middles(near=True)
    assert len(crops) == 60
    assert shown[0::3].count(1) >= 15, (
        "handles, unless the crop was moved into the frame or sampled beside it"
    )
    assert shown[1::3].count(0) >= 15, "bodies"
    assert shown[2::3].count(2) >= 8, "what is near"
    _, pairs = middles(near=False)
    assert pairs[0::2].count(1) >= 20
    assert pairs[1::2].count(0) >= 20


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_phrase_about_any_part_is_true_of_that_part_alone(seed):
    from words import TRUE, any_part

    phrase = any_part(np.random.default_rng(seed))
    true = [label for label in labels() if phrase.of(label) == TRUE]
    assert true
    assert {label.part for label in true} == {phrase.part}


def test_a_thin_part_in_the_very_middle_counts_as_shown_if_asked_for():
    from crops import cut
    from truth import TruthTable
    from words import OPEN, TRUE, Phrase

    frames = frames_with_a_handle()
    handle = [Phrase("mug handle", kind="mug", part="handle")]
    # Both crops give the handle about a sixth of the weight; only the first has it in the middle.
    crops = [cut(frames.frames[0], left, 21.5, 16.0) for left in (43.5, 45.5)]
    weights = [dict(zip(crop.codes, crop.weights))[1] for crop in crops]
    assert all(0.1 < weight < 0.25 for weight in weights)
    assert TruthTable(frames.labels).of(handle, crops).tolist() == [[OPEN], [OPEN]]
    assert TruthTable(frames.labels, centre=True).of(handle, crops).tolist() == [[TRUE], [OPEN]]


def test_handles_are_drawn_as_many_times_as_often_as_any_other_part():
    from crops import part_crops
    from words import any_part

    frames = frames_with_a_handle(scale=4)
    frames.labels = [
        *frames.labels,
        *(type(frames.labels[0])("lamp", "red", part=part) for part in ("stand", "shade")),
    ]
    frames.frames[0].codes[:40, :40] = 3
    frames.frames[0].codes[-40:, -40:] = 4

    def share(handles):
        crops = part_crops(frames, 600, np.random.default_rng(0), handles=handles)
        shown = [int(crop.grid[12, 12]) for crop in crops[0::2]]
        return shown.count(1) / len(shown)

    assert share(handles=1) == pytest.approx(1 / 3, abs=0.08)
    assert share(handles=8) == pytest.approx(8 / 10, abs=0.08)
    rng = np.random.default_rng(0)
    asked = [any_part(rng, handles=8).part for _ in range(600)]
    assert asked.count("handle") / len(asked) == pytest.approx(8 / 21, abs=0.06)


def test_what_a_part_lies_beside_can_be_said_not_to_show_it():
    from crops import cut
    from truth import BESIDE, TruthTable
    from words import FALSE, OPEN, TRUE, Phrase

    frames = frames_with_a_handle()
    handle = [Phrase("mug handle", kind="mug", part="handle")]
    # The handle spans x = 50 to 53: beside the middle, a little nearer, and in the middle with as little weight.
    crops = [cut(frames.frames[0], left, 20.0, 20.0) for left in (37.0, 39.0, 41.5)]
    crops.append(cut(frames.frames[0], 34.5, 12.5, 34.0))
    weights = [dict(zip(crop.codes, crop.weights))[1] for crop in crops]
    assert 0.04 < weights[0] < weights[1] < BESIDE
    assert 0.04 < weights[3] < 0.1
    usual, strict = (TruthTable(frames.labels, centre=True, **more) for more in ({}, {"beside": BESIDE}))
    assert usual.of(handle, crops).ravel().tolist() == [OPEN, OPEN, TRUE, OPEN]
    assert strict.of(handle, crops).ravel().tolist() == [FALSE, FALSE, TRUE, OPEN], (
        "in the middle it stays open"
    )
