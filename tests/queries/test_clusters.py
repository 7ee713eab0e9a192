"""Clusters against plain loops over all pairs, and boxes against sorted quantiles."""

import numpy as np
import pytest

from lexsplat.geometry.boxes import _ends
from lexsplat.queries.clusters import LINK, clusters, spacing


def by_loops(points, firm):
    """The clusters of a few points: each links its eight nearest firm ones that are close enough."""
    firm = firm if firm.any() else np.ones(len(points), bool)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    link = LINK * np.median(np.sort(apart, 1)[:, min(6, len(points) - 1)])
    labels = np.arange(len(points))
    for one in np.flatnonzero(firm):
        others = [n for n in np.argsort(apart[one]) if firm[n] and n != one][:8]
        for other in others:
            if apart[one, other] < link:
                labels[labels == labels[other]] = labels[one]
    for one in np.flatnonzero(~firm):
        labels[one] = labels[min(np.flatnonzero(firm), key=lambda n: apart[one, n])]
    return np.unique(labels, return_inverse=True)[1]


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9, 1.0])
@pytest.mark.parametrize("count", [2, 5, 40, 200])
def test_clusters_are_those_of_a_search_of_all_pairs(count, share):
    random = np.random.default_rng(count)
    points = random.normal(size=(count, 3)) + 12 * random.integers(0, 3, (count, 1))
    firm = random.random(count) >= share
    found, expected = clusters(points, firm), by_loops(points, firm)
    pairs = {(one, other) for one, other in zip(found.tolist(), expected.tolist())}
    assert len(pairs) == len(set(found.tolist())) == len(set(expected.tolist()))


def test_spacing_is_the_median_distance_to_the_sixth_neighbor():
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], 1)
    assert spacing(line) == 3.0
    assert spacing(line[:2]) == 1.0


@pytest.mark.parametrize("trim", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("count", [1, 7, 300, 5000])
def test_the_ends_of_a_box_are_weighted_quantiles(count, trim):
    random = np.random.default_rng(count)
    values = random.normal(size=(count, 3))
    weights = random.random(count) * np.exp(-3 * np.abs(values[:, 0]))  # light tails
    low, high = _ends(values, weights, trim)
    for column in range(3):
        order = np.argsort(values[:, column])
        reached = np.cumsum(weights[order]) / weights.sum()
        expected = [values[order[np.argmax(reached >= limit)], column] for limit in (trim, 1 - trim)]
        assert [low[column], high[column]] == pytest.approx(expected)
