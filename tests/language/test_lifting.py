"""Claims about settings of lifting; the reference is the float64 renderer by definition and sums over its weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import LanguageScene, make_scene
from support.rendering_reference import blend, project, to_float64
from torch.nn.functional import normalize

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureMap
from lexsplat.language.methods.averaged import AveragedConfig, field_from_means
from lexsplat.language.methods.averaging import MeanFeatures, average_features

pytestmark = pytest.mark.usefixtures("one_thread")

MEAN = AveragedConfig(shortest_side=10_000)


@pytest.fixture(scope="module")
def small() -> LanguageScene:
    return make_scene(per_ball=6, views=3, width=20, height=15)


@pytest.fixture(scope="module")
def feature_maps(small) -> dict[str, FeatureMap]:
    generator = torch.Generator().manual_seed(0)
    common = torch.tensor([3.0, 0, 0, 0, 0])  # features of an encoder lie in a cone
    return {
        name: FeatureMap(
            normalize(common + torch.randn(camera.height, camera.width, 5, generator=generator), dim=-1)
        )
        for name, camera in small.cameras.items()
    }


@pytest.fixture(scope="module")
def weighed(small, feature_maps) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights alpha T ``[N, pixels]`` and features ``[pixels, D]`` of each view, float64."""
    found = []
    for name, camera in small.cameras.items():
        projected = project(to_float64(small.gaussians), camera, small.gaussians.antialiased)
        weights = blend(projected, torch.zeros(len(small.gaussians), 1), camera)[2].detach().numpy()
        found.append(
            (weights.reshape(len(weights), -1), feature_maps[name].clip.double().flatten(0, 1).numpy())
        )
    return found


def mean_of(weighed) -> np.ndarray:
    sums = sum(weights @ features for weights, features in weighed)
    return sums / np.maximum(sum(weights.sum(1) for weights, _ in weighed), 1e-30)[:, None]


def averaged(small, feature_maps, **settings) -> MeanFeatures:
    return average_features(small.gaussians, small.cameras, feature_maps, replace(MEAN, **settings))


def test_a_gate_gives_the_features_of_a_view_to_its_heaviest_gaussians_and_others_keep_their_mean(
    small, feature_maps, weighed
) -> None:
    gated, passing = [], 0
    for weights, features in weighed:
        heaviest = sorted(range(len(weights)), key=lambda n: -weights[n].sum())
        passes, reached = np.zeros(len(weights), bool), 0.0
        for gaussian in heaviest:
            if reached < 0.5 * weights.sum():
                passes[gaussian] = True
            reached += weights[gaussian].sum()
        gated.append((weights * passes[:, None], features))
        passing = passing + passes
    found, seen = (
        averaged(small, feature_maps, gate=0.5),
        sum(weights.sum(1) for weights, _ in weighed) > 0.05,
    )
    assert (passing[seen] == 0).any()
    assert (passing[seen] > 0).any()
    expected = np.where(passing[:, None] > 0, mean_of(gated), mean_of(weighed))
    np.testing.assert_allclose(found.means[seen], expected[seen], atol=3e-3)
    assert torch.equal(found.totals, averaged(small, feature_maps).totals)


def test_squared_weights_are_those_of_single_pixels(small, feature_maps, weighed) -> None:
    found = averaged(small, feature_maps, squared=True)
    expected, seen = mean_of([(w**2, f) for w, f in weighed]), found.totals.numpy() > 0.05
    np.testing.assert_allclose(found.means[seen], expected[seen], atol=3e-3)
    assert np.abs(mean_of(weighed) - expected)[seen].max() > 0.05


