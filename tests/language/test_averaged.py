"""Claims about averaged features; the reference is the float64 renderer by definition and sums over its weights."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.language_scene import LanguageScene, label_accuracy, make_scene
from support.rendering_reference import blend, front_camera, project, random_gaussians, to_float64
from torch.nn.functional import normalize

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureMap, FeatureMaps
from lexsplat.language.fields import CodeField
from lexsplat.language.methods import METHODS, averaging
from lexsplat.language.methods.averaged import (
    AveragedConfig,
    features_of_codes,
    field_from_means,
)
from lexsplat.language.methods.averaging import MeanFeatures, average_features, sums_bound
from lexsplat.language.methods.method import FitRun, TrainingViews
from lexsplat.pipeline.config import BuildConfig
from lexsplat.queries.visibility import hidden_gaussians
from lexsplat.runtime.errors import MemoryBudgetError, TaskError
from lexsplat.runtime.memory import parse_bytes

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")
CODES = CodebookConfig(num_codes=5, use_dino=False)
FULL_SIZE = AveragedConfig(shortest_side=10_000)


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene()


@pytest.fixture(scope="module")
def small() -> LanguageScene:
    return make_scene(per_ball=6, views=3, width=20, height=15)


def random_features(cameras, dimensions: int = 7, seed: int = 0) -> dict[str, FeatureMap]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: FeatureMap(
            normalize(torch.randn(camera.height, camera.width, dimensions, generator=generator), dim=-1)
        )
        for name, camera in cameras.items()
    }


def reference(gaussians, cameras, maps) -> tuple[np.ndarray, np.ndarray]:
    """Sum of alpha T F and of alpha T over views and pixels that have a feature, float64."""
    dimensions = next(iter(maps.values())).clip.shape[-1]
    sums, totals = np.zeros((len(gaussians), dimensions)), np.zeros(len(gaussians))
    for name, camera in cameras.items():
        projected = project(to_float64(gaussians), camera, gaussians.antialiased)
        weights = blend(projected, torch.zeros(len(gaussians), 1), camera)[2].detach().numpy()
        features = maps[name].clip.double().numpy()
        known = np.abs(features).sum(-1) > 0
        weights = weights.reshape(len(gaussians), *known.shape)[:, known]
        sums += weights @ features[known]
        totals += weights.sum(1)
    return sums, totals


def test_each_gaussian_has_the_weighted_mean_of_its_features(small) -> None:
    maps = random_features(small.cameras)
    found = average_features(small.gaussians, small.cameras, maps, FULL_SIZE)
    sums, totals = reference(small.gaussians, small.cameras, maps)
    np.testing.assert_allclose(found.totals.numpy(), totals, rtol=1e-4, atol=1e-5)
    seen = totals > 0.01
    np.testing.assert_allclose(
        found.means[seen], sums[seen] / totals[seen, None], atol=2e-3
    )  # half precision


def test_the_dino_half_is_averaged_with_the_weights_of_the_clip_half(small) -> None:
    clip, dino = random_features(small.cameras), random_features(small.cameras, dimensions=5, seed=1)
    both = {name: FeatureMap(clip[name].clip, dino[name].clip) for name in clip}
    found = average_features(small.gaussians, small.cameras, both, replace(FULL_SIZE, dino=True))
    halves = found.halves(slice(None))
    assert [half.shape[1] for half in halves] == [7, 5]
    assert torch.equal(halves[0], found.rows(slice(None)))
    for half, maps in zip(halves, (clip, dino)):
        sums, totals = reference(small.gaussians, small.cameras, maps)
        seen = totals > 0.01
        np.testing.assert_allclose(half[torch.from_numpy(seen)], sums[seen] / totals[seen, None], atol=2e-3)
    without = average_features(small.gaussians, small.cameras, both, FULL_SIZE)
    assert without.means.shape[1] == 7


def test_things_that_are_alike_to_clip_get_codes_of_their_own_by_dino() -> None:
    clip = np.repeat(np.array([[1, 0], [1, 0], [0, 1]], np.float16), 20, axis=0)
    dino = np.repeat(np.array([[1, 0], [0, 1], [1, 0]], np.float16), 20, axis=0)
    config, codes = AveragedConfig(top=1, dino=True), CodebookConfig(num_codes=3)
    both = MeanFeatures(np.concatenate([clip, dino], 1), torch.ones(60), dino=2)
    found = field_from_means(both, codes, config).codes[:, 0].reshape(3, 20)
    assert len(found.unique()) == 3
    assert all(len(row.unique()) == 1 for row in found)
    blind = field_from_means(MeanFeatures(clip, torch.ones(60)), replace(codes, num_codes=2), config)
    assert blind.codebook.clip.shape == (2, 2)
    assert torch.equal(blind.codes[:20], blind.codes[20:40])


def test_levels_are_averaged_apart_with_their_halves(small) -> None:
    clip, dino = random_features(small.cameras), random_features(small.cameras, dimensions=5, seed=1)
    other, others = (random_features(small.cameras, d, seed) for d, seed in ((7, 2), (5, 3)))
    maps = {
        name: FeatureMap(
            clip[name].clip,
            dino[name].clip,
            (FeatureMap(clip[name].clip, dino[name].clip), FeatureMap(other[name].clip, others[name].clip)),
        )
        for name in clip
    }
    found = average_features(small.gaussians, small.cameras, maps, replace(FULL_SIZE, dino=True))
    alone = [
        average_features(small.gaussians, small.cameras, level, FULL_SIZE).means
        for level in (clip, dino, other, others)
    ]
    np.testing.assert_array_equal(found.means, np.concatenate(alone, 1))
    np.testing.assert_array_equal(found.rows(slice(None)), np.concatenate(alone[::2], 1))
    rows, count = found.apart(), len(small.gaussians)
    assert len(rows.totals) == 2 * count
    for level in (0, 1):
        halves = rows.halves(torch.arange(level, 2 * count, 2))
        for half, expected in zip(halves, alone[2 * level :]):
            np.testing.assert_array_equal(half, expected.astype(np.float32))


def test_cells_without_a_feature_are_ignored(small) -> None:
    maps = random_features(small.cameras)
    for name, found in maps.items():
        found.clip[:, :9] = 0
        maps[name] = FeatureMap(found.clip)
    found = average_features(small.gaussians, small.cameras, maps, FULL_SIZE)
    sums, totals = reference(small.gaussians, small.cameras, maps)
    np.testing.assert_allclose(found.totals.numpy(), totals, rtol=1e-4, atol=1e-5)
    seen = totals > 0.01
    np.testing.assert_allclose(found.means[seen], sums[seen] / totals[seen, None], atol=2e-3)


def test_masked_pixels_are_ignored_also_within_a_cell(small) -> None:
    """Cells of 4 x 3 pixels; the mask ends in the middle of some."""
    coarse = {
        name: FeatureMap(normalize(torch.randn(5, 5, 7, generator=torch.Generator().manual_seed(0)), dim=-1))
        for name in small.cameras
    }
    mask = np.ones((15, 20), bool)
    mask[4:, :9] = False
    asked = []

    def valid(name: str, size: tuple[int, int]) -> np.ndarray | None:
        asked.append(size)
        return mask if name != "view1" else None

    found = average_features(small.gaussians, small.cameras, coarse, FULL_SIZE, valid=valid)
    fine = {}
    for name, camera in small.cameras.items():
        pixels = coarse[name].clip.repeat_interleave(3, 0).repeat_interleave(4, 1)
        assert pixels.shape[:2] == (camera.height, camera.width)
        fine[name] = FeatureMap(
            pixels * torch.from_numpy(mask if name != "view1" else mask | True)[..., None]
        )
    sums, totals = reference(small.gaussians, small.cameras, fine)
    np.testing.assert_allclose(found.totals.numpy(), totals / 12, rtol=1e-4, atol=1e-5)  # in cells
    seen = totals > 0.12
    np.testing.assert_allclose(found.means[seen], sums[seen] / totals[seen, None], atol=2e-3)
    assert set(asked) == {(20, 15)}


@pytest.mark.parametrize("memory", [1, 30 * 8 * 3, 30 * 8 * 4])
def test_less_memory_takes_more_passes_and_gives_the_same(memory, small, tmp_path) -> None:
    maps = random_features(small.cameras)
    whole = average_features(small.gaussians, small.cameras, maps, FULL_SIZE)
    received = []
    found = average_features(
        small.gaussians, small.cameras, maps, FULL_SIZE,
        memory=4 * memory, scratch=tmp_path / "new", listener=received.append,
    )  # fmt: skip
    assert torch.equal(found.totals, whole.totals)
    np.testing.assert_allclose(np.asarray(found.means, float), np.asarray(whole.means, float), atol=1e-3)
    assert (received[-1].done, received[-1].total) == ({1: 21, 30 * 8 * 3: 9, 30 * 8 * 4: 6}[memory],) * 2
    assert list((tmp_path).rglob("*.*")) == []  # the file of the means has no name


def test_views_are_reduced_by_at_most_four() -> None:
    camera, config = front_camera(1600, 1067), AveragedConfig()
    sizes = {}
    for cells in ((56, 84), (112, 168), (400, 600), (1067, 1600)):
        found = averaging._at_map_size(camera, torch.zeros(*cells, 1), True, config)
        sizes[cells] = (found.width, found.height)
    assert sizes == {
        (56, 84): (400, 267), (112, 168): (400, 267), (400, 600): (600, 400), (1067, 1600): (1600, 1067),
    }  # fmt: skip


def test_sums_on_a_gpu_are_bounded_by_its_free_memory_and_not_by_the_host(monkeypatch) -> None:
    gpu, free = torch.device("cuda", 0), 24 << 30
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, 2 * free))
    assert sums_bound(gpu, 4 << 30) == free // 2
    passes = [len(list(averaging._ranges(512, 3_000_000, sums_bound(d, 4 << 30)))) for d in (gpu, CPU)]
    assert passes == [1, 12]
    assert sums_bound(CPU, 2 << 30) == 1 << 29
    assert sums_bound(CPU, 64 << 30) == 1 << 30
    free = 1 << 30
    assert sums_bound(gpu, 4 << 30) == 1 << 29


@pytest.mark.parametrize("memory", ["4GB", "100B"])
def test_features_that_are_not_read_again_are_freed(memory, small, tmp_path) -> None:
    maps = random_features(small.cameras)
    loaded = []

    def load(name: str) -> FeatureMap:
        loaded.append(name)
        return maps[name]

    kept = FeatureMaps(list(maps), load)
    assert "nobody" not in kept
    assert all(name in kept for name in maps)
    assert loaded == [], "whether there is a map is answered without loading it"
    average_features(
        small.gaussians, small.cameras, kept, FULL_SIZE, memory=parse_bytes(memory), scratch=tmp_path
    )
    assert kept.cached_bytes == 0


def test_known_labels_and_features_are_recovered(balls) -> None:
    maps = features_of_codes(balls.code_maps, balls.codebook)
    found = average_features(balls.gaussians, balls.cameras, maps, AveragedConfig())
    field = field_from_means(found, replace(CODES, num_codes=20), AveragedConfig())
    assert field.codebook.dino is None
    ball = (field.codebook.clip @ balls.codebook.clip.T).argmax(1)  # that each code speaks of
    assert (ball[field.codes[:, 0].long()].numpy() == balls.labels).mean() > 0.97
    renamed = CodeField(
        balls.codebook, ball[field.codes.long()].to(torch.uint8), field.weights, field.uncertainties
    )
    assert label_accuracy(renamed, balls) > 0.97


def test_an_object_keeps_its_code_despite_random_disagreement(balls) -> None:
    """One ball of five is seen as itself in 60 % of its pixels only; the mean over views still identifies it."""
    generator = np.random.default_rng(1)
    wrong = {
        name: np.where(
            (codes == 4) & (generator.random(codes.shape) < 0.4), generator.integers(0, 4, codes.shape), codes
        )
        for name, codes in balls.code_maps.items()
    }
    maps = features_of_codes(wrong, balls.codebook)
    found = average_features(balls.gaussians, balls.cameras, maps, AveragedConfig())
    field = field_from_means(found, CODES, AveragedConfig())
    said = (normalize(found.rows(slice(None)), dim=-1) @ balls.codebook.clip.T).argmax(1).numpy()
    assert (said[balls.labels == 4] == 4).mean() > 0.9
    assert float(field.uncertainties[balls.labels == 4].mean()) > 1.5 * float(
        field.uncertainties[balls.labels == 0].mean()
    )


def test_a_gaussian_that_no_view_shows_has_no_language(balls) -> None:
    hidden = balls.gaussians.map(lambda tensor: torch.cat([tensor, tensor[:1]]))
    hidden.means[-1] = torch.tensor([50.0, 0.0, 50.0])
    maps = features_of_codes(balls.code_maps, balls.codebook)
    found = average_features(hidden, balls.cameras, maps, AveragedConfig())
    field = field_from_means(found, CODES, AveragedConfig())
    assert float(field.weights[-1].sum()) == 0
    assert field.unseen == 1
    assert float(field.uncertainties[-1]) == 1
    torch.testing.assert_close(field.weights[:-1].sum(1), torch.ones(len(hidden) - 1))
    none = MeanFeatures(found.means[-1:], found.totals[-1:])  # a scene that no view shows
    silent = field_from_means(none, CODES, AveragedConfig())
    assert silent.codebook.num_codes == 1
    assert float(silent.weights.sum()) == 0


def test_what_counts_as_unseen_has_no_mass_in_its_segment_and_so_is_hidden(balls) -> None:
    maps = features_of_codes(balls.code_maps, balls.codebook)
    totals = average_features(balls.gaussians, balls.cameras, maps, AveragedConfig()).totals
    limit = float(totals.quantile(0.2))
    views = {
        name: SimpleNamespace(camera=camera, load_valid=lambda size: None)
        for name, camera in balls.cameras.items()
    }
    config = BuildConfig(codebook=CODES, averaged=AveragedConfig(min_visibility=limit))
    field = METHODS["averaged"].fit(balls.gaussians, TrainingViews(views, features=maps), config, FitRun())
    unseen = field.weights.sum(1) == 0
    assert torch.equal(unseen, totals < limit)
    assert torch.equal(field.segments.masses == 0, unseen)
    assert hidden_gaussians(balls.gaussians, list(balls.cameras.values()), field.segments.masses)[
        unseen
    ].all()


def _codes_of(centers: np.ndarray, own: np.ndarray, unit: np.ndarray, field: CodeField) -> bool:
    """Whether the codewords are the mean directions of what is nearest to each center, in any order."""
    nearest = (own @ centers.T).argmax(1)
    means = np.stack([unit[nearest == code].sum(0) for code in range(len(centers))])
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    found = field.codebook.clip.double().numpy()
    return any(np.allclose(found, means[order], atol=1e-3) for order in ([0, 1], [1, 0]))


def test_weights_are_the_softmax_of_the_cosines_by_hand() -> None:
    means = np.array([[1, 0], [0, 1], [0.6, 0.6]], np.float16)
    found = MeanFeatures(means, torch.tensor([1.0, 3.0, 0.25]))
    config = AveragedConfig(top=2, temperature=0.5)
    field = field_from_means(found, CodebookConfig(num_codes=2, kmeans_iterations=0), config, seed=0)
    unit = means.astype(float) / np.linalg.norm(means.astype(float), axis=1, keepdims=True)
    own = unit - unit.mean(0)  # without the direction that all share
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    # Without iterations the centers are two of the three; each code is the mean of the features nearest to it.
    chosen = [pair for pair in ([0, 1], [0, 2], [1, 2]) if _codes_of(own[pair], own, unit, field)]
    assert len(chosen) == 1
    spread = 1 - (own @ own[chosen[0]].T).max(1).mean()
    for row in range(3):
        cosines = own[chosen[0]] @ own[row] / (0.5 * spread)
        expected = np.exp(cosines) / np.exp(cosines).sum()
        np.testing.assert_allclose(field.weights[row].numpy(), np.sort(expected)[::-1], atol=1e-5)
    squares, shared = (means.astype(float) ** 2).sum(1), (unit.mean(0) ** 2).sum()
    agreement = np.clip((squares - shared) / (1 - shared), 0, 1)
    expected = 1 - agreement * np.array([1 / 1.25, 3 / 3.25, 0.5])
    np.testing.assert_allclose(field.uncertainties.numpy(), expected, atol=1e-5)


def test_uncertainties_mean_the_same_in_a_wide_and_in_a_narrow_cone() -> None:
    """Half of the Gaussians are seen as one thing, the others as two in turn; all features share a direction."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 40, 1000), rng.integers(0, 40, 1000)
    second[::2] = first[::2]
    fields = []
    for shared in (0.0, 0.5, 0.73):  # mean cosine of two features
        things = np.hstack([np.full((40, 1), shared**0.5), (1 - shared) ** 0.5 * np.eye(40)])
        means = (things[first] + things[second]) / 2
        found = MeanFeatures(means.astype(np.float16), torch.full((1000,), 100.0))
        fields.append(field_from_means(found, replace(CODES, num_codes=40), AveragedConfig(), seed=0))
    differ = first != second
    for field in fields:
        assert (field.uncertainties[~differ] < 0.01).all()
        assert 0.5 < float(field.uncertainties[differ].mean()) < 0.7  # 1 - |F| is 0.29 to 0.07


