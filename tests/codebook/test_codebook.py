"""Claims about quantization; the references are float64 loops over scalars."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lexsplat.codebook import (
    Codebook,
    CodebookConfig,
    assign_code_maps,
    code_usage,
    fit_codebook,
    load_balancing_loss,
    mean_cosine,
    quantization_loss,
    sample_features,
    similarity,
    spherical_kmeans,
)
from lexsplat.codebook.fitting import _kmeans_seeds

pytestmark = pytest.mark.usefixtures("one_thread")


@dataclass
class Map:
    clip: torch.Tensor
    dino: torch.Tensor | None = None


class ReadLog(Mapping[str, Map]):
    """Feature maps that remember which names were read."""

    def __init__(self, maps: dict[str, Map]) -> None:
        self.maps, self.read = maps, set()

    def __getitem__(self, name: str) -> Map:
        self.read.add(name)
        return self.maps[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.maps)

    def __len__(self) -> int:
        return len(self.maps)


def unit(values: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(values, dim=-1)


def clustered_maps(seed: int, views: int = 3, groups: int = 6, size: int = 12) -> tuple[dict[str, Map], dict]:
    """Feature maps around a few directions, with the group of every cell."""
    generator = torch.Generator().manual_seed(seed)
    clip = unit(torch.randn(groups, 16, generator=generator))
    dino = unit(torch.randn(groups, 10, generator=generator))
    maps, labels = {}, {}
    for view in range(views):
        label = torch.randint(groups, (size, size + 2), generator=generator)
        noise = 0.05 * torch.randn(size, size + 2, 26, generator=generator)
        maps[f"v{view}"] = Map(unit(clip[label] + noise[..., :16]), unit(dino[label] + noise[..., 16:]))
        labels[f"v{view}"] = label.numpy()
    return maps, labels


def reference_cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(sum(x * y for x, y in zip(a, b)) / (np.sqrt(sum(a * a)) * np.sqrt(sum(b * b))))


def random_problem(seed: int, rows: int = 7, codes: int = 5) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    shapes = [(rows, 6), (rows, 4), (codes, 6), (codes, 4)]
    return tuple(torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in shapes)


def reference_similarity(clip, dino, code_clip, code_dino, weight) -> np.ndarray:
    scores = np.zeros((len(clip), len(code_clip)))
    for i in range(len(clip)):
        for k in range(len(code_clip)):
            scores[i, k] = reference_cosine(clip[i].numpy(), code_clip[k].numpy())
            if code_dino is not None:
                scores[i, k] += weight * reference_cosine(dino[i].numpy(), code_dino[k].numpy())
    return scores


@pytest.mark.parametrize("weight", [0.0, 0.5, 2.0])
def test_similarity_is_equation_4(weight: float) -> None:
    clip, dino, code_clip, code_dino = random_problem(0)
    expected = reference_similarity(clip, dino, code_clip, code_dino, weight)
    np.testing.assert_allclose(similarity(clip, dino, code_clip, code_dino, weight), expected, rtol=1e-12)


def test_similarity_without_dino_codes_compares_clip_only() -> None:
    clip, dino, code_clip, _ = random_problem(1)
    expected = reference_similarity(clip, dino, code_clip, None, 0.5)
    np.testing.assert_allclose(similarity(clip, dino, code_clip, None, 0.5), expected, rtol=1e-12)


def reference_load_balancing(scores: np.ndarray, temperature: float) -> float:
    count, codes = scores.shape
    used, probability = np.zeros(codes), np.zeros(codes)
    for row in scores:
        used[max(range(codes), key=lambda j: row[j])] += 1 / count
        exponentials = np.exp(row / temperature)
        probability += exponentials / exponentials.sum() / count
    return float(sum(used * probability))


@pytest.mark.parametrize("temperature", [1.0, 0.1])
def test_load_balancing_loss_is_supplement_a(temperature: float) -> None:
    scores = torch.randn(40, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    expected = reference_load_balancing(scores.numpy(), temperature)
    assert float(load_balancing_loss(scores, temperature)) == pytest.approx(expected, rel=1e-12)


def test_load_balancing_gradient_disfavors_the_used_code() -> None:
    scores = torch.zeros(10, 2, dtype=torch.float64)
    scores[:, 0] = 0.2
    scores.requires_grad_()
    load_balancing_loss(scores).backward()
    p = float(torch.sigmoid(torch.tensor(0.2, dtype=torch.float64)))
    # r = (1, 0), so dL/dD_i0 = p (1 - p) / 10 and dL/dD_i1 its negative.
    np.testing.assert_allclose(scores.grad[:, 0], p * (1 - p) / 10, rtol=1e-12)
    np.testing.assert_allclose(scores.grad[:, 1], -p * (1 - p) / 10, rtol=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(2, 9))
def test_load_balancing_loss_is_at_most_one_and_lowest_when_balanced(seed: int, codes: int) -> None:
    scores = torch.randn(60, codes, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert 0 < float(load_balancing_loss(scores)) <= 1
    balanced = torch.eye(codes, dtype=torch.float64).repeat(4, 1)
    collapsed = balanced[:1].repeat(4 * codes, 1)
    assert float(load_balancing_loss(balanced)) == pytest.approx(1 / codes)
    assert float(load_balancing_loss(collapsed)) > float(load_balancing_loss(balanced))


@pytest.mark.parametrize("load_balancing", [True, False])
@pytest.mark.parametrize("use_dino", [True, False])
def test_quantization_loss_is_equation_7_with_its_gradient(load_balancing: bool, use_dino: bool) -> None:
    clip, dino, code_clip, code_dino = random_problem(4, rows=9)
    config = CodebookConfig(
        num_codes=5, lambda_dino=0.8, lambda_cos=0.7, lambda_lb=0.3, load_balancing=load_balancing
    )
    dino, code_dino = (dino, code_dino) if use_dino else (None, None)

    def reference(flat: np.ndarray) -> float:
        codes = torch.from_numpy(flat.reshape(5, 6))
        scores = reference_similarity(clip, dino, codes, code_dino, 0.8)
        chosen = scores.argmax(1)
        ceiling = 1.8 if use_dino else 1.0
        loss = 0.7 * np.mean([ceiling - scores[i, m] for i, m in enumerate(chosen)])
        return loss + (0.3 * reference_load_balancing(scores, 1.0) if load_balancing else 0)

    codes = code_clip.clone().requires_grad_()
    loss = quantization_loss(clip, dino, codes, code_dino, config)
    loss.backward()
    flat = code_clip.numpy().ravel()
    assert float(loss.detach()) == pytest.approx(reference(flat), rel=1e-12)
    numeric = [(reference(flat + step) - reference(flat - step)) / 2e-6 for step in 1e-6 * np.eye(len(flat))]
    np.testing.assert_allclose(codes.grad.numpy().ravel(), numeric, atol=1e-8)


def test_assign_takes_the_best_code_of_every_cell() -> None:
    maps, _ = clustered_maps(0, views=1)
    generator = torch.Generator().manual_seed(5)
    book = Codebook(
        unit(torch.randn(9, 16, generator=generator)), unit(torch.randn(9, 10, generator=generator))
    )
    code_map = book.assign(maps["v0"])
    assert code_map.shape == (12, 14)
    assert code_map.dtype == np.uint8
    for i in range(12):
        for j in range(14):
            cell = (maps["v0"].clip[i, j][None].double(), maps["v0"].dino[i, j][None].double())
            scores = reference_similarity(*cell, book.clip.double(), book.dino.double(), 0.5)
            assert code_map[i, j] == scores.argmax()


def test_assign_in_blocks_equals_assign_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    maps, _ = clustered_maps(1, views=1)
    book = Codebook(unit(torch.randn(9, 16)), unit(torch.randn(9, 10)))
    whole = book.assign(maps["v0"])
    monkeypatch.setattr("lexsplat.codebook.space.BLOCK_ROWS", 7)
    np.testing.assert_array_equal(book.assign(maps["v0"]), whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings_", [CodebookConfig(num_codes=6), CodebookConfig(num_codes=6).as_in_paper()]
)
def test_fit_finds_the_groups(settings_: CodebookConfig) -> None:
    maps, labels = clustered_maps(2)
    if settings_.init == "uniform":
        # From a random start several groups may share a code, the weakness k-means++ seeds do not have.
        settings_ = CodebookConfig(num_codes=24, init="uniform", steps=200, learning_rate=1e-2)
    book = fit_codebook(maps, sorted(maps), settings_, seed=0)
    code_maps = assign_code_maps(maps, book)
    codes = np.concatenate([code_maps[name].ravel() for name in maps])
    groups = np.concatenate([labels[name].ravel() for name in maps])
    for code in np.unique(codes):
        members = groups[codes == code]
        assert (members == np.bincount(members).argmax()).mean() > 0.95
    clip = torch.cat([maps[name].clip.flatten(0, 1) for name in maps])
    dino = torch.cat([maps[name].dino.flatten(0, 1) for name in maps])
    assert mean_cosine(book, clip, dino) > 0.97


def test_kmeans_never_raises_the_cosine_loss() -> None:
    maps, _ = clustered_maps(3, groups=20)
    config = CodebookConfig(num_codes=8)
    clip, dino = sample_features(maps, sorted(maps), config, generator=torch.Generator().manual_seed(0))
    losses = []
    for iterations in range(6):
        book = Codebook(
            *spherical_kmeans(
                clip, dino, 8, 0.5, iterations=iterations, generator=torch.Generator().manual_seed(0)
            )
        )
        losses.append(1.5 - float(book.similarity(clip, dino).max(-1).values.mean()))  # Eq. 5
    assert losses[0] > losses[-1]
    assert all(later <= earlier + 1e-6 for earlier, later in itertools.pairwise(losses))


@pytest.mark.parametrize("noise", [1.0, 0.1])
def test_kmeans_seeds_are_those_of_a_comparison_with_every_feature(noise):
    """Greedy k-means++ of the same draws in float64; clustered features are compared with few seeds."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(40, 16))[rng.integers(0, 40, 3000)] + noise * rng.normal(size=(3000, 16))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    found = _kmeans_seeds(torch.from_numpy(features).float(), 64, torch.Generator().manual_seed(5)).tolist()
    generator = torch.Generator().manual_seed(5)
    expected = [int(torch.randint(3000, (1,), generator=generator))]
    nearest = ((features - features[expected[0]]) ** 2).sum(1)
    while len(expected) < 64:
        draws = (
            torch.rand(2 + int(np.log(64)), generator=generator, dtype=torch.float64).numpy() * nearest.sum()
        )
        drawn = np.searchsorted(np.cumsum(nearest), draws, side="right")
        lowered = [np.minimum(nearest, ((features - features[place]) ** 2).sum(1)) for place in drawn]
        best = int(np.argmin([values.sum() for values in lowered]))
        expected.append(int(drawn[best]))
        nearest = lowered[best]
    assert found == expected


