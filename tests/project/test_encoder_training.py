"""Training data of the bundled encoders: ground truth of phrases and crops, and held-out pairs."""

from __future__ import annotations

import json
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[2] / "tools"
CAPTURES = Path(str(resources.files("lexsplat"))) / "demo" / "captures"
CLIP = Path(str(resources.files("lexsplat"))) / "demo" / "encoders" / "clip"


@pytest.fixture(scope="module", autouse=True)
def tools_on_path():
    sys.path[:0] = [str(TOOLS / "train_encoders"), str(TOOLS / "demo_scene")]
    yield
    for folder in ("train_encoders", "demo_scene"):
        sys.path.remove(str(TOOLS / folder))


def labels():
    from words import COLORS, NAMES, OWNERS, Label

    finishes = {"table": "wooden", "wall": "brick", "cloth": "checkered", "floor": "tiled"}
    parts = {kind: [None] + [part for part, owners in OWNERS.items() if kind in owners] for kind in NAMES}
    return [
        Label(kind, color, finishes.get(kind), part)
        for kind in NAMES
        for color in COLORS
        for part in parts[kind]
    ]


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
        ("red mug", {"kind": "mug", "color": "red"}, {"red mug": 1, "blue mug": 0, "red apple": 0}),
        ("mug handle", {"kind": "mug", "part": "handle"}, {"red mug": 0, "red mug handle": 1}),
        ("something red", {"color": "red"}, {"red apple": 1, "red apple stalk": -1, "blue mug": 0}),
        ("fruit", {"quality": "fruit"}, {"red apple": 1, "red apple stalk": 1, "orange pumpkin": 0}),
        ("metal", {"quality": "metal"}, {"gold ring": 1, "white candle saucer": 1, "white candle": 0}),
        ("yellow thing", {"color": "yellow"}, {"gold ring": -1}),
    ],
)  # fmt: skip
def test_phrases_are_true_false_or_open_for_each_label(words, wanted, truth):
    from words import Label, Phrase

    phrase = Phrase(words, **wanted)
    for thing, expected in truth.items():
        color, kind, *part = thing.split()
        assert phrase.of(Label(kind, color, part=part[0] if part else None)) == expected, thing


def test_words_of_things_that_no_scene_holds_are_true_of_nothing():
    from words import FALSE, NAMES, UNKNOWN_TESTED, UNKNOWN_TRAINED, Phrase

    assert not set(UNKNOWN_TESTED) & set(UNKNOWN_TRAINED)
    known = {name for names in NAMES.values() for name in names}
    assert not known & {*UNKNOWN_TESTED, *UNKNOWN_TRAINED}
    assert all(Phrase("zebra", unknown=True).of(label) == FALSE for label in labels())


def test_bundled_scenes_contain_no_held_out_pair():
    from layouts import LAYOUTS
    from words import HELD_OUT_PAIRS

    for layout in LAYOUTS.values():
        assert not HELD_OUT_PAIRS & {(place.kind, place.color) for place in layout.placements}


def test_the_scene_for_choosing_shares_no_thing_place_or_camera_with_the_demo():
    from layouts import SECOND, TABLETOP

    for what in (
        lambda scene: {(place.kind, place.color) for place in scene.placements},
        lambda scene: {(place.x, place.y) for place in scene.placements},
        lambda scene: {scene.cloth[0], scene.wall, scene.key_light, scene.seed},
        lambda scene: {pose.tobytes() for pose in scene.path.poses(scene.views)},
    ):
        assert not what(TABLETOP) & what(SECOND)
    # Words for one thing alone are of that scene alone; those of both mean other things in each.
    both = TABLETOP.prompts.keys() & SECOND.prompts.keys()
    assert all(TABLETOP.prompts[words].kind not in ("name", "color") for words in both)


@pytest.mark.parametrize("scene", ["tabletop", "second"])
def test_the_language_covers_every_prompt_of_the_scenes_that_ship(scene):
    from words import COLORS, NAMES, PARTS, QUALITIES

    single = {
        w
        for group in (NAMES, PARTS, COLORS)
        for names in group.values()
        for name in names
        for w in name.split()
    }
    qualities = {
        w for q in QUALITIES.values() for phrase in (*q.phrases, *q.adjectives) for w in phrase.split()
    }
    for prompt in json.loads((CAPTURES / scene / "prompts.json").read_text()):
        assert set(prompt.split()) <= single | qualities, prompt


