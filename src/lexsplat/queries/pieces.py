"""Small clusters that are pieces of a larger one, such as the stand of a lamp below its shade.

Few long Gaussians show a thin piece or a plain face, so that their centers are farther apart than those of the rest.
A piece belongs to the thing if its Gaussians reach those of the thing. Dimension letters: M Gaussians, C small
clusters, S their Gaussians.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.hulls import inside_hull
from lexsplat.geometry.rotations import covariances

_SMALLEST, _LARGEST = 0.05, 0.2
"""Opacity of a piece, relative to the largest cluster. What is smaller is a speck, but in the plane of a surface and
within a thing; what is larger may be a thing."""
_REACH = 1.5
"""Gaussians reach each other where they are at most this many of their standard deviations apart, that way."""
_NEAREST = 4
_TAIL = 0.02
"""Share of the Gaussians of a surface on each side that do not tell how thick it is."""
_BESIDE = 1.5
"""Thicknesses of a surface within which its pieces lie: at most one above or below it."""
_ROUNDS = 4
"""How often pieces of a surface join those that joined before."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def with_pieces(
    gaussians: Gaussians, labels: IntArray, opacities: FloatArray, *, surface: bool = False
) -> IntArray:
    """Clusters, from those of `lexsplat.queries.touching`: pieces join the cluster that they reach.

    Args:
        gaussians: The M Gaussians.
        labels: The cluster of each ``[M]``, numbered from 0.
        opacities: Their opacities ``[M]``.
        surface: Whether they are those of a surface, such as a table. The things on it divide what can be seen of it:
            the smallest pieces count in its plane, and pieces may reach another piece. In other things the smallest
            count within the convex hull.

    Returns:
        The cluster of each ``[M]``, numbered from 0.
    """
    totals = np.bincount(labels, opacities)
    shares = totals / max(totals.max(initial=0.0), 1e-12)
    if len(totals) < 2:
        return labels
    things = shares >= _LARGEST
    things[totals.argmax()] = True
    large = shares >= _SMALLEST
    pieces = ~things
    if surface:
        pieces &= large | level_with(gaussians, labels, int(totals.argmax()), _BESIDE)
    joined = np.arange(len(shares))
    for _ in range(_ROUNDS if surface else 1):
        members = np.flatnonzero(pieces[labels])
        if len(members) == 0:
            break
        near, apart = _apart(gaussians, members, np.flatnonzero(things[labels]))
        order = np.argsort(apart, kind="stable")
        found, first = np.unique(labels[members[order]], return_index=True)
        others, reached = labels[near[order[first]]], apart[order[first]] <= _REACH
        if not surface:
            specks = reached & ~large[found]
            reached[specks] = _within(gaussians, labels, found[specks], others[specks])
        if not reached.any():
            break
        joined[found[reached]] = joined[others[reached]]
        things[found[reached]], pieces[found[reached]] = True, False
    return np.unique(joined[labels], return_inverse=True)[1].astype(np.intp)


def level_with(
    gaussians: Gaussians, labels: IntArray, largest: int, thicknesses: float = 0.5
) -> NDArray[np.bool_]:
    """Which clusters ``[C]`` lie in the plane of the largest one.

    Args:
        gaussians: The M Gaussians.
        labels: The cluster of each ``[M]``, numbered from 0.
        largest: The number of that cluster.
        thicknesses: How far from its middle their mean may be, in its thickness: 0.5 is within it.
    """
    means = gaussians.means.detach().cpu().double().numpy()
    members = np.flatnonzero(labels == largest)
    own = means[members]
    normal = np.linalg.eigh(np.cov(own.T))[1][:, 0] if len(own) > 1 else np.zeros(3)
    low, high = np.quantile(own @ normal, [_TAIL, 1 - _TAIL])
    spreads = _deviations(gaussians, members, np.broadcast_to(normal, own.shape))
    thick = max(high - low, float(np.median(spreads)))
    heights = np.bincount(labels, means @ normal) / np.bincount(labels)
    return np.asarray(np.abs(heights - (low + high) / 2) <= thicknesses * thick)


def _within(gaussians: Gaussians, labels: IntArray, specks: IntArray, others: IntArray) -> NDArray[np.bool_]:
    """Whether each of some clusters ``[C]`` lies, on average, in the convex hull of another one ``[C]``.

    So specks fill a face of a thing, but do not extend it.
    """
    means, found = gaussians.means.detach().cpu().double().numpy(), np.zeros(len(specks), bool)
    middles = np.stack([np.bincount(labels, axis) for axis in means.T], 1) / np.bincount(labels)[:, None]
    for other in np.unique(others):
        own = np.flatnonzero(others == other)
        found[own] = inside_hull(means[labels == other], middles[specks[own]])
    return found


def _apart(gaussians: Gaussians, members: IntArray, others: IntArray) -> tuple[IntArray, FloatArray]:
    """The one of some Gaussians that each of the members reaches best ``[S]``, and how many deviations away it is."""
    means = gaussians.means.detach().cpu().double().numpy()
    count = min(_NEAREST, len(others))
    tree = cKDTree(means[others], balanced_tree=False, compact_nodes=False)
    near = others[tree.query(means[members], k=range(1, count + 1))[1]]
    way = means[near] - means[members][:, None]
    distances = np.linalg.norm(way, axis=2)
    way = way / np.maximum(distances, 1e-12)[..., None]
    both = np.stack([np.broadcast_to(members[:, None], near.shape), near])
    reach = _deviations(gaussians, both, np.stack([way, way])).sum(0)
    apart = distances / np.maximum(reach, 1e-12)
    best = apart.argmin(1)[:, None]
    return np.take_along_axis(near, best, 1)[:, 0], np.take_along_axis(apart, best, 1)[:, 0]


def _deviations(gaussians: Gaussians, index: IntArray, way: FloatArray) -> FloatArray:
    """Standard deviations ``[...]`` of Gaussians ``[...]`` along unit directions ``[..., 3]``."""
    chosen = torch.from_numpy(index.ravel()).to(gaussians.device)
    quats, scales = (each.detach()[chosen].cpu().double() for each in (gaussians.quats, gaussians.scales))
    shapes = covariances(quats, scales).numpy().reshape(*index.shape, 3, 3)
    return np.sqrt(np.maximum(np.einsum("...i,...ij,...j->...", way, shapes, way), 0.0))