def test_kmeans_survives_fewer_features_than_codes() -> None:
    features = unit(torch.randn(3, 16, generator=torch.Generator().manual_seed(0)))
    clip, _ = spherical_kmeans(
        features, None, 10, 0.5, iterations=5, generator=torch.Generator().manual_seed(0)
    )
    book = Codebook(clip, None)
    assert mean_cosine(book, features, None) == pytest.approx(1, abs=1e-5)


@pytest.mark.slow
def test_held_out_views_take_no_part_in_the_fit() -> None:
    maps, _ = clustered_maps(4, views=4)
    log = ReadLog(maps)
    config = CodebookConfig(num_codes=6, steps=3)
    first = fit_codebook(log, ["v0", "v2"], config, seed=1)
    assert log.read == {"v0", "v2"}
    poisoned = maps | {"v1": Map(torch.full_like(maps["v1"].clip, torch.nan), maps["v1"].dino)}
    second = fit_codebook(poisoned, ["v0", "v2"], config, seed=1)
    torch.testing.assert_close(second.clip, first.clip, rtol=0, atol=0)


def test_the_fit_depends_on_the_seed_only() -> None:
    maps, _ = clustered_maps(5)
    config = CodebookConfig(num_codes=6, steps=5, batch_size=32)
    torch.manual_seed(1)
    first = fit_codebook(maps, ["v0", "v1"], config, seed=3)
    torch.manual_seed(2)
    second = fit_codebook(maps, ["v0", "v1"], config, seed=3)
    assert torch.equal(first.clip, second.clip)
    assert torch.equal(first.dino, second.dino)


