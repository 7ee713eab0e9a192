"""Small clusters that are pieces of a larger one, such as the stand of a lamp below its shade.

Few long Gaussians show a thin piece, so that their centers are farther apart than those of the thing. A piece belongs
to the thing if its Gaussians reach those of the thing. Dimension letters: M Gaussians, S small clusters' Gaussians.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import covariances

_SMALLEST, _LARGEST = 0.05, 0.2
"""Opacity of a piece, relative to the largest cluster. What is smaller is a speck, what is larger may be a thing."""
_REACH = 1.5
"""Gaussians reach each other where they are at most this many of their standard deviations apart, that way."""
_NEAREST = 4

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def with_pieces(gaussians: Gaussians, labels: IntArray, opacities: FloatArray) -> IntArray:
    """Clusters, from those of `lexsplat.queries.touching`: pieces join the cluster that they reach.

    Args:
        gaussians: The M Gaussians.
        labels: The cluster of each ``[M]``, numbered from 0.
        opacities: Their opacities ``[M]``.

    Returns:
        The cluster of each ``[M]``, numbered from 0.
    """
    totals = np.bincount(labels, opacities)
    shares = totals / max(totals.max(initial=0.0), 1e-12)
    small = np.flatnonzero((shares >= _SMALLEST) & (shares < _LARGEST))
    if len(small) == 0:
        return labels
    things, joined = np.flatnonzero((shares >= _LARGEST)[labels]), np.arange(len(shares))
    for label in small:
        near, apart = _apart(gaussians, np.flatnonzero(labels == label), things)
        if apart.min() <= _REACH:
            joined[label] = labels[near.flat[apart.argmin()]]
    return np.unique(joined[labels], return_inverse=True)[1].astype(np.intp)


def _apart(gaussians: Gaussians, members: IntArray, others: IntArray) -> tuple[IntArray, FloatArray]:
    """The nearest of some Gaussians ``[S, 4]`` to each of the members, and how many deviations they are apart."""
    means = gaussians.means.detach().cpu().double().numpy()
    count = min(_NEAREST, len(others))
    near = others[cKDTree(means[others]).query(means[members], k=range(1, count + 1))[1]]
    way = means[near] - means[members][:, None]
    distances = np.linalg.norm(way, axis=2)
    way = way / np.maximum(distances, 1e-12)[..., None]
    own = np.broadcast_to(members[:, None], near.shape)
    reach = _deviations(gaussians, own, way) + _deviations(gaussians, near, way)
    return near, distances / np.maximum(reach, 1e-12)


def _deviations(gaussians: Gaussians, index: IntArray, way: FloatArray) -> FloatArray:
    """Standard deviations ``[S, 4]`` of Gaussians along unit directions ``[S, 4, 3]``."""
    chosen = torch.from_numpy(index.ravel()).to(gaussians.device)
    quats, scales = (each.detach()[chosen].cpu().double() for each in (gaussians.quats, gaussians.scales))
    shapes = covariances(quats, scales).numpy().reshape(*index.shape, 3, 3)
    return np.sqrt(np.maximum(np.einsum("...i,...ij,...j->...", way, shapes, way), 0.0))
