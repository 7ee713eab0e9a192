"""Protocols of other authors against literal implementations of their descriptions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from scipy.ndimage import generic_filter

from lexsplat.evaluation import protocols

MASKS = arrays(bool, (5, 7))
SCORES = arrays(np.float32, (5, 7), elements=st.sampled_from([i / 16 for i in range(17)]))


# Official


def official_reference(relevancy, mask, threshold):
    """The description in torch, float32, threshold by threshold and recall by recall."""
    height, width = relevancy.shape
    image = Image.fromarray(mask.astype(np.uint8) * 255)
    if image.size != (width, height):
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    ground_truth = torch.from_numpy(np.array(image)).float() / 255
    render = torch.from_numpy(relevancy)

    def ratios(found):
        tp = torch.logical_and(found, ground_truth).float().sum()
        fp = torch.logical_and(found, 1 - ground_truth).float().sum()
        fn = torch.logical_and(1 - found, ground_truth).float().sum()
        return float(tp / (tp + fp + 1e-6)), float(tp / (tp + fn + 1e-6))

    found = (render >= threshold).float()
    overlap = torch.logical_and(found, ground_truth).float().sum()
    iou = float(overlap / (torch.logical_or(found, ground_truth).float().sum() + 1e-6))
    accuracy = float((found == ground_truth).float().sum() / found.numel())
    points = [ratios((render > float(level)).float()) for level in np.arange(0.0, 1.01, 0.01)]
    precisions, recalls = (np.array(column, dtype=np.float32) for column in zip(*points))
    # numpy 1.24, which the authors pin: a level is compared in float32, and 0 + float32 is a float64.
    total = 0.0
    for level in np.arange(0.0, 1.01, 0.01).astype(np.float32):
        reached = precisions[recalls >= level]
        total += float(reached.max()) if len(reached) else 0.0
    return iou, accuracy, ratios(found)[0], total / 100


@pytest.mark.parametrize("shape", [(5, 7), (10, 14), (4, 9), (31, 40)])
@pytest.mark.parametrize("seed", range(4))
def test_official_scores_equal_the_description_bit_for_bit(shape, seed):
    rng = np.random.default_rng(seed)
    relevancy = (rng.integers(0, 101, (5, 7)) / 100).astype(np.float32)
    mask = rng.random(shape) > 0.6
    found = protocols.official_scores(relevancy, mask, 0.5)
    expected = official_reference(relevancy, mask, 0.5)
    assert (found.iou, found.accuracy, found.precision, found.average_precision) == expected


def test_official_scores_by_hand():
    # Found: 3 pixels of which 2 are true; ground truth: 4 pixels; 12 in all.
    ground_truth, found = np.zeros((3, 4), bool), np.zeros((3, 4), np.float32)
    ground_truth[0] = True
    found[0, :2] = found[1, 0] = 0.75
    scores = protocols.official_scores(found, ground_truth)
    assert scores.iou == pytest.approx(2 / 5)
    assert scores.accuracy == pytest.approx(9 / 12)
    assert scores.precision == pytest.approx(2 / 3)
    # Every threshold finds the same three. The recall 2 / (4 + 1e-6) just misses 0.50: levels 0 to 0.49.
    assert scores.average_precision == pytest.approx(50 * (2 / 3) / 100, abs=1e-5)


def test_official_average_precision_reaches_one_point_zero_one():
    ground_truth = np.zeros((12, 12), bool)
    ground_truth[2:8] = True
    found = protocols.official_scores(ground_truth.astype(np.float32), ground_truth)
    assert found.average_precision == pytest.approx(1.01, abs=1e-6)
    assert found.iou == pytest.approx(1, abs=1e-6)
    assert found.accuracy == 1


def test_a_predicted_soft_pixel_is_a_true_and_a_false_positive_in_the_official_protocol():
    ground_truth = np.zeros((8, 8), bool)
    ground_truth[:, 4:] = True
    soft = protocols.official_ground_truth(ground_truth, 5, 5)
    undecided = (soft > 0) & (soft < 1)
    assert undecided.any()
    found = protocols.official_scores(np.ones((5, 5), np.float32), ground_truth)
    assert found.accuracy == pytest.approx((soft == 1).mean())
    hits, alarms = (soft != 0).sum(), (soft != 1).sum()
    assert hits + alarms == 25 + undecided.sum()
    assert found.precision == pytest.approx(hits / (hits + alarms))


@pytest.mark.slow
@given(SCORES, MASKS)
def test_official_scores_are_bounded(scores, mask):
    found = protocols.official_scores(scores, mask)
    assert min(found.iou, found.accuracy, found.precision, found.average_precision) >= 0
    assert max(found.iou, found.accuracy, found.precision) <= 1
    assert found.average_precision <= 1.0101


@pytest.mark.slow
@given(SCORES, MASKS.filter(np.any))
def test_official_masks_agree_with_scikit_learn_where_nothing_is_resized(scores, mask):
    import sklearn.metrics

    found = protocols.official_scores(scores, mask)
    predicted = (scores >= 0.5).ravel()
    ground_truth = mask.ravel()
    assert found.iou == pytest.approx(sklearn.metrics.jaccard_score(ground_truth, predicted), abs=1e-5)
    assert found.accuracy == pytest.approx(sklearn.metrics.accuracy_score(ground_truth, predicted), abs=1e-5)
    expected = sklearn.metrics.precision_score(ground_truth, predicted, zero_division=0)
    assert found.precision == pytest.approx(expected, abs=1e-5)


# LERF-OVS in 2D


def lerf_2d_reference(relevancy, ground_truth, boxes, threshold):
    """LangSplat's evaluation, pixel by pixel in float64."""
    height, width = relevancy.shape

    def mirrored(i, size):
        period = 2 * (size - 1)
        i = abs(i) % period if period else 0
        return period - i if i >= size else i

    blurred = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            rows = [mirrored(y + d, height) for d in range(-15, 15)]
            columns = [mirrored(x + d, width) for d in range(-15, 15)]
            blurred[y, x] = relevancy[np.ix_(rows, columns)].astype(np.float64).mean()
    y, x = np.unravel_index(blurred.argmax(), blurred.shape)
    hit = any(x0 <= x <= x1 and y0 <= y <= y1 for x0, y0, x1, y1 in boxes)
    blended = (blurred + relevancy) / 2
    stretched = (blended - blended.min()) / (np.ptp(blended) + 1e-9)
    mask = np.clip(2 * stretched - 1, 0, 1) > threshold
    smooth = np.zeros_like(mask)
    for i in range(height):
        for j in range(width):
            part = mask[max(0, i - 3) : min(i + 4, height - 1), max(0, j - 3) : min(j + 4, width - 1)]
            smooth[i, j] = part.sum() > part.size - part.sum()
    return (smooth & ground_truth).sum() / (smooth | ground_truth).sum(), hit


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [(24, 33), (47, 40)])
def test_lerf_2d_equals_the_description_one_pixel_at_a_time(size, seed):
    rng = np.random.default_rng(seed)
    ground_truth = np.zeros(size, bool)
    ground_truth[5:15, 8:20] = True
    relevancy = np.clip(0.4 * ground_truth + 0.6 * rng.random(size), 0, 1).astype(np.float32)
    boxes = [(8, 5, 19, 14), (30, 20, 25, 18)]
    found = protocols.lerf_2d_scores(relevancy, ground_truth, boxes)
    expected = lerf_2d_reference(relevancy, ground_truth, [boxes[0], (25, 18, 30, 20)], 0.4)
    assert found.iou == pytest.approx(expected[0], abs=1e-9)
    assert found.hit == expected[1]


