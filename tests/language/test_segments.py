import math

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lexsplat.codebook import Codebook
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField, field_from_tensors
from lexsplat.language.segment_kernels import join_linked
from lexsplat.language.segments import Segments, make_segments

SIDE = 24


def floor(colors=None) -> Gaussians:
    """Gaussians on a grid of SIDE x SIDE in the plane."""
    count = SIDE * SIDE
    place = torch.arange(count)
    means = torch.stack([place % SIDE, place // SIDE, torch.zeros(count)], 1).float()
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.zeros(count, 3),
        torch.zeros(count),
        torch.zeros(count, 1, 3) if colors is None else colors[:, None],
        torch.zeros(count, 0, 3),
    )


def quarters() -> tuple[torch.Tensor, torch.Tensor]:
    """Language of two halves and color of two halves, which together are four quarters; and noise."""
    gaussians = floor()
    right, top = gaussians.means[:, 0] >= SIDE / 2, gaussians.means[:, 1] >= SIDE / 2
    noise = 0.02 * torch.randn(SIDE * SIDE, 8, generator=torch.Generator().manual_seed(0))
    return torch.eye(8)[right.long()] + noise, torch.where(top[:, None], 1.0, -1.0) * torch.ones(1, 3)


def test_segments_end_where_language_or_color_changes():
    language, colors = quarters()
    gaussians = floor(colors)
    events = []
    found = make_segments(gaussians, lambda rows: language[rows], torch.ones(len(gaussians)), events.append)
    shares = [event.done / event.total for event in events]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    quarter = 2 * (gaussians.means[:, 0] >= SIDE / 2) + (gaussians.means[:, 1] >= SIDE / 2)
    for level in found.levels:
        for segment in range(int(level.max()) + 1):
            assert len(quarter[level[found.labels] == segment].unique()) == 1


def test_each_level_has_half_the_segments_and_joins_those_below():
    language = torch.randn(SIDE * SIDE, 8, generator=torch.Generator().manual_seed(1))
    found = make_segments(floor(), lambda rows: language[rows], torch.ones(SIDE * SIDE))
    counts = [int(level.max()) + 1 for level in found.levels]
    assert counts == [counts[0] >> step for step in range(len(counts))]
    for below, above in zip(found.levels, found.levels[1:]):
        assert len(torch.unique(torch.stack([below, above]), dim=1)[0]) == int(below.max()) + 1
    assert torch.bincount(found.labels).min() >= 8


def test_threads_and_rows_at_a_time_do_not_change_segments():
    language, colors = quarters()
    gaussians, masses = floor(colors), torch.rand(SIDE * SIDE, generator=torch.Generator().manual_seed(2))
    first = make_segments(gaussians, lambda rows: language[rows], masses)
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 2)
    try:
        second = make_segments(gaussians, lambda rows: language[rows].clone(), masses)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(first.labels, second.labels)
    assert torch.equal(first.levels, second.levels)


@pytest.mark.parametrize(("tolerance", "limit"), [(0.0, 0.0), (math.inf, math.inf)])
def test_extreme_tolerances_give_connected_components(tolerance, limit):
    generator = np.random.default_rng(0)
    first, second = generator.integers(0, 60, (2, 70))
    lengths = generator.integers(0, 3, 70).astype(float)
    found = join_linked(first, second, lengths, np.argsort(lengths, kind="stable"), tolerance, 1, 60)
    kept = lengths <= limit
    edges = coo_array((np.ones(kept.sum()), (first[kept], second[kept])), shape=(60, 60))
    count, labels = connected_components(edges, directed=False)
    assert len(np.unique(found)) == count == len(np.unique(np.stack([found, labels]), axis=1)[0])


def test_a_long_link_joins_only_small_sets():
    # Two chains of short links and a long link between them: 3 elements accept k / 3 more than their longest link.
    first, second = np.array([0, 1, 3, 4, 2]), np.array([1, 2, 4, 5, 3])
    lengths = np.array([1.0, 1.0, 1.0, 1.0, 2.0])
    for tolerance, segments in ((2.9, 2), (3.1, 1)):
        found = join_linked(first, second, lengths, np.arange(5), tolerance, 1, 6)
        assert len(np.unique(found)) == segments


@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_few_gaussians_have_segments(count):
    gaussians = floor().select(torch.arange(count))
    found = make_segments(gaussians, lambda rows: torch.zeros(count, 4)[rows], torch.zeros(count))
    assert len(found.labels) == count
    assert found.levels.shape[0] >= 1


def field(count: int, segments: Segments | None) -> CodeField:
    codes, weights = torch.zeros(count, 1, dtype=torch.uint8), torch.ones(count, 1)
    return CodeField(Codebook(torch.eye(3)), codes, weights, torch.zeros(count), segments=segments)


def test_segments_are_stored_with_the_language_in_less_than_4_bytes_a_gaussian():
    count, lowest = 8000, 300
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, lowest, (count,), generator=generator)
    levels = torch.stack([torch.arange(lowest) >> level for level in range(4)])
    hidden = torch.rand(count, generator=generator) < 0.1
    added = hidden & (torch.rand(count, generator=generator) < 0.5)
    segments = Segments(labels, torch.rand(count, generator=generator).half().float(), levels, hidden, added)
    tensors = {
        name: tensor
        for name, tensor in field(count, segments).tensors().items()
        if name.startswith("segments.")
    }
    assert sum(tensor.nbytes for tensor in tensors.values()) < 4 * count
    opened = field_from_tensors(field(count, segments).tensors()).segments
    assert opened is not None
    for name in ("labels", "masses", "levels", "hidden", "added"):
        assert torch.equal(getattr(opened, name), getattr(segments, name)), name
    assert field_from_tensors(field(4, None).tensors()).segments is None