@pytest.mark.slow
def test_weights_are_as_soft_for_few_codes_as_for_many_in_any_cone() -> None:
    """Directions that fill a sphere look alike at any size of its cells: only the spread tells how far is far."""
    inner = np.random.default_rng(0).normal(size=(3000, 3))
    inner /= np.linalg.norm(inner, axis=1, keepdims=True)
    largest = []
    for shared in (0.0, 0.73):  # mean cosine of two features
        means = np.hstack([np.full((3000, 1), shared**0.5), (1 - shared) ** 0.5 * inner])
        found = MeanFeatures(means.astype(np.float16), torch.full((3000,), 100.0))
        for number in (24, 96):
            field = field_from_means(found, replace(CODES, num_codes=number), AveragedConfig(), seed=0)
            largest.append(float(field.weights[:, 0].mean()))
    assert max(largest) - min(largest) < 0.08  # one temperature for both numbers of codes: 0.28
    assert 0.5 < min(largest) < 0.8


@pytest.mark.slow
def test_averages_are_bit_identical_on_any_number_of_threads() -> None:
    gaussians, camera = random_gaussians(20_000, 0, scale=0.02), front_camera(160, 120)
    maps = random_features({"a": camera}, dimensions=70)
    results = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)  # back to one after each test
        found = average_features(gaussians, {"a": camera}, maps, AveragedConfig())
        field = field_from_means(found, replace(CODES, num_codes=20), AveragedConfig())
        means = torch.from_numpy(np.asarray(found.means))
        results.append([found.totals, means, field.codes, field.weights, field.uncertainties])
    assert int((results[0][0] > 0).sum()) > 5_000
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other))