@given(seed=st.integers(0, 2**32 - 1))
def test_no_training_phrase_names_a_held_out_pair(seed):
    # It could only be wrong, and would be learnt as the name of nothing.
    from words import HELD_OUT_PAIRS, any_phrase, near_miss

    rng = np.random.default_rng(seed)
    shown = [label for label in labels() if (label.kind, label.color) not in HELD_OUT_PAIRS]
    label = shown[int(rng.integers(len(shown)))]
    for phrase in (near_miss(label, rng), any_phrase(rng)):
        assert (phrase.kind, phrase.color) not in HELD_OUT_PAIRS, phrase


def test_a_made_up_word_is_none_that_means_something():
    from words import _KNOWN_WORDS, _made_up_word

    rng = np.random.default_rng(0)
    words = {_made_up_word(rng) for _ in range(500)}
    assert len(words) > 300
    assert not words & _KNOWN_WORDS
    assert {"metal", "paper", "fur", "wooden"} <= _KNOWN_WORDS, "the syllables can form some of these"


def test_rotated_hues_map_red_to_green_and_keep_gray():
    from train_clip import turned_hues

    colors = np.array([[[200, 0, 0], [90, 90, 90], [0, 200, 0]]], np.uint8)
    turned = turned_hues(colors, 120.0).astype(int)
    assert np.abs(turned - [[[0, 200, 0], [90, 90, 90], [0, 0, 200]]]).max() <= 1


def test_rotated_hues_never_produce_a_held_out_pair():
    from train_clip import fair_angle
    from words import Label

    rng = np.random.default_rng(0)
    # Held out: the blue bear, at 220 degrees; a red one starts at 0.
    angles = [fair_angle([Label("teddy", "red")], rng) for _ in range(300)]
    assert all(abs(angle - 220) >= 25 for angle in angles)
    assert max(angles) > 250
    assert min(angles) < 60


def test_held_out_pairs_are_not_trained_as_negatives():
    from crops import cut
    from train_clip import leave_open
    from truth import TruthTable
    from words import FALSE, OPEN, TRUE, Label, Phrase

    shown = [Label("mug", "red"), Label("table", "blue")]
    crops = [cut(frame_of_two_halves(), left, 5.0, 20.0) for left in (0.0, 40.0)]
    phrases = [
        Phrase("bear", kind="teddy"), Phrase("something fluffy", quality="fluffy"), Phrase("red ball", kind="ball"),
        Phrase("table", kind="table"), Phrase("red", color="red"),
    ]  # fmt: skip
    truth = TruthTable(shown).of(phrases, crops)
    assert truth.tolist() == [[FALSE, FALSE, FALSE, FALSE, TRUE], [FALSE, FALSE, FALSE, TRUE, FALSE]]
    leave_open(truth, phrases, crops, shown, np.zeros(2))
    assert truth.tolist() == [[FALSE, FALSE, FALSE, FALSE, TRUE], [OPEN, OPEN, FALSE, TRUE, FALSE]]


def test_the_composition_loss_of_additive_colors_is_zero():
    import torch
    from train_clip import composition_loss

    kinds, colors = torch.randn(2, 8), torch.randn(2, 8)
    corners = torch.stack([kinds[k] + colors[c] for k in (0, 1) for c in (0, 1)])
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
    phrases = [Phrase("mug", kind="mug"), Phrase("blue table", kind="table", color="blue")]
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
    assert TruthTable(frames.labels, center=True).of(handle, crops).tolist() == [[TRUE], [OPEN]]


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


def test_crops_beside_a_part_can_be_negatives_of_the_part():
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
    usual, strict = (TruthTable(frames.labels, center=True, **more) for more in ({}, {"beside": BESIDE}))
    assert usual.of(handle, crops).ravel().tolist() == [OPEN, OPEN, TRUE, OPEN]
    assert strict.of(handle, crops).ravel().tolist() == [FALSE, FALSE, TRUE, OPEN], (
        "in the middle it stays open"
    )


def handle_crop(scale=1, left=40.0, top=18.0, side=24.0):
    """A crop of the mug with a handle in which every sample is a pixel."""
    from crops import cut

    frames = frames_with_a_handle(scale)
    return frames, cut(frames.frames[0], left, top, side)


