"""The supports of things in a scene without cameras: the sides of the scene that they touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from lexsplat.pipeline.viewpoints.pieces import Pieces

_WITHIN = 0.04
"""Things are this far within the convex hull of a scene, relative to its diagonal."""
_MARGIN = 0.25
"""Points are of a side, not of a thing, within this part of that distance from the side."""
_LINK = 2.0
"""Points of one thing are this near to each other, relative to the usual distance of twelve neighbors."""
_OUTSIDE = 0.01
"""Share of the points beyond a side: noise. An open top has no more within a fifth of the walls."""
_NEAREST = 1.1
"""A thing that touches nothing, such as a table top whose legs are missing, stands on its nearest side."""
_TELLING = 0.25
"""Least share of the things that the others, which reach from side to side, leave: where they leave less, all shares
are low."""
_FEWEST_OF_A_THING = 20
_FACING = np.cos(np.radians(20))
"""Cosine of the largest angle between a direction and the side of the hull that is its lowest one."""

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]


def standing_shares(pieces: Pieces, directions: Points) -> Points:
    """Share of the things of a scene that stand on its lowest side, less that at its highest ``[D]``, in 0..1.

    Things stand on the floor of a room, and few touch the ceiling. Only some touch a wall, or what is between two
    walls touches both. A thing touches a side if it goes on until there; a shelf that ends before a wall is only
    near it. What reaches from a side to the opposite one may be a wall, or a shelf up to the ceiling, and stands on
    nothing.

    Args:
        pieces: Surfaces of the middle of the scene.
        directions: Up directions ``[D, 3]``, of unit length.
    """
    points, link = pieces.points, _LINK * float(np.median(pieces.reach))
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    deep = max(_WITHIN * float(np.linalg.norm(high - low)), link / 2)
    try:
        hull = ConvexHull(points).equations
    except (QhullError, ValueError):  # all in one plane
        return np.zeros(len(directions))
    over = points @ hull[:, :3].T  # [M, F], changed in place: fresh memory takes longer than the arithmetic
    over += hull[:, 3]
    near = over >= -deep
    inner = ~near.any(1)
    if inner.sum() < _FEWEST_OF_A_THING:
        return np.zeros(len(directions))
    pairs = cKDTree(points).query_pairs(link, output_type="ndarray").T
    linked = coo_array((np.ones(pairs.shape[1], bool), pairs), shape=(len(points), len(points))).tocsr()
    pairs = np.stack(linked.nonzero())  # sorted once, instead of in each graph
    things = _linked(pairs, inner)
    sizes = np.bincount(things[inner])
    ends, which = np.unique(np.concatenate([directions, -directions]) + 0.0, axis=0, return_inverse=True)
    others = (ends @ hull[:, :3].T > -_FACING).astype(np.float32)
    beside = near.astype(np.float32) @ others.T > 0  # of another side, for each end [M, E]
    touching, gaps = np.zeros((len(ends), len(sizes)), bool), np.full((len(ends), len(sizes)), np.inf)
    for end, other, touches, gap in zip(ends, beside.T, touching, gaps):
        heights = points @ end - np.quantile(points @ end, _OUTSIDE)
        members = inner | ((heights > _MARGIN * deep) & ~other)
        wholes = _linked(pairs, members)
        lowest = np.full(len(points), np.inf)
        np.minimum.at(lowest, wholes[members], heights[members])
        np.minimum.at(gap, things[inner], heights[inner])
        touches[things[inner & (lowest[wholes] < _MARGIN * deep + link / 4)]] = True
    nearest = (gaps < deep + link) & (gaps < _NEAREST * gaps.min(0))
    lows, highs = (touching | (nearest & ~touching.any(0)))[which.ravel()].reshape(2, len(directions), -1)
    alone = ~(lows & highs).any(0)
    counted = np.where(sizes >= _FEWEST_OF_A_THING, sizes, 0)
    telling = max(float((counted * alone).sum()), _TELLING * float(counted.sum()), 1.0)
    shares = (lows.astype(float) - highs) @ (counted * alone) / telling
    return np.asarray(np.maximum(shares, 0))


def _linked(pairs: NDArray[np.int32], members: Mask) -> NDArray[np.int64]:
    """Number of the thing that each member is part of ``[M]``, by sorted pairs of near points ``[2, P]``; 0 for
    others.
    """
    count, numbers = int(members.sum()), np.cumsum(members, dtype=np.int32) - np.int32(1)
    first, second = numbers[np.compress(members[pairs[0]] & members[pairs[1]], pairs, axis=1)]
    starts = np.searchsorted(first, np.arange(count + 1, dtype=np.int32)).astype(np.int32)
    graph = csr_array((np.ones(len(first)), second, starts), shape=(count, count))
    labels = np.zeros(len(members), np.int64)
    labels[members] = connected_components(graph, directed=False)[1]
    return labels