def test_cells_that_cross_a_border_of_tiles_count_as_wholes(small, feature_maps, weighed) -> None:
    """Maps of 6 x 7 cells: cells of about 3 pixels, one of which holds pixels 15 and 16, of two tiles."""
    coarse = {name: FeatureMap(found.clip[:6, :7].contiguous()) for name, found in feature_maps.items()}
    rows, columns = ((2 * np.arange(size) + 1) * cells // (2 * size) for size, cells in ((15, 6), (20, 7)))
    assert columns[15] == columns[16]
    cells, views = (rows[:, None] * 7 + columns).ravel(), []
    for (weights, _), found in zip(weighed, coarse.values()):
        of_cells = np.stack([np.bincount(cells, row, minlength=42) for row in weights]) * 42 / 300
        views.append((of_cells, found.clip.double().flatten(0, 1).numpy()))
    best = np.max([weights.max(1) for weights, _ in views], axis=0)
    found, limit = averaged(small, coarse, squared=True), float(np.median(best))
    expected, seen = mean_of([(w**2, f) for w, f in views]), found.totals.numpy() > 0.05
    np.testing.assert_allclose(found.means[seen], expected[seen], atol=3e-3)
    shown = averaged(small, coarse, least_weight=limit).totals.numpy() > 0
    sure = np.abs(best - limit) > 1e-4
    assert np.array_equal(shown[sure], (best > limit)[sure])


def test_features_count_by_their_agreement_with_the_mean_of_a_first_pass(
    small, feature_maps, weighed
) -> None:
    first = mean_of(weighed)
    units = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-30)
    expected = mean_of([(w * np.exp(4 * (units @ f.T - 1)), f) for w, f in weighed])
    events = []
    settings = replace(MEAN, agreement=4.0)
    found = average_features(small.gaussians, small.cameras, feature_maps, settings, listener=events.append)
    seen = found.totals.numpy() > 0.05
    np.testing.assert_allclose(found.means[seen], expected[seen], atol=3e-3)
    assert np.abs(first - expected)[seen].max() > 0.02
    done = [event.done for event in events]
    assert done == sorted(done)
    assert (done[-1], events[-1].total) == (2 * len(weighed), 2 * len(weighed))


def test_what_no_view_shows_enough_of_in_one_cell_has_no_language(small, feature_maps, weighed) -> None:
    best = np.max([weights.max(1) for weights, _ in weighed], axis=0)
    limit = float(np.median(best))
    found = averaged(small, feature_maps, least_weight=limit)
    sure = np.abs(best - limit) > 1e-4
    assert np.array_equal((found.totals.numpy() > 0)[sure], (best > limit)[sure])
    field = field_from_means(found, CodebookConfig(num_codes=3, use_dino=False), MEAN)
    assert (field.uncertainties[found.totals == 0] == 1).all()


def test_without_reliability_all_that_is_seen_is_certain(small, feature_maps) -> None:
    found, codes = averaged(small, feature_maps), CodebookConfig(num_codes=3, use_dino=False)
    with_it = field_from_means(found, codes, MEAN).uncertainties
    without = field_from_means(found, codes, replace(MEAN, reliability=False)).uncertainties
    seen = found.visible(MEAN)
    assert (with_it[seen] > 0).all()
    assert (without[seen] == 0).all()
    assert (without[~seen] == 1).all()


def test_ranges_of_dimensions_change_no_bit(small, feature_maps, tmp_path) -> None:
    everything = replace(MEAN, gate=0.7, squared=True, agreement=2.0, least_weight=0.01)
    expected = average_features(small.gaussians, small.cameras, feature_maps, everything)
    narrow = average_features(
        small.gaussians, small.cameras, feature_maps, everything, memory=30 * 8 * 3, scratch=tmp_path
    )
    assert np.array_equal(narrow.means, expected.means)
    assert torch.equal(narrow.totals, expected.totals)


@pytest.mark.parametrize(
    "bad", [{"gate": 0}, {"gate": 1.1}, {"least_weight": -0.1}, {"agreement": -1}, {"agreement": 31}]
)
def test_bad_settings_are_refused(bad) -> None:
    with pytest.raises(ValueError, match=r"shares|0\.\.30"):
        AveragedConfig(**bad)
