"""The small pieces of surface that solid points are centers of: their normals, and how far they reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_NEIGHBORS = 12

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Pieces:
    """Pieces of surface around solid points.

    Args:
        points: Their centers ``[M, 3]``, world.
        normals: Unit normals ``[M, 3]``, either way.
        flatness: Flatness of each piece ``[M]``, in 0..1.
        reach: Distance to the twelfth of the nearest points, of which each is its own first ``[M]``, world units.
    """

    points: Points
    normals: Points
    flatness: Points
    reach: Points

    @classmethod
    def of(cls, points: Points) -> Pieces:
        """The pieces around points ``[M, 3]``, of which there are at least twelve."""
        distances, neighbors = cKDTree(points).query(points, k=_NEIGHBORS)
        normals, flatness = _normals(points[neighbors])
        return cls(points, normals, flatness, distances[:, -1])


def _normals(neighborhoods: NDArray) -> tuple[Points, Points]:
    """Unit normals ``[M, 3]`` of neighborhoods ``[M, k, 3]``, and how flat they are ``[M]`` in 0..1."""
    offsets = neighborhoods - neighborhoods.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))
    return vectors[:, :, 0], 1 - np.clip(values[:, 0] / np.maximum(values[:, 1], 1e-12), 0, 1)
