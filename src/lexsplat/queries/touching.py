"""Things of one kind that stand side by side and touch: divides a cluster into single things.

The pieces are found by k-means in the horizontal plane, because things stand beside each other and parts lie above
each other as well. They are things if

- they resemble each other: their convex hulls and their heights have similar sizes, and none is flat;
- there is a neck between any two: the cluster is narrower there than both, seen from above and in its cross-section;
- each of them is clearly more convex than all together, as in locally convex connected patches (Stein et al. 2014).

A thing with parts fails at one of them: a handle is smaller than its mug, a head lies above its body, the halves of a
table have no neck seen from above, and a ring has a hole. Two boxes whose faces meet have no
neck either, so they stay one thing. A dumbbell becomes two. Dimension letters: M points, K pieces.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from lexsplat.geometry.boxes import upright_frame

_MOST = 6
_FEWEST = 128
"""Points of a piece, at least: the shape of fewer is not known."""
_SAMPLE = 600
_ROUNDS = 4
_STRAYS = 0.03
"""Share of the points of a piece that are left out of its hull: those farthest from its middle."""
_END = 0.05
"""Share of the points that lie beyond each end of a width or height."""
_HOLE, _IN_HOLE = 0.42, 0.02
"""Pieces are those of a ring if they surround a hole of this radius, relative to their distance from its middle; this
share of the points may lie in it."""
_PLACES = np.linspace(0.3, 0.7, 7)
"""Where a neck may be, on the way between the centers of two pieces."""
_SLICE = 0.085
"""Half of the thickness of a slice there."""
_NARROW, _THIN = 0.75, 0.55
"""Largest width of a neck, and largest product of its width and height, relative to the smaller piece."""
_SIZES, _HEIGHTS = 1.7, 1.5
"""Largest ratio of the volumes of the hulls of two pieces, and of their heights."""
_SPREADS = 0.25
"""Smallest ratio of the least spread of a piece to its greatest."""
_CONVEX = 1.3
"""Points lie this many times as deep below the hull of all pieces as below that of any piece, at least."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def divided(points: FloatArray, firm: NDArray[np.bool_], labels: IntArray, up: FloatArray) -> IntArray:
    """Clusters of things, from connected clusters: those of things that touch are divided.

    Args:
        points: ``[M, 3]``, world units.
        firm: Which of them show the shape of a thing ``[M]``.
        labels: The connected cluster of each point ``[M]``, numbered from 0.
        up: World direction ``[3]``.

    Returns:
        The cluster of each point ``[M]``, numbered from 0; the first piece keeps the number of its cluster.
    """
    order, ends = np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))
    known, number = labels, len(ends)
    for label in np.flatnonzero(np.bincount(known[firm]) >= 2 * _FEWEST):
        members = order[ends[label - 1] if label else 0 : ends[label]]
        found = _pieces(points[members] @ np.stack(upright_frame(up)).T, firm[members])
        if found.any():
            labels = labels.copy() if labels is known else labels
            labels[members[found > 0]] = number - 1 + found[found > 0]
            number += int(found.max())
    return labels


