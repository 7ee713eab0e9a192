"""Claims about lifting; the reference is the float64 renderer by definition and sums over its weights."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import IGNORED, label_accuracy, make_codebook, make_scene
from support.rendering_reference import blend, front_camera, project, random_gaussians, to_float64

from lexsplat.language.fields import TrainedField
from lexsplat.language.methods.lifted import (
    CodeHistogram,
    LiftedConfig,
    TuningConfig,
    accumulate_histogram,
    fit_semantics,
    lift,
    principal_semantics,
    smooth_codes,
    tune,
)
from lexsplat.language.methods.trained_settings import TrainedConfig

EXACT = LiftedConfig(top=5, use_smoothing=False)
EMBEDDING = TrainedConfig(pixel_sample=200, smoothing_sample=100)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(scope="module")
def small():
    return make_scene(per_ball=6, views=3, width=20, height=15)


@pytest.fixture(scope="module")
def reference(small) -> np.ndarray:
    """Sum over views and pixels of alpha T by code, float64 ``[N, K]``."""
    histogram = np.zeros((len(small.gaussians), 5))
    for name, camera in small.cameras.items():
        projected = project(to_float64(small.gaussians), camera, small.gaussians.antialiased)
        weights = blend(projected, torch.zeros(len(small.gaussians), 1), camera)[2].detach().numpy()
        for code in range(5):
            histogram[:, code] += weights[:, small.code_maps[name] == code].sum(1)
    return histogram


def lift_scene(scene, config, code_maps=None):
    return lift(scene.gaussians, scene.cameras, code_maps or scene.code_maps, scene.codebook, config)


def dense(histogram: CodeHistogram) -> np.ndarray:
    filled = np.zeros((len(histogram.codes), histogram.num_codes))
    for n, (codes, weights) in enumerate(zip(histogram.codes.tolist(), histogram.weights.tolist())):
        for code, weight in zip(codes, weights):
            filled[n, code] += weight
    return filled


def noisy(scene, share: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Index maps with a share of wrong pixels, differently in every view."""
    rng = np.random.default_rng(seed)
    maps = {}
    for name, code_map in scene.code_maps.items():
        wrong = (rng.random(code_map.shape) < share) & (code_map != IGNORED)
        maps[name] = np.where(wrong, (code_map + rng.integers(1, 5, code_map.shape)) % 5, code_map).astype(
            np.uint8
        )
    return maps


def test_the_histogram_is_the_weight_of_each_gaussian_in_pixels_of_each_code(small, reference) -> None:
    histogram = accumulate_histogram(small.gaussians, small.cameras, small.code_maps, 5, EXACT)
    np.testing.assert_allclose(dense(histogram), reference, atol=1e-4)
    np.testing.assert_allclose(histogram.totals, reference.sum(1), atol=1e-4)
    assert histogram.dropped == pytest.approx(0, abs=1e-6)


def test_lifted_probabilities_are_the_normalized_histogram(small, reference) -> None:
    field = lift_scene(small, EXACT)
    totals = reference.sum(1, keepdims=True)
    expected = np.where(totals >= EXACT.min_visibility, reference / np.maximum(totals, 1e-12), 0)
    np.testing.assert_allclose(field.code_probabilities(), expected, atol=1e-4)


def test_uncertainty_is_the_normalized_entropy_believed_by_visibility(small, reference) -> None:
    histogram = accumulate_histogram(small.gaussians, small.cameras, small.code_maps, 5, EXACT)
    for n, row in enumerate(reference):
        total = row.sum()
        share = row[row > 0] / total if total > 0 else np.zeros(0)
        entropy = float(-(share * np.log(share)).sum())
        expected = 1 - (1 - entropy / math.log(5)) * total / (total + 1) if total >= 0.01 else 1
        assert float(histogram.uncertainties(EXACT)[n]) == pytest.approx(expected, abs=2e-3)


def test_what_was_hardly_seen_carries_no_language(small, reference) -> None:
    totals = reference.sum(1)
    gate = float(np.median(totals[totals > 0]))
    field = lift_scene(small, replace(EXACT, min_visibility=gate))
    seen = torch.from_numpy(totals >= gate)
    assert 0 < seen.sum() < len(seen)
    sums = field.code_probabilities().sum(1)
    np.testing.assert_allclose(sums[seen], 1, atol=1e-5)
    assert not sums[~seen & torch.from_numpy(np.abs(totals - gate) > 1e-3)].any()


def test_the_visibility_at_which_a_histogram_is_half_believed_is_the_setting(small) -> None:
    histogram = accumulate_histogram(small.gaussians, small.cameras, small.code_maps, 5, EXACT)
    sure = replace(histogram, entropies=torch.zeros_like(histogram.entropies))
    seen = histogram.totals > 0.5
    for prior in (0.5, 7.0):
        expected = prior / (histogram.totals + prior)
        found = sure.uncertainties(replace(EXACT, prior_visibility=prior))
        np.testing.assert_allclose(found[seen], expected[seen], atol=1e-6)


