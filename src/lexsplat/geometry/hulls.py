"""Convex hulls of things."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError

GROWN = 1.05
"""Factor by which the hull of a thing is enlarged where what hides in it belongs to it."""


def inside_hull(
    points: NDArray[np.float64], places: NDArray[np.float64], grown: float = 1.0
) -> NDArray[np.bool_]:
    """Which places ``[M, 3]`` lie in the convex hull of points ``[K, 3]``, enlarged about its center ``[M]``."""
    if len(points) <= points.shape[1]:
        return np.zeros(places.shape[:-1], bool)
    try:
        corners = points[ConvexHull(points).vertices]
        center = corners.mean(0)
        return np.asarray(Delaunay(center + grown * (corners - center)).find_simplex(places) >= 0)
    except (QhullError, ValueError, IndexError):  # flat
        return np.zeros(places.shape[:-1], bool)
