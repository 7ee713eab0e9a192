import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lexsplat.evaluation import metrics
from lexsplat.runtime.progress import NOTE

MASKS = arrays(bool, (5, 7))
# Few distinct values, so that ties are common.
SCORES = arrays(np.float32, (5, 7), elements=st.sampled_from([i / 16 for i in range(17)]))


def random_image(seed, size=(37, 41, 3)):
    return np.random.default_rng(seed).random(size).astype(np.float32)


# Image quality


def test_psnr_of_a_constant_difference_of_a_tenth_is_20_db():
    assert metrics.psnr(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.6)) == pytest.approx(20)
    assert metrics.psnr(random_image(0), random_image(0)) == math.inf


@pytest.mark.slow
def test_psnr_agrees_with_scikit_image():
    from skimage.metrics import peak_signal_noise_ratio

    expected = peak_signal_noise_ratio(
        random_image(0).astype(float), random_image(1).astype(float), data_range=1
    )
    assert metrics.psnr(random_image(0), random_image(1)) == pytest.approx(expected)


@pytest.mark.slow  # torchmetrics imports transformers
def test_ssim_agrees_with_torchmetrics_where_the_window_lies_inside():
    from torchmetrics.functional.image import structural_similarity_index_measure

    image = np.clip(random_image(0) * 0.3 + np.linspace(0, 0.7, 41)[None, :, None], 0, 1)
    target = np.clip(image + 0.1 * (random_image(1) - 0.5), 0, 1)
    pair = [torch.from_numpy(side.astype(np.float64)).permute(2, 0, 1)[None] for side in (image, target)]
    _, full = structural_similarity_index_measure(*pair, data_range=1.0, return_full_image=True)
    expected = float(full[..., 5:-5, 5:-5].mean())
    assert metrics.ssim(image, target) == pytest.approx(expected, abs=1e-6)


def test_ssim_of_equal_pictures_is_one_and_small_pictures_are_refused():
    assert metrics.ssim(random_image(0), random_image(0)) == pytest.approx(1)
    with pytest.raises(ValueError, match="11x11"):
        metrics.ssim(random_image(0, (10, 30, 3)), random_image(0, (10, 30, 3)))


@pytest.mark.parametrize("measure", [metrics.psnr, metrics.ssim])
def test_pictures_of_two_sizes_are_refused(measure):
    with pytest.raises(ValueError, match="same shape"):
        measure(random_image(0), random_image(0)[1:])