@pytest.mark.slow
def test_fit_and_assignment_are_bit_identical_on_any_number_of_threads() -> None:
    # Batches so large that torch would spread them over its threads.
    generator = torch.Generator().manual_seed(8)
    maps = {
        f"v{i}": Map(*(torch.randn(40, 50, width, generator=generator) for width in (96, 64))) for i in "ab"
    }
    config = CodebookConfig(num_codes=32, steps=8, kmeans_iterations=3, batch_size=2048)
    found = []
    for threads in (1, 2, 3, 2):
        torch.set_num_threads(threads)
        book = fit_codebook(maps, sorted(maps), config, seed=0)
        assert torch.get_num_threads() == threads, "the setting is put back"
        found.append([book.clip, book.dino, *map(torch.from_numpy, assign_code_maps(maps, book).values())])
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other))


def test_the_sample_is_bounded_and_spread_over_the_views() -> None:
    maps = {f"v{i}": Map(unit(torch.eye(4)[i].expand(5, 5, 4))) for i in range(4)}
    config = CodebookConfig(sample_size=22)
    clip, dino = sample_features(maps, sorted(maps), config, generator=torch.Generator().manual_seed(0))
    assert dino is None
    assert len(clip) == 22
    assert clip.sum(0).min() >= 4


def test_without_dino_the_codebook_has_no_dino_part() -> None:
    maps, _ = clustered_maps(6)
    book = fit_codebook(maps, ["v0"], CodebookConfig(num_codes=4, use_dino=False, steps=2))
    assert book.dino is None
    plain = {name: Map(value.clip) for name, value in maps.items()}
    np.testing.assert_array_equal(book.assign(maps["v1"]), book.assign(plain["v1"]))


