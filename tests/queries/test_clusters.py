"""Clusters against plain loops over all pairs."""

import numpy as np
import pytest

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