@pytest.mark.parametrize("count", [1, 7, 8, 9])
def test_segments_of_any_number_of_gaussians_are_read_as_they_were(count):
    labels = torch.arange(count) % 3
    levels = torch.tensor([[2, 0, 1], [1, 1, 0], [0, 0, 0]])  # numbers need no order
    segments = Segments(labels, torch.ones(count), levels)
    opened = Segments.from_tensors(segments.tensors())
    assert opened is not None
    assert torch.equal(opened.labels, labels)
    assert torch.equal(opened.levels, levels)
    assert (opened.hidden, opened.added) == (None, None)


def earlier(**changed) -> dict[str, torch.Tensor]:
    """Segments as earlier versions stored them."""
    found = {
        "labels": torch.tensor([0, 2, 1, 2], dtype=torch.uint16),
        "masses": torch.ones(4).half(),
        "levels": torch.tensor([[0, 1, 2], [0, 0, 1]], dtype=torch.int32),
    }
    found = {name: value for name, value in (found | changed).items() if value is not None}
    return {f"segments.{name}": value for name, value in found.items()}


def test_segments_of_earlier_versions_are_read():
    opened = Segments.from_tensors(earlier(hidden=torch.tensor([0, 1, 2, 0], dtype=torch.uint8)))
    assert opened is not None
    assert opened.labels.tolist() == [0, 2, 1, 2]
    assert opened.levels.tolist() == [[0, 1, 2], [0, 0, 1]]
    assert opened.hidden.tolist() == [False, True, True, False]
    assert opened.added.tolist() == [False, False, True, False]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"labels": torch.tensor([0, 3, 1, 2])}, "labels must be in 0..2"),
        ({"labels": torch.tensor([0, 1])}, r"labels \[N\]"),
        ({"labels": torch.tensor([0.2, 2, 1, 2])}, "labels must be integers, got torch.float32"),
        ({"masses": torch.tensor([0.5, -1, 2, 9])}, "masses must not be negative"),
        ({"masses": torch.zeros(4)}, "some of them positive"),
        ({"masses": torch.tensor([1, math.nan, 1, 1])}, "masses must be finite"),
        ({"masses": torch.ones(4, dtype=torch.int64)}, "masses must be floats"),
        ({"levels": torch.tensor([[0, 1, 7]])}, "levels must be in 0..2"),
        ({"levels": torch.tensor([[0, 1, 7], [0, 0, 0]])}, "levels must be in 0..2"),
        ({"levels": torch.tensor([[0.0, 1, 2]])}, "levels must be integers"),
        ({"levels": torch.tensor([[0, 0, 1], [0, 1, 2]])}, "levels must be nested"),
        ({"levels": torch.zeros(0, 3, dtype=torch.int64)}, "need a level"),
        ({"levels": None}, "segments lack levels"),
    ],
)
def test_segments_of_earlier_versions_that_do_not_fit_are_refused(changed, told):
    with pytest.raises(ValueError, match=told):
        Segments.from_tensors(earlier(**changed))


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("label_bits", torch.full((2, 1), 255, dtype=torch.uint8), "labels must be in 0..2"),
        ("label_bits", torch.zeros(2, 2, dtype=torch.uint8), "bits of 4 Gaussians expected"),
        ("label_bits", torch.zeros(2, 1, dtype=torch.int64), "bits of 4 Gaussians expected"),
        ("label_bits", None, "segments lack label_bits"),
        ("label_bits", torch.tensor(0, dtype=torch.uint8), "label_bits .* expected"),
        ("masses", torch.tensor(1.0), "masses .* expected"),
        ("masses", torch.zeros(4), "some of them positive"),
        ("masses", torch.ones(9), "bits of 9 Gaussians expected"),
        ("parents", torch.tensor([0, 1, 2, 0, 0, 7]), "parents must be in 0..1"),
        ("parents", torch.tensor([0, 1, 2, 0, 0]), "parents of .* segments expected"),
        ("parents", torch.zeros(6), "parents must be integers"),
        ("counts", torch.tensor([3, -3, 6]), "parents of .* segments expected"),
        ("counts", torch.tensor([[3, 3, 2]]), "parents of .* segments expected"),
        ("counts", torch.tensor([6]), "parents of .* segments expected"),
        ("hidden_bits", torch.zeros(4, dtype=torch.uint8), "bits of 4 Gaussians expected"),
    ],
)
def test_stored_segments_that_do_not_fit_are_refused(name, value, told):
    levels = torch.tensor([[0, 1, 2], [0, 0, 1]])
    segments = Segments(torch.tensor([0, 2, 1, 2]), torch.ones(4), levels)
    tensors = field(4, segments).tensors() | {f"segments.{name}": value}
    with pytest.raises(ValueError, match=told):
        field_from_tensors({key: tensor for key, tensor in tensors.items() if tensor is not None})