def test_a_patch_of_a_crop_shows_what_lies_in_it_all_of_it_weighing_the_same():
    from crops import patch_crop

    _, crop = handle_crop()
    # Third row, third column: x = 48 to 52, y = 26 to 30. The mug ends at x = 50, its handle begins there, at y = 27.
    patch = patch_crop(crop, 14, 6)
    assert patch.box == (48.0, 26.0, 4.0)
    assert patch.grid.tolist() == [[0, 0, 2, 2], [0, 0, 1, 1], [0, 0, 1, 1], [0, 0, 1, 1]]
    assert dict(zip(patch.codes.tolist(), patch.weights.tolist())) == {0: 8 / 16, 1: 6 / 16, 2: 2 / 16}
    tiles = [[patch_crop(crop, row * 6 + column, 6).grid for column in range(6)] for row in range(6)]
    np.testing.assert_array_equal(np.block(tiles), crop.grid)
    with pytest.raises(ValueError, match="divisor of 24, found 7"):
        patch_crop(crop, 0, 7)


def test_background_counts_as_area_of_a_patch_but_is_no_label():
    from crops import Frame, cut, patch_crop

    codes = np.full((24, 24), -1, np.int32)
    codes[0, :3] = 5
    crop = cut(Frame("scene", Image.new("RGB", (24, 24)), codes, np.zeros((24, 24), np.uint8)), 0, 0, 24)
    first, second = (patch_crop(crop, number, 6) for number in (0, 1))
    assert (first.codes.tolist(), first.weights.tolist()) == ([5], [3 / 16])
    assert second.codes.size == second.weights.size == 0


def test_a_patch_shows_what_half_of_it_is_and_not_what_an_eighth_of_it_is():
    from crops import Crop
    from truth import TruthTable
    from words import FALSE, OPEN, TRUE, Label, Phrase

    table = TruthTable(
        [Label("ball", "green"), Label("mug", "red"), Label("table", "blue"), Label("ring", "gold")]
    )

    def patch(*sixteenths):
        codes = np.array([code for code, count in enumerate(sixteenths) if count], np.int64)
        weights = np.array([count / 16 for count in sixteenths if count])
        return Crop(None, (0.0, 0.0, 1.0), codes, weights, np.zeros((4, 4), np.int32))

    patches = [
        patch(0, 8, 8),
        patch(0, 7, 9),
        patch(0, 3, 13),
        patch(0, 2, 14),
        patch(0, 0, 16),
        patch(0, 0, 0),
    ]
    patches.append(patch(0, 0, 0, 16))  # gold may be called yellow: what is possible is not false
    phrases = [Phrase("mug", kind="mug"), Phrase("blue", color="blue"), Phrase("yellow", color="yellow")]
    assert table.at_places(phrases, patches).tolist() == [
        [TRUE, TRUE, FALSE],
        [OPEN, TRUE, FALSE],
        [OPEN, TRUE, FALSE],
        [FALSE, TRUE, FALSE],
        [FALSE, TRUE, FALSE],
        [FALSE, FALSE, FALSE],
        [FALSE, FALSE, OPEN],
    ]


def place_questions():
    from words import Phrase

    return [
        Phrase("mug handle", kind="mug", part="handle"), Phrase("mug", kind="mug"), Phrase("red", color="red"),
        Phrase("table", kind="table"),
    ]  # fmt: skip


def place_answers(frames, crops, seed=0, colorless=None, angles=None):
    from train_clip import ClipTraining, place_truth
    from truth import TruthTable

    count = len(crops)
    return place_truth(
        place_questions(),
        crops,
        TruthTable(frames.labels),
        np.zeros(count) if angles is None else angles,
        np.zeros(count, bool) if colorless is None else np.array(colorless),
        ClipTraining(dense=1.0),
        np.random.default_rng(seed),
    )


