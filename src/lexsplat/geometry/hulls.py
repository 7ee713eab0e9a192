"""Convex hulls of things."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

GROWN = 1.05
"""Factor by which the hull of a thing is enlarged where what hides in it belongs to it."""


_AT_ONCE = 512
"""Places that are tested at once: their distances from all half-spaces stay in the cache."""
_ROUNDING = 1e-12
"""Rounding that is allowed for, relative to the size of the hull."""


def inside_hull(
    points: NDArray[np.float64], places: NDArray[np.float64], grown: float = 1.0
) -> NDArray[np.bool_]:
    """Which places ``[..., D]`` lie in the convex hull of points ``[K, D]``, enlarged about its center ``[...]``.

    A hull is where all its half-spaces meet. To search a triangulation would take an inverse matrix for each simplex.
    """
    inside = np.zeros(places.shape[:-1], bool)
    if len(points) <= points.shape[1]:
        return inside
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):  # flat
        return inside
    corners = points[hull.vertices]
    center = corners.mean(0)
    shrunk = (center + (places - center) / grown).reshape(-1, points.shape[1])
    slack = _ROUNDING * float(np.ptp(corners, axis=0).max())
    low, high = corners.min(0) - slack, corners.max(0) + slack
    near = np.flatnonzero(((shrunk >= low) & (shrunk <= high)).all(1))
    for start in range(0, len(near), _AT_ONCE):
        some = near[start : start + _AT_ONCE]
        outwards = hull.equations @ np.concatenate([shrunk[some], np.ones((len(some), 1))], axis=1).T
        inside.ravel()[some] = outwards.max(0) <= slack
    return inside