def test_lpips_states_why_it_is_unavailable(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", None)
    function, reason = metrics.load_lpips()
    assert function is None
    assert "pip install 'lexsplat[lpips]'" in reason


def test_without_torchvision_lpips_is_refused_before_torchmetrics_loads(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchmetrics"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    function, reason = metrics.load_lpips()
    assert function is None
    assert "torchvision" in reason
    assert not any(name.partition(".")[0] == "torchmetrics" for name in sys.modules)


@pytest.mark.parametrize("there", [False, True], ids=["missing", "downloaded"])
def test_size_license_and_place_of_the_weights_of_lpips_are_told_before_they_are_downloaded(
    there, tmp_path, monkeypatch, caplog
):
    told_before = []

    class Network(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()
            told_before.extend(caplog.messages)  # where torchvision downloads the weights

    weights = SimpleNamespace(url="https://a.org/models/vgg16-0123.pth", meta={"_file_size": 527.796})
    models = SimpleNamespace(VGG16_Weights=SimpleNamespace(DEFAULT=weights))
    monkeypatch.setitem(sys.modules, "torchvision", SimpleNamespace(models=models))
    lpip = SimpleNamespace(LearnedPerceptualImagePatchSimilarity=Network)
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", lpip)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    if there:
        folder.mkdir(parents=True)
        (folder / "vgg16-0123.pth").write_bytes(b"weights")
    with caplog.at_level(NOTE, logger="lexsplat"):
        assert metrics.load_lpips()[1] is None
    told = f"VGG-16 of torchvision, for LPIPS: 528 MB are downloaded once to {folder}; license: BSD-3-Clause"
    assert [line.partition(" (")[0] for line in told_before] == ([] if there else [told])


# Relevancy maps, strict protocol


@pytest.mark.slow
@given(SCORES, MASKS, st.integers(0, 1000))
def test_mask_scores_agree_with_scikit_learn_at_every_threshold(scores, ground_truth, step):
    import sklearn.metrics

    counts = metrics.threshold_counts(scores, ground_truth)
    found, predicted = counts.at(step / 1000), scores >= step / 1000
    flat = ground_truth.ravel(), predicted.ravel()
    assert found.accuracy == pytest.approx(sklearn.metrics.accuracy_score(*flat))
    assert found.iou == pytest.approx(sklearn.metrics.jaccard_score(*flat, zero_division=1.0))
    assert counts.iou[step] == found.iou
    if predicted.any():
        assert found.precision == pytest.approx(sklearn.metrics.precision_score(*flat))
    else:
        assert found.precision == float(not ground_truth.any())


def test_mask_scores_by_hand():
    scores = np.array([[0.9, 0.9, 0.1, 0.1]])
    ground_truth = np.array([[False, True, True, True]])
    found = metrics.threshold_counts(scores, ground_truth).at(0.5)
    assert (found.iou, found.accuracy, found.precision) == (1 / 4, 1 / 4, 1 / 2)


def test_an_empty_prediction_is_right_only_where_the_ground_truth_is_empty():
    scores, empty, full = np.zeros((2, 2)), np.zeros((2, 2), bool), np.ones((2, 2), bool)
    right, wrong = (metrics.threshold_counts(scores, mask).at(0.5) for mask in (empty, full))
    assert right.iou == right.precision == 1
    assert wrong.iou == wrong.precision == 0


def test_ground_truth_must_be_boolean_and_of_the_shape_of_the_scores():
    for mask in (np.zeros((2, 2)), np.zeros((2, 3), bool)):
        with pytest.raises(ValueError, match="boolean mask of the same shape"):
            metrics.threshold_counts(np.zeros((2, 2)), mask)


@pytest.mark.slow
@given(SCORES, MASKS.filter(np.any))
def test_average_precision_agrees_with_scikit_learn_interpolated_at_101_recalls(scores, ground_truth):
    import sklearn.metrics

    precisions, recalls, _ = sklearn.metrics.precision_recall_curve(ground_truth.ravel(), scores.ravel())
    precisions, recalls = precisions[:-1], recalls[:-1]  # without the point (1, 0) that no threshold makes
    expected = [precisions[recalls >= k / 100].max() for k in range(101)]
    assert metrics.average_precision(scores, ground_truth) == pytest.approx(np.mean(expected))


@pytest.mark.slow
@given(SCORES, MASKS)
def test_average_precision_is_bounded_and_deaf_to_monotone_changes(scores, ground_truth):
    value = metrics.average_precision(scores, ground_truth)
    if not ground_truth.any():
        assert math.isnan(value)
        return
    assert 0 <= value <= 1
    assert metrics.average_precision(scores**3 / 2 + 0.1, ground_truth) == pytest.approx(value)


def test_average_precision_by_hand():
    # Ranked: hit, miss, hit. Precision 1 up to recall 1/2 (points 0 to 50), then 2/3 (50 points).
    value = metrics.average_precision(np.array([[0.9, 0.5, 0.2]]), np.array([[True, False, True]]))
    assert value == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)


def test_a_perfect_ranking_has_average_precision_one():
    ground_truth = np.zeros((10, 10), bool)
    ground_truth[2:5] = True
    assert metrics.average_precision(ground_truth * 0.5 + 0.1, ground_truth) == 1


def test_scores_with_nan_are_refused():
    with pytest.raises(ValueError, match="NaN"):
        metrics.average_precision(np.array([[np.nan, 1.0]]), np.array([[True, False]]))


def test_localization_looks_at_the_peak_only():
    ground_truth = np.zeros((3, 4), bool)
    ground_truth[1, 1] = True
    scores = np.full((3, 4), 0.4)
    assert metrics.localization(scores, ground_truth) == pytest.approx(1 / 12), (
        "a flat map is worth the object's area"
    )
    scores[1, 1] = 0.5
    assert metrics.localization(scores, ground_truth) == 1
    scores[0, 0] = 0.6
    assert metrics.localization(scores, ground_truth) == 0
    assert math.isnan(metrics.localization(scores, ~(ground_truth | True)))


def test_resizing_scores_keeps_pixel_centers():
    ramp = np.tile((np.arange(8) + 0.5) / 8, (4, 1)).astype(np.float32)
    larger = metrics.resize_scores(ramp, 16, 8)
    assert larger.shape == (8, 16)
    np.testing.assert_allclose(
        larger[:, 1:-1], np.tile((np.arange(16) + 0.5) / 16, (8, 1))[:, 1:-1], atol=1e-6
    )
    assert metrics.resize_scores(ramp, 8, 4) is ramp


def test_counts_of_two_views_add_up_to_the_counts_of_both():
    rng = np.random.default_rng(0)
    scores, ground_truth = rng.random((2, 6, 5)), rng.random((2, 6, 5)) > 0.7
    both = metrics.threshold_counts(scores, ground_truth)
    total = metrics.threshold_counts(scores[0], ground_truth[0]) + metrics.threshold_counts(
        scores[1], ground_truth[1]
    )
    np.testing.assert_array_equal(both.hits, total.hits)
    precisions, recalls = total.curve
    assert recalls[-1] == 1
    assert np.all(np.diff(recalls) >= 0)
    assert precisions[-1] == pytest.approx(ground_truth.mean())