@pytest.mark.parametrize("memory_codes", [1, 2, 4])
def test_a_memory_bound_changes_nothing_but_the_number_of_passes(small, memory_codes: int) -> None:
    whole = accumulate_histogram(small.gaussians, small.cameras, small.code_maps, 5, replace(EXACT, top=3))
    bound = replace(EXACT, top=3, memory_bytes=memory_codes * 8 * len(small.gaussians))
    events = []
    parts = accumulate_histogram(
        small.gaussians, small.cameras, small.code_maps, 5, bound, listener=events.append
    )
    assert len(events) == 3 * math.ceil(5 / memory_codes)
    assert events[-1].done == events[-1].total == len(events)
    assert events[-1].metrics == {"dropped": parts.dropped}, "the user hears what sparsity costs"
    np.testing.assert_allclose(dense(parts), dense(whole), atol=1e-6)
    np.testing.assert_allclose(parts.entropies, whole.entropies, atol=1e-5)
    np.testing.assert_allclose(parts.totals, whole.totals, rtol=1e-6)


def test_the_error_of_sparsity_is_reported(small, reference) -> None:
    for top in (1, 2, 5):
        kept = np.sort(reference, axis=1)[:, ::-1][:, :top].sum()
        histogram = accumulate_histogram(
            small.gaussians, small.cameras, small.code_maps, 5, replace(EXACT, top=top)
        )
        assert histogram.codes.shape == (len(small.gaussians), top)
        assert histogram.dropped == pytest.approx(1 - kept / reference.sum(), abs=1e-5)
        field = lift_scene(small, replace(EXACT, top=top))
        assert type(field).from_tensors(field.tensors(), field.metadata()).dropped == pytest.approx(
            histogram.dropped, abs=1e-6
        )


def test_lifting_recovers_known_labels(scene) -> None:
    for config in (LiftedConfig(use_smoothing=True), EXACT):
        field = lift_scene(scene, config)
        assert label_accuracy(field, scene) > 0.95
        known = field.weights.sum(1) > 0
        right = field.codes[:, 0].numpy() == scene.labels
        assert right[known.numpy()].mean() > 0.95
        np.testing.assert_allclose(field.code_probabilities().sum(1)[known], 1, atol=1e-5)


def test_wrong_pixels_are_outvoted_and_raise_the_uncertainty(scene) -> None:
    clean, disturbed = lift_scene(scene, EXACT), lift_scene(scene, EXACT, noisy(scene, 0.3))
    assert label_accuracy(disturbed, scene) > 0.95
    seen = clean.uncertainties < 0.5
    assert (disturbed.uncertainties > clean.uncertainties)[seen].float().mean() > 0.95


def test_smoothing_repairs_the_barely_seen(scene) -> None:
    one_view = {"view0": scene.cameras["view0"]}
    code_maps = noisy(scene, 0.45)
    right = {}
    for on in (True, False):
        field = lift(
            scene.gaussians,
            one_view,
            code_maps,
            scene.codebook,
            LiftedConfig(use_smoothing=on, min_smoothing_weight=1.0),
        )
        right[on] = float(
            (field.codes[:, 0].numpy() == scene.labels)[field.weights.sum(1).numpy() > 0].mean()
        )
    assert right[True] > right[False]


def test_smoothing_is_its_formula() -> None:
    rng = np.random.default_rng(1)
    count, num_codes = 12, 6
    means = rng.normal(size=(count, 3))
    codes = np.stack([rng.permutation(num_codes) for _ in range(count)])
    weights = rng.random((count, num_codes))
    weights /= weights.sum(1, keepdims=True)
    u, visible = rng.random(count), np.ones(count, bool)
    visible[4], weights[4], u[4] = False, 0, 1
    config = LiftedConfig(top=num_codes, neighbors=3, min_smoothing_weight=0.3)
    found_codes, found_weights = smooth_codes(
        torch.tensor(means), torch.tensor(codes, dtype=torch.uint8), torch.tensor(weights), torch.tensor(u),
        torch.tensor(visible), num_codes, config,
    )  # fmt: skip
    p = np.zeros((count, num_codes))
    for n in range(count):
        p[n, codes[n]] = weights[n]
    for n in range(count):
        distance = np.linalg.norm(means - means[n], axis=1)
        others = [j for j in np.argsort(distance) if visible[j] and j != n]
        near = others[: 3 if visible[n] else 4]
        mean = sum((1 - u[j]) * p[j] for j in near) / sum(1 - u[j] for j in near)
        pull = max(u[n], 0.3)
        expected = ((1 - u[n]) * p[n] + pull * mean) / (1 - u[n] + pull)
        found = np.zeros(num_codes)
        found[found_codes[n].numpy()] = found_weights[n].numpy()
        np.testing.assert_allclose(found, expected / expected.sum(), atol=1e-6)


