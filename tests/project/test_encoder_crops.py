"""Training data of the bundled encoders: what crops, parts and patches show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from support.training_frames import frames_with_a_handle, labels

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("training_tools")]


def test_held_out_pairs_are_not_trained_as_negatives():
    from clip_batches import leave_open
    from crops import cut
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
    from clip_batches import place_truth
    from clip_settings import ClipTraining
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
    from clip_batches import place_truth
    from clip_settings import ClipTraining
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
