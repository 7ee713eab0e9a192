"""Connected clusters of points: the instances of a selection.

A point is linked to those of its `_NEIGHBORS` nearest that are closer than `LINK` spacings. Faint points join the
cluster of the nearest firm one but link nothing. Dimension letters: M points, C clusters, K neighbors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lexsplat.runtime.device import kernel_threads

_NEIGHBORS = 8
_SEARCHED = _NEIGHBORS + 2
"""Neighbors that are looked up at once: most of them are firm, so that one search serves spacing and links."""
_SIXTH = 6
_SAMPLE = 4096
_MANY = 8192
"""Points from which several threads search."""
LINK = 2.5
"""Largest distance between linked points, in median distances to the sixth neighbor."""

FloatArray = NDArray[np.float64]


def spacing(points: FloatArray) -> float:
    """Median distance from a point to its sixth neighbor, of points ``[M, 3]``, M > 1."""
    sample = points[:: max(1, len(points) // _SAMPLE)]
    return float(np.median(_tree(points).query(sample, k=min(_SIXTH + 1, len(points)))[0][:, -1]))


def clusters(
    points: FloatArray, firm: NDArray[np.bool_], counted: NDArray[np.bool_] | None = None
) -> NDArray[np.intp]:
    """The cluster of each point ``[M]``, numbered from 0.

    Args:
        points: ``[M, 3]``.
        firm: Which of them link others ``[M]``; all do if none is firm.
        counted: Which of them tell the usual spacing ``[M]``; None takes all.
    """
    count = len(points)
    if count < 2:
        return np.zeros(count, np.intp)
    firm = firm if firm.any() else np.ones(count, bool)
    threads = kernel_threads() if count >= _MANY else 1
    searched = min(_SEARCHED, count)
    apart, found = _tree(points).query(points, k=searched, workers=threads)
    spacings = apart[:, min(_SIXTH + 1, count) - 1]
    if counted is not None and counted.any():
        spacings = spacings[counted]
    link = LINK * float(np.median(spacings[:: max(1, len(spacings) // _SAMPLE)]))
    is_firm = firm[found]
    order = np.cumsum(is_firm, axis=1)
    linked = is_firm & (apart < link) & (order <= _NEIGHBORS + 1)  # each is its own nearest
    # Where too few neighbors are firm, only firm ones are searched.
    short = np.flatnonzero(
        (order[:, -1] <= _NEIGHBORS * firm) & (apart[:, -1] < np.where(firm, link, np.inf))
    )
    if len(short) and searched < count:
        others = np.flatnonzero(firm)
        wide = min(_NEIGHBORS + 1, len(others))
        apart, nearest = _tree(points[others]).query(points[short], k=range(1, wide + 1), workers=threads)
        found[short, :wide], linked[short] = others[nearest], False
        linked[short, :wide] = apart < link
        is_firm[short, :wide] = True
    faint = np.flatnonzero(~firm)
    nearest_firm = found[faint, is_firm[faint].argmax(1)]
    linked[faint] = False
    starts = np.concatenate([[0], np.cumsum(linked.sum(1))]).astype(np.int32)
    ends = found[linked].astype(np.int32)
    graph = csr_array((np.ones(len(ends)), ends, starts), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    labels[faint] = labels[nearest_firm]
    return np.unique(labels, return_inverse=True)[1]


def _tree(points: FloatArray) -> cKDTree:
    return cKDTree(points, balanced_tree=False, compact_nodes=False)