def test_gaussians_no_view_shows_stay_silent_without_smoothing_and_follow_their_neighbors_with_it(
    scene,
) -> None:
    hidden = scene.gaussians.map(lambda tensor: torch.cat([tensor, tensor[:1]]))
    hidden.means[-1] = torch.tensor([-0.9, 0.0, 0.0])  # inside the first ball
    hidden.log_scales[-1] = -9.0
    hidden.opacity_logits[-1] = -20.0
    for config, expected in ((EXACT, 0.0), (LiftedConfig(use_smoothing=True), 1.0)):
        field = lift(hidden, scene.cameras, scene.code_maps, scene.codebook, config)
        assert float(field.uncertainties[-1]) == 1
        assert float(field.code_probabilities()[-1].sum()) == pytest.approx(expected, abs=1e-6)
        if expected:
            assert int(field.codes[-1, 0]) == 0


def test_the_number_of_threads_changes_no_bit_of_what_is_lifted() -> None:
    # Large enough for torch to share its sums out too.
    gaussians, camera = random_gaussians(40_000, 0, scale=0.02), front_camera(160, 120)
    codes = np.random.default_rng(0).integers(0, 20, (120, 160)).astype(np.uint8)
    codebook, config = make_codebook(20), LiftedConfig(min_visibility=0.01)
    results = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)  # back to one after each test
        histogram = accumulate_histogram(gaussians, {"a": camera}, {"a": codes}, 20, config)
        field = lift(gaussians, {"a": camera}, {"a": codes}, codebook, config)
        results.append([histogram.totals, histogram.weights, histogram.entropies, field.weights, field.codes])
    assert int((results[0][0] > 0).sum()) > 5_000
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other))


def test_views_without_a_camera_take_no_part(scene) -> None:
    cameras = {name: camera for name, camera in scene.cameras.items() if name != "view3"}
    wrong = scene.code_maps | {"view3": np.zeros_like(scene.code_maps["view3"])}
    first = lift(scene.gaussians, cameras, scene.code_maps, scene.codebook, EXACT)
    second = lift(scene.gaussians, cameras, wrong, scene.codebook, EXACT)
    assert torch.equal(first.weights, second.weights)


def test_coarse_index_maps_are_spread_over_their_pixels(small) -> None:
    coarse = {name: code_map[::5, ::5] for name, code_map in small.code_maps.items()}
    spread = {name: np.kron(code_map, np.ones((5, 5), np.uint8)) for name, code_map in coarse.items()}
    first, second = lift_scene(small, EXACT, coarse), lift_scene(small, EXACT, spread)
    assert torch.equal(first.weights, second.weights)
    assert torch.equal(first.codes, second.codes)


def test_principal_semantics_keep_the_distances_of_meanings(scene) -> None:
    field = lift_scene(scene, EXACT)
    start = principal_semantics(field)
    assert start.shape == (len(scene.gaussians), 8)
    seen = field.weights.sum(1) > 0
    same = torch.cdist(start[seen], start[seen])
    labels = torch.tensor(scene.labels)[seen]
    alike = labels[:, None] == labels[None, :]
    assert same[alike].mean() < 0.5 * same[~alike].mean()


def test_the_fit_without_rendering_reproduces_the_distributions(scene) -> None:
    lifted = lift_scene(scene, EXACT)
    field = TrainedField.initial(scene.gaussians, scene.codebook, generator=torch.Generator().manual_seed(0))
    fit_semantics(
        field,
        lifted,
        scene.gaussians,
        TuningConfig(fit_steps=80, batch_size=256, fit_lr=0.02),
        generator=torch.Generator().manual_seed(0),
    )
    known = lifted.weights.sum(1) > 0
    found, wanted = field.code_probabilities()[known], lifted.code_probabilities()[known]
    trust = 1 - lifted.uncertainties[known]
    error = ((found - wanted).abs().sum(1) * trust).sum() / trust.sum()
    assert float(error) < 0.15


def test_tuning_ends_in_the_papers_field_and_recovers_known_labels(scene) -> None:
    before = {name: tensor.clone() for name, tensor in scene.gaussians.tensors().items()}
    events = []
    field = tune(
        lift_scene(scene, LiftedConfig()),
        scene.gaussians,
        scene.cameras,
        scene.code_maps,
        TuningConfig(fit_steps=60, batch_size=256, fit_lr=0.02, iterations=10),
        EMBEDDING,
        listener=events.append,
    )
    last = {event.stage: (event.done, event.total) for event in events}
    assert last == {"fit": (60, 60), "language": (10, 10)}, (
        "so many steps without rendering, then so many with it"
    )
    assert isinstance(field, TrainedField)
    assert field.method == "lifted+tuned"
    assert label_accuracy(field, scene) > 0.95
    assert all(torch.equal(tensor, before[name]) for name, tensor in scene.gaussians.tensors().items())


def test_bad_input_is_refused(scene) -> None:
    with pytest.raises(ValueError, match="no training view"):
        lift(scene.gaussians, {}, {}, scene.codebook, EXACT)
    with pytest.raises(ValueError, match="no index map for view0"):
        lift(scene.gaussians, scene.cameras, {}, scene.codebook, EXACT)
    with pytest.raises(ValueError, match="must be positive"):
        LiftedConfig(top=0)