def test_weights_do_not_depend_on_the_size_of_the_views(balls) -> None:
    """Half of the size gives nearly the same means; without the mip filter views stay as they are."""
    cameras = {name: camera.downscaled(0.25) for name, camera in balls.cameras.items()}  # four times as large
    maps = features_of_codes(balls.code_maps, balls.codebook)
    small = average_features(balls.gaussians, cameras, maps, AveragedConfig(shortest_side=24))
    large = average_features(balls.gaussians, cameras, maps, AveragedConfig(shortest_side=96))
    well = large.totals > 1
    assert int(well.sum()) > 100
    cosine = normalize(small.rows(well.nonzero()[:, 0]), dim=-1) * normalize(
        large.rows(well.nonzero()[:, 0]), dim=-1
    )
    assert float(cosine.sum(-1).median()) > 0.99
    assert float((small.totals.sum() / large.totals.sum() - 1).abs()) < 0.1
    classic = replace(balls.gaussians, antialiased=False)
    first = average_features(classic, cameras, maps, AveragedConfig(shortest_side=24))
    second = average_features(classic, cameras, maps, AveragedConfig(shortest_side=96))
    assert torch.equal(first.totals, second.totals)


def test_a_sample_that_does_not_fit_is_refused_with_one_that_does() -> None:
    found = MeanFeatures(np.ones((5000, 64), np.float16), torch.ones(5000))
    with pytest.raises(MemoryBudgetError, match=r"sample-size \d+") as refusal:
        field_from_means(found, CODES, AveragedConfig(), memory=2_000_000)
    message = str(refusal.value)
    fits = int(message.split("sample-size ")[1].split()[0].rstrip(".,)"))
    enough = parse_bytes(message.split("use --memory ")[1].split(",")[0].replace(" ", ""))
    field_from_means(found, CODES, AveragedConfig(), memory=enough)
    assert 100 < fits < 5000
    field_from_means(found, replace(CODES, sample_size=fits), AveragedConfig(), memory=2_000_000)