@pytest.mark.slow
def test_load_balancing_uses_more_codes_than_its_ablation() -> None:
    # Small start and a rare group: without the loss most codes never win a feature.
    maps, _ = clustered_maps(7, groups=4)
    used = {}
    for on in (True, False):
        config = CodebookConfig(
            num_codes=16,
            init="uniform",
            steps=200,
            learning_rate=3e-3,
            load_balancing=on,
            lambda_lb=1.0,
            temperature=0.1,
        )
        book = fit_codebook(maps, sorted(maps), config, seed=0)
        used[on] = code_usage(assign_code_maps(maps, book).values(), 16).perplexity
    assert used[True] > used[False]


def test_code_usage_counts_cells_and_leaves_ignored_ones_out() -> None:
    usage = code_usage([np.array([[0, 0], [2, 255]], np.uint8), np.array([[2]], np.uint8)], 4)
    np.testing.assert_array_equal(usage.counts, [2, 0, 2, 0])
    assert usage.used == 2
    assert usage.perplexity == pytest.approx(2.0)


@pytest.mark.parametrize("count", [0, 257, 1000])
def test_more_codes_than_a_byte_holds_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match="1 to 256 because an index map holds one byte"):
        CodebookConfig(num_codes=count)


def test_256_codes_fit_in_a_byte() -> None:
    book = Codebook(unit(torch.randn(256, 300, generator=torch.Generator().manual_seed(0))))
    feature_map = Map(book.clip.reshape(16, 16, 300))
    np.testing.assert_array_equal(book.assign(feature_map).ravel(), np.arange(256))


@pytest.mark.parametrize("with_dino", [True, False])
def test_tensors_round_trip(with_dino: bool) -> None:
    book = Codebook(torch.randn(3, 4), torch.randn(3, 2) if with_dino else None, lambda_dino=0.3)
    again = Codebook.from_tensors(book.tensors())
    assert torch.equal(again.clip, book.clip)
    assert again.lambda_dino == book.lambda_dino
    assert (again.dino is None) == (not with_dino)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one training view"):
        fit_codebook({}, [], CodebookConfig())
    with pytest.raises(ValueError, match="features of v: NaN or infinity"):
        fit_codebook({"v": Map(torch.full((2, 2, 3), torch.nan))}, ["v"], CodebookConfig(num_codes=2))
    with pytest.raises(ValueError, match="NaN or infinity"):
        Codebook(torch.full((2, 3), torch.inf))
    with pytest.raises(ValueError, match="fitted with DINO"):
        Codebook(torch.ones(2, 3), torch.ones(2, 3)).assign(Map(torch.ones(1, 1, 3)))
    with pytest.raises(ValueError, match="lacks clip"):
        Codebook.from_tensors({"lambda_dino": torch.tensor(0.5)})