def _pieces(points: FloatArray, firm: NDArray[np.bool_]) -> IntArray:
    """The thing that each point ``[M, 3]`` of a cluster belongs to ``[M]``: 0 for all if it is one; z is up."""
    seen = points[firm]
    sample = seen[:: -(-len(seen) // _SAMPLE)]
    most = min(_MOST, len(seen) // _FEWEST)
    starts = _far_apart(sample[:, :2], most)
    for count in range(most, 1, -1):
        centers, labels = _side_by_side(sample[:, :2], starts[:count])
        parts = [sample[labels == piece] for piece in range(count)]
        if min(map(len, parts)) * len(seen) < _FEWEST * len(sample) or _is_ring(sample[:, :2], centers):
            continue
        pairs = combinations(zip(parts, centers), 2)
        if all(_is_neck(one, other) for one, other in pairs) and _are_things(parts):
            return _nearest(points[:, :2], centers)
    return np.zeros(len(points), np.intp)


def _far_apart(plan: FloatArray, count: int) -> FloatArray:
    """Points ``[K, 2]``, each the farthest from those before it."""
    distances = ((plan - plan.mean(0)) ** 2).sum(1)
    centers = plan[distances.argmax()][None]
    distances = np.full(len(plan), np.inf)
    while len(centers) < count:
        distances = np.minimum(distances, ((plan - centers[-1]) ** 2).sum(1))
        centers = np.concatenate([centers, plan[distances.argmax()][None]])
    return centers


def _side_by_side(plan: FloatArray, centers: FloatArray) -> tuple[FloatArray, IntArray]:
    """Centers ``[K, 2]`` and labels ``[M]`` of pieces, by k-means from some centers."""
    count = len(centers)
    for _ in range(_ROUNDS):
        labels = _nearest(plan, centers)
        sizes = np.maximum(np.bincount(labels, minlength=count), 1)
        centers = (labels == np.arange(count)[:, None]) @ plan / sizes[:, None]
    return centers, _nearest(plan, centers)


def _nearest(plan: FloatArray, centers: FloatArray) -> IntArray:
    """The nearest of centers ``[K, 2]`` for each point ``[M]``."""
    return (plan @ centers.T - (centers**2).sum(1) / 2).argmax(1)


def _is_ring(plan: FloatArray, centers: FloatArray) -> bool:
    """Whether pieces surround a hole, seen from above."""
    middle = centers.mean(0)
    out, hole = (np.linalg.norm(each - middle, axis=1) for each in (centers, plan))
    return bool(np.quantile(hole, _IN_HOLE) > _HOLE * out.mean())


def _is_neck(first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]) -> bool:
    """Whether two pieces, given with their centers, are thinner somewhere between the centers than at both."""
    (one, start), (other, end) = first, second
    way = end - start
    along, across = way / (way @ way), np.array([-way[1], way[0]])
    both = np.concatenate([one, other])
    place, side, height = (both[:, :2] - start) @ along, both[:, :2] @ across, both[:, 2]

    def slice_at(middle: float) -> tuple[float, float]:
        within = np.abs(place - middle) < _SLICE
        return _extent(side[within]), _extent(height[within])

    ends = slice_at(0.0), slice_at(1.0)
    width, tall = min(ends[0][0], ends[1][0]), min(ends[0][1], ends[1][1])
    narrow, low = min((slice_at(middle) for middle in _PLACES), key=lambda each: each[0] * each[1])
    return narrow <= _NARROW * width and narrow * low <= _THIN * width * tall


def _extent(values: FloatArray) -> float:
    """Length without the `_END` at either end; 0 of hardly any values."""
    if len(values) < 4:
        return 0.0
    ordered = np.sort(values)
    cut = round(_END * (len(values) - 1))
    return max(float(ordered[-1 - cut] - ordered[cut]), 1e-12)


def _are_things(parts: list[FloatArray]) -> bool:
    """Whether pieces resemble each other, and each is more convex than all of them together."""
    heights = [_extent(part[:, 2]) for part in parts]
    spreads = [np.linalg.eigvalsh(np.cov(part.T)) for part in parts]
    if max(heights) > _HEIGHTS * min(heights) or any(s[0] < _SPREADS**2 * s[2] for s in spreads):
        return False
    near = [_without_strays(part) for part in parts]
    try:
        hulls = [_hull(part) for part in near]
        depth, _ = _hull(np.concatenate(near))
    except QhullError:  # flat
        return False
    volumes = np.array([volume for _, volume in hulls])
    depths = np.array([depth for depth, _ in hulls]) / np.cbrt(volumes)
    return bool(
        volumes.max() <= _SIZES * volumes.min() and depth / np.cbrt(volumes.mean()) >= _CONVEX * depths.max()
    )


def _without_strays(part: FloatArray) -> FloatArray:
    apart = ((part - np.median(part, 0)) ** 2).sum(1)
    return part[apart <= np.quantile(apart, 1 - _STRAYS)]


def _hull(part: FloatArray) -> tuple[float, float]:
    """Mean depth of points below their convex hull, and its volume."""
    hull = ConvexHull(part)
    return float(-(hull.equations[:, :3] @ part.T + hull.equations[:, 3:]).max(0).mean()), float(hull.volume)