def test_a_handle_is_true_at_its_patches_and_false_at_those_of_the_body():
    from words import FALSE, OPEN, TRUE

    # Four pixels for one: the handle fills patches of four pixels, as the body and the table do.
    frames, crop = handle_crop(scale=4, left=192.0, top=104.0, side=24.0)
    assert np.unique(crop.grid).tolist() == [0, 1, 2]
    answers = place_answers(frames, [crop] * 8)
    assert answers.shape == (8, 36, 4)
    whole = {0: [FALSE, TRUE, TRUE, FALSE], 1: [TRUE, TRUE, TRUE, FALSE], 2: [FALSE, FALSE, FALSE, TRUE]}
    for row in answers:
        asked = [number for number in range(36) if (row[number] != OPEN).any()]
        assert 4 <= len(asked) <= 8
        seen = set()
        for number in asked:
            (code,) = np.unique(crop.grid[number // 6 * 4 :, number % 6 * 4 :][:4, :4])
            assert row[number].tolist() == whole[int(code)], number
            seen.add(int(code))
        assert seen == {0, 1, 2}, "all that the crop shows has its turn"
    assert len({row.tobytes() for row in answers}) > 1, "not the same patches every time"


def test_colors_are_open_for_patches_of_gray_crops():
    from words import OPEN, TRUE

    frames, crop = handle_crop(scale=4, left=192.0, top=104.0, side=24.0)
    colored, gray = place_answers(frames, [crop, crop], colorless=[False, True])
    assert (colored[:, 2] == TRUE).any()
    assert (gray[:, 2] == OPEN).all()
    assert (gray[:, 1] == TRUE).any(), "kinds are asked"


def test_held_out_pairs_are_not_trained_as_negatives_of_patches():
    from train_clip import ClipTraining, place_truth
    from truth import TruthTable
    from words import FALSE, OPEN, Phrase

    frames, crop = handle_crop(scale=4, left=192.0, top=104.0, side=24.0)
    bear = [Phrase("bear", kind="teddy"), Phrase("ring", kind="ring")]
    rng = np.random.default_rng(0)
    answers = place_truth(
        bear, [crop], TruthTable(frames.labels), np.zeros(1), np.zeros(1, bool), ClipTraining(dense=1.0), rng
    )[0]
    shown = crop.grid[2::4, 2::4].ravel()
    asked = (answers != OPEN).any(1)
    # The table is blue, and no ring is held out in blue; the mug is red, and a red ring is.
    assert answers[asked & (shown == 2)].tolist() == [[OPEN, FALSE]] * int((asked & (shown == 2)).sum())
    assert answers[asked & (shown != 2)].tolist() == [[FALSE, OPEN]] * int((asked & (shown != 2)).sum())
    assert set(shown[asked]) == {0, 1, 2}


def small_training(**settings):
    from train_clip import ClipTraining

    return ClipTraining(batch=12, width=64, layers=2, text_width=64, text_layers=1, dim=32, **settings)


def batch_of(config, seed=0):
    from train_clip import make_batch
    from truth import TruthTable

    frames = frames_with_a_handle(scale=4)
    return make_batch(frames, TruthTable(frames.labels), config, np.random.default_rng(seed))


def trainer_of(config, start=None):
    from train_clip import Trainer
    from transformers import CLIPTokenizer

    return Trainer(CLIPTokenizer.from_pretrained(CLIP), config, start)


def test_labels_of_patches_follow_a_mirrored_crop():
    import torch
    from train_clip import Batch, mirrored

    config = small_training(dense=1.0)
    # Each patch is of one brightness, which all that belongs to it repeats.
    marks = torch.arange(8 * 36).reshape(8, 36) % 100
    pixels = (
        marks.unflatten(1, (1, 6, 6)).expand(-1, 3, -1, -1).repeat_interleave(8, 2).repeat_interleave(8, 3)
    )
    batch = Batch(
        pixels=pixels.byte(),
        texts=[],
        corners=[],
        truth=torch.empty(8, 0),
        patches=marks[..., None].expand(-1, -1, 3),
        left_out=marks[..., None].expand(-1, -1, 22) % 2 == 1,
        places=marks[..., None].expand(-1, -1, 5).to(torch.int8),
    )
    seen, patches, left_out, places = mirrored(batch, config, torch.Generator().manual_seed(0))
    now = seen[:, 0, 4::8, 4::8].flatten(1)
    turned = (now != marks).any(1)
    assert turned.any()
    assert not turned.all()
    assert torch.equal(patches, now[..., None].expand(-1, -1, 3).long())
    assert torch.equal(left_out, now[..., None].expand(-1, -1, 22) % 2 == 1)
    assert torch.equal(places, now[..., None].expand(-1, -1, 5).to(torch.int8))


def test_only_the_last_phase_of_the_weights_that_ship_asks_patches():
    from train_clip import PHASES, ClipTraining

    assert ClipTraining().dense == 0
    assert [name for name, config in PHASES.items() if config.dense] == ["dense"]
    config = small_training()
    batch = batch_of(config)
    assert batch.places.shape == (12, 36, 0)
    assert "dense" not in trainer_of(config).losses(batch)


def test_the_dense_loss_trains_the_image_tower_except_its_last_attention_weights():
    config = small_training(dense=1.0)
    trainer = trainer_of(config)
    trainer.losses(batch_of(config))["dense"].backward()
    tower = trainer.model.vision_model
    first, last = tower.encoder.layers[0].self_attn, tower.encoder.layers[-1].self_attn
    for module in (tower.embeddings.patch_embedding, first.q_proj, first.v_proj, last.v_proj, last.out_proj):
        assert module.weight.grad.abs().max() > 0
    assert trainer.model.text_model.embeddings.token_embedding.weight.grad.abs().max() > 0
    # A patch is read by its own value: neither queries nor keys of the last attention have a part in that.
    assert last.q_proj.weight.grad is None
    assert last.k_proj.weight.grad is None
    assert trainer.patch_heads.weight.grad is None


def test_the_dense_loss_ignores_open_patches_and_prefers_correct_answers():
    import torch
    from train_clip import dense_loss
    from words import CANONICAL, FALSE, OPEN, TRUE

    axes = torch.eye(8)
    texts = torch.cat([axes[:2], axes[2].expand(len(CANONICAL), -1)])  # two phrases, all canonical ones equal
    places = torch.full((1, 3, 2), OPEN)
    places[0, 0], places[0, 1] = torch.tensor([TRUE, FALSE]), torch.tensor([FALSE, TRUE])

    def cost(*patches):
        return float(dense_loss(torch.stack(patches)[None], texts, places, torch.tensor(20.0), 10.0))

    right = cost(axes[0], 3 * axes[1], axes[4])
    assert right == cost(axes[0], axes[1], -axes[0]), "lengths and the third patch do not matter"
    assert right < 0.01 + 2 * np.log(2) < cost(axes[1], axes[0], axes[4])
    # By hand: contrast is as good as 0; relevancy is 10 for the right phrase, 0 for the wrong one.
    assert right == pytest.approx(np.log1p(np.exp(-10)) + np.log(2), abs=1e-6)


def test_training_and_encoder_compute_the_same_patch_embeddings(tmp_path, monkeypatch):
    import torch
    from train_clip import MEAN, STD, save

    from lexsplat.features import pretrained
    from lexsplat.features.clip import ClipEncoder

    monkeypatch.setattr(pretrained, "bfloat16_is_faster", lambda: False)
    trainer = trainer_of(small_training(seed=3))
    save(trainer, tmp_path)
    images = torch.rand(4, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    order = torch.randperm(36, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        whole, _, said = trainer.see((images - MEAN) / STD, order.expand(4, -1))
    wholes, patches = ClipEncoder(tmp_path, "made").encode_patches(images)
    unit = torch.nn.functional.normalize
    torch.testing.assert_close(unit(whole, dim=-1), wholes, atol=1e-5, rtol=0)
    torch.testing.assert_close(unit(said, dim=-1), patches.flatten(1, 2)[:, order], atol=1e-5, rtol=0)
    assert (patches.flatten(1, 2)[:, :1] - patches.flatten(1, 2)[:, 1:]).abs().amax(-1).min() > 1e-3, (
        "they differ"
    )


def test_the_model_may_see_between_two_steps_without_a_trace():
    import torch

    config = small_training(dense=1.0, gray=0.0, turned=0.0)
    batch = batch_of(config)

    def dense(before):
        trainer = trainer_of(config)
        with torch.no_grad():
            before(trainer.model)
        return trainer.losses(batch)["dense"].item()

    expected = dense(lambda model: None)
    images = torch.zeros(2, 3, 48, 48)
    assert dense(lambda model: model.get_image_features(pixel_values=images)) == expected
    trainer = trainer_of(config)
    trainer.losses(batch)
    assert not trainer.model.vision_model.encoder.layers[-1].layer_norm1._forward_hooks