def test_codes_out_of_range_give_zero_features(balls) -> None:
    codes = np.array([[0, 4], [255, -1]], np.int16)
    found = features_of_codes({"a": codes}, balls.codebook)["a"].clip
    assert torch.equal(found[0], balls.codebook.clip[[0, 4]])
    assert float(found[1].abs().sum()) == 0


def test_missing_views_and_other_dimensions_are_refused(small) -> None:
    maps = random_features(small.cameras)
    with pytest.raises(ValueError, match="no training view"):
        average_features(small.gaussians, {}, maps, FULL_SIZE)
    with pytest.raises(ValueError, match="view1"):
        average_features(
            small.gaussians, small.cameras, {n: m for n, m in maps.items() if n != "view1"}, FULL_SIZE
        )
    maps["view1"] = FeatureMap(torch.ones(15, 20, 3))
    with pytest.raises(TaskError, match="view1 have 3 dimensions"):
        average_features(small.gaussians, small.cameras, maps, FULL_SIZE)


@pytest.mark.parametrize(
    "bad", [{"top": 0}, {"temperature": 0}, {"shortest_side": 0}, {"min_visibility": -1}]
)
def test_bad_settings_are_refused(bad) -> None:
    with pytest.raises(ValueError, match="must"):
        AveragedConfig(**bad)