def test_lerf_2d_localizes_by_the_peak_of_the_blurred_map():
    relevancy = np.zeros((60, 80), np.float32)
    relevancy[5, 70] = 1.0
    relevancy[20:50, 10:40] = 0.6
    ground_truth = relevancy == np.float32(0.6)
    assert protocols.lerf_2d_scores(relevancy, ground_truth, [[10, 20, 39, 49]]).hit
    assert not protocols.lerf_2d_scores(relevancy, ground_truth, [[60, 0, 79, 10]]).hit


def test_lerf_2d_does_not_depend_on_the_range_of_the_map():
    ground_truth = np.zeros((60, 80), bool)
    ground_truth[15:45, 20:60] = True
    strong = protocols.lerf_2d_scores(ground_truth.astype(np.float32), ground_truth)
    faint = protocols.lerf_2d_scores((0.3 + 0.01 * ground_truth).astype(np.float32), ground_truth)
    assert strong.iou == pytest.approx(faint.iou, abs=0.02)
    assert strong.iou > 0.8


@given(arrays(bool, (9, 12)))
def test_the_majority_is_that_of_scipys_filter_away_from_the_border(mask):
    found = protocols._majority(mask)
    expected = generic_filter(mask.astype(float), lambda part: part.sum() > len(part) / 2, size=7)
    np.testing.assert_array_equal(found[3:-4, 3:-4], expected[3:-4, 3:-4].astype(bool))


@pytest.mark.slow
@given(SCORES, MASKS.filter(np.any))
def test_lerf_2d_is_bounded(scores, mask):
    found = protocols.lerf_2d_scores(scores, mask)
    assert 0 <= found.iou <= 1


def test_boxes_of_a_mask_are_those_of_its_parts():
    mask = np.zeros((10, 12), bool)
    mask[1:4, 2:5] = True
    mask[6, 11] = True
    np.testing.assert_array_equal(protocols.mask_boxes(mask), [[2, 1, 4, 3], [11, 6, 11, 6]])
    assert protocols.mask_boxes(np.zeros((3, 3), bool)).shape == (0, 4)


def test_lerf_2d_refuses_a_map_of_another_size():
    with pytest.raises(ValueError, match="same size"):
        protocols.lerf_2d_scores(np.zeros((3, 4)), np.zeros((4, 3), bool))


# LERF-OVS in 3D


@pytest.mark.slow
@given(SCORES, MASKS)
def test_silhouettes_agree_with_scikit_learn(alpha, ground_truth):
    import sklearn.metrics

    expected = sklearn.metrics.jaccard_score(ground_truth.ravel(), (alpha > 0.7).ravel(), zero_division=0)
    assert protocols.silhouette_iou(alpha, ground_truth) == pytest.approx(expected)


def test_accuracy_at_counts_ious_beyond_the_level():
    assert protocols.accuracy_at([0.25, 0.26, 0.9, 0.1], 0.25) == 0.5
    assert math.isnan(protocols.accuracy_at([], 0.25))
