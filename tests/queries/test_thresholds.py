"""Thresholds: the automatic one separates what is meant from the rest without ground truth."""

import numpy as np
import pytest
import torch
from support.question_scene import coded_cloud, texts

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField
from lexsplat.queries import relevancy as queries
from lexsplat.queries import thresholds
from lexsplat.queries.relevancy import Question
from lexsplat.runtime.errors import QueryError


@pytest.fixture(scope="module")
def cloud() -> tuple[CodeField, Gaussians, Camera]:
    return coded_cloud()


def two_groups(share, low=0.2, high=0.6, spread=0.03, count=20_000):
    rng = np.random.default_rng(0)
    objects = int(share * count)
    samples = np.concatenate([rng.normal(low, spread, count - objects), rng.normal(high, spread, objects)])
    return torch.tensor(samples[None], dtype=torch.float32).clamp(0, 1)


@pytest.mark.parametrize("share", [0.3, 0.05, 0.01])
def test_the_automatic_threshold_separates_an_object_of_any_size(share):
    below_half = two_groups(share, low=0.1, high=0.38, spread=0.02)
    assert 0.17 < float(thresholds.automatic_threshold(below_half)) < 0.31
    assert float(thresholds.automatic_threshold(two_groups(share))) == 0.5


def test_plain_otsu_is_scikit_images(monkeypatch):
    from skimage.filters import threshold_otsu

    samples = two_groups(0.3, low=0.15, high=0.35, spread=0.04)
    expected = threshold_otsu(samples.numpy().ravel(), nbins=512)
    monkeypatch.setattr(thresholds, "_TEMPERING", 1.0)
    found = float(thresholds.automatic_threshold(samples))
    assert found == pytest.approx(expected, abs=0.6 * float(samples.max() - samples.min()) / 512 + 1e-6)


def test_the_threshold_is_the_middle_of_a_gap_and_half_where_the_classes_lie_on_either_side_of_it():
    assert thresholds.automatic_threshold(torch.tensor([[0.1] * 90 + [0.8] * 10])).tolist() == [0.5]
    below, above = torch.tensor([[0.1] * 90 + [0.4] * 10]), torch.tensor([[0.6] * 90 + [0.9] * 10])
    assert float(thresholds.automatic_threshold(below)) == pytest.approx(0.25, abs=2e-3)
    assert float(thresholds.automatic_threshold(above)) == pytest.approx(0.75, abs=2e-3)


def test_scores_above_one_half_are_separated_from_slightly_similar_ones():
    # Prompt "nose": the room scores 0.02, the bear 0.3, its nose 0.7. Otsu alone separates bear and room.
    row = torch.tensor([[0.02] * 18_000 + [0.3] * 1_900 + [0.7] * 100])
    assert 0.3 < float(thresholds.automatic_threshold(row)) <= 0.5
    lower = torch.tensor([[0.02] * 18_000 + [0.3] * 1_900 + [0.45] * 100])
    assert 0.02 < float(thresholds.automatic_threshold(lower)) < 0.3, (
        "nothing is over 0.5: the widest gap counts"
    )


def test_the_cut_above_half_weighs_samples_like_repetitions():
    samples = torch.tensor([[0.02, 0.3, 0.7]])
    weights = torch.tensor([18_000, 1_900, 100])
    found = thresholds.automatic_threshold(samples, weights.float())
    torch.testing.assert_close(
        found, thresholds.automatic_threshold(samples.repeat_interleave(weights, dim=1))
    )
    assert float(found) > 0.3


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9])
def test_a_flat_prompt_falls_back_to_half(level):
    noise = 0.01 * torch.rand(1, 1000, generator=torch.Generator().manual_seed(0))
    assert thresholds.automatic_threshold(level + noise).tolist() == [0.5]
    outlier = torch.full((1, 5000), 0.1)
    outlier[0, 0] = 0.9
    assert thresholds.automatic_threshold(outlier).tolist() == [0.5], "one stray sample is no object"


def test_weights_count_like_repetitions():
    samples = torch.tensor([[0.1, 0.12, 0.3, 0.5, 0.52]])
    weights = torch.tensor([50, 30, 0, 5, 9])
    repeated = samples.repeat_interleave(weights, dim=1)
    weighted = thresholds.automatic_threshold(samples, weights.float())
    torch.testing.assert_close(weighted, thresholds.automatic_threshold(repeated))


def test_each_prompt_has_its_own_threshold():
    rows = torch.cat([two_groups(0.05), two_groups(0.05, 0.6, 0.9), torch.full((1, 20_000), 0.3)])
    first, second, flat = thresholds.automatic_threshold(rows).tolist()
    assert first == 0.5 < second
    assert flat == 0.5


def test_the_threshold_of_a_scene_is_that_of_its_rendered_views(cloud, monkeypatch):
    monkeypatch.setattr(thresholds, "_LONG_SIDE", 48)
    field, gaussians, camera = cloud
    question = Question(texts(3, 16, 5), texts(4, 16, 6))

    def relevancy(view):
        return queries.render_relevancy(field, gaussians, view, question)

    views = [camera, camera.resized(96, 72)]
    found = thresholds.scene_thresholds(relevancy, views)
    one = relevancy(camera).flatten(1)
    torch.testing.assert_close(found, thresholds.automatic_threshold(torch.cat([one, one], dim=1)))
    with pytest.raises(ValueError, match="at least one camera"):
        thresholds.scene_thresholds(relevancy, [])


@pytest.mark.parametrize(("presence", "expected"), [("no", 0.5), ("unsure", 0.25), ("yes", 0.25)])
def test_only_what_the_scene_does_not_hold_falls_back_to_half(cloud, presence, expected):
    maps = torch.tensor([[[0.1] * 90 + [0.4] * 10]] * 2)
    found = thresholds.scene_thresholds(lambda _: maps, [cloud[2]], ["yes", presence])
    assert found.tolist() == pytest.approx([0.25, expected], abs=2e-3)


@pytest.mark.parametrize(("count", "expected"), [(60, [0, 8, 17, 25, 34, 42, 51, 59]), (3, [0, 1, 2])])
def test_the_views_of_a_threshold_are_spread_evenly(count, expected):
    cameras = [look_at([0, -4, 0.1 * n], [0, 0, 0], [0, 0, 1], 8, 6, 0.9) for n in range(count)]
    seen = []

    def relevancy(camera):
        seen.append(next(n for n in range(count) if np.array_equal(cameras[n].viewmat, camera.viewmat)))
        return torch.rand(1, 6, 8)

    thresholds.scene_thresholds(relevancy, cameras)
    assert seen == expected


@pytest.mark.parametrize("wrong", [-0.1, 1.5, float("nan"), "0.5", None, True])
def test_a_threshold_outside_the_unit_interval_is_refused(wrong):
    with pytest.raises(QueryError, match=r"expected a number in 0\.\.1"):
        thresholds.check_threshold(wrong)


def test_masks_take_one_threshold_or_one_for_each_prompt():
    relevancy = torch.tensor([[[0.4, 0.5]], [[0.6, 0.8]]])
    assert thresholds.masks(relevancy, 0.5).tolist() == [[[False, True]], [[True, True]]]
    assert thresholds.masks(relevancy, torch.tensor([0.4, 0.7])).tolist() == [[[True, True]], [[False, True]]]
