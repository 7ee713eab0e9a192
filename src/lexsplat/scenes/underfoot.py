"""Segments of a thing that are the surface that it stands on.

The table within a ring, and a strip of cloth beside it, look like the ring to the encoder, whose crops show both.
They lie as deep as the table around, and have its colors, or the table's name describes them clearly better than the
ring's. They go back to it: a recolored ring leaves its wood alone.

Dimension letters: N Gaussians of the scene, M of the thing, S of the surface near it, K neighbors.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.colors import cielab
from lexsplat.queries.selection import FAINT, Selection
from lexsplat.scenes.formats.tables import colors_of

_NEIGHBORS = 64
_RANK = 5
"""Of the neighbors' colors, the one of this rank counts, from 0: a few strays are of any color."""
_FEWEST = 16
"""Fewest Gaussians that rise from the surface; a thing with fewer is a sheet that lies on it."""
_REACH = 2.5
"""Radii of a thing around its center in which the surface is looked at; up and down it is one."""
_ROWS = 8192
"""Gaussians whose neighbors' colors are in memory at once."""
_LEVEL = 0.9
"""Share of the surface's own Gaussians that are no farther from the height around them than is level."""
_UNLIKE = 25.0
"""Difference of colors in CIELAB above which a segment is not of the surface, even if the thing is no nearer."""
_MOST = 0.6
"""Share of a segment, by opacity, that must be level and of the surface's colors.

All are chosen on the second bundled scene, where a pale saucer on wood stays with its candle."""

FloatArray = NDArray[np.float64]


class Ground:
    """Visible Gaussians of a scene by where they are from above: those near a thing are found in little time.

    Args:
        gaussians: The N Gaussians of the scene.
        shown: Which of them may show a surface ``[N]`` bool.
        up: World direction ``[3]``.
    """

    def __init__(self, gaussians: Gaussians, shown: torch.Tensor, up: FloatArray) -> None:
        self.indices = (shown & (gaussians.opacities.detach() >= FAINT)).nonzero()[:, 0]
        means = gaussians.means.detach()[self.indices].cpu().double().numpy()
        self._across, self._heights = _upright(means, up)
        self._tree = cKDTree(self._across, balanced_tree=False, compact_nodes=False)

    def around(self, thing: Selection) -> torch.Tensor:
        """Indices of the Gaussians at the foot of a thing ``[S]``, ascending; none at a thing of few Gaussians."""
        if len(thing) <= _FEWEST or not len(self.indices):
            return self.indices[:0]
        across, heights = _upright(thing.points[0], thing.up.direction)
        middle, radius = across.mean(0), float(np.ptp(across, axis=0).max()) / 2
        reach = _REACH * radius
        near = np.sort(np.asarray(self._tree.query_ball_point(middle, reach, p=np.inf), np.intp))
        beside = np.abs(self._across[near] - middle).max(1, initial=0.0) < reach
        level = np.abs(self._heights[near] - np.quantile(heights, 0.02)) < radius
        return self.indices[torch.from_numpy(near[beside & level]).to(self.indices.device)]


def underfoot(
    thing: Selection, surface: torch.Tensor, labels: torch.Tensor, described: NDArray[np.bool_]
) -> torch.Tensor:
    """The Gaussians of a thing whose segments are the surface around it.

    Args:
        thing: The thing.
        surface: Indices of Gaussians at its foot (`Ground.around`) that are of surfaces that carry things ``[S]``.
        labels: The lowest segment of each Gaussian ``[N]``.
        described: Which lowest segments a surface's name describes clearly better than the thing's ``[S]``.

    Returns:
        Their indices ``[B]``.
    """
    nothing = thing.indices[:0]
    if len(surface) < _NEIGHBORS or len(thing) <= _FEWEST:
        return nothing
    across, heights = _upright(thing.points[0], thing.up.direction)
    means = thing.gaussians.means.detach()[surface].cpu().double().numpy()
    level, floor = _upright(means, thing.up.direction)
    around = cKDTree(level)
    beside = around.query(across, k=_NEIGHBORS)[1]
    raised = heights - np.median(floor[beside], 1)
    rough = np.abs(floor - np.median(floor[around.query(level, k=_NEIGHBORS)[1]], 1))
    thick = float(np.quantile(rough, _LEVEL))
    body = np.flatnonzero(raised > 2 * thick)
    if len(body) < _FEWEST:
        return nothing
    own, theirs = (_cielab(thing, index) for index in (thing.indices, surface))
    points = thing.points[0]
    nearest = body[cKDTree(points[body]).query(points, k=min(_NEIGHBORS, len(body)))[1]]
    unlike_surface, unlike_thing = _difference(own, theirs, beside), _difference(own, own, nearest)
    alike = unlike_surface < np.minimum(unlike_thing, _UNLIKE)
    level_too = np.abs(raised) <= thick
    segments, weights = labels[thing.indices].cpu().numpy(), thing.points[1]
    totals = np.bincount(segments, weights)
    found = np.bincount(segments, weights * level_too) >= _MOST * totals
    found &= (np.bincount(segments, weights * alike) >= _MOST * totals) | described[: len(totals)]
    return thing.indices[torch.from_numpy(found[segments]).to(thing.indices.device)]


def _upright(points: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points ``[M, 3]`` from above ``[M, 2]``, and their heights ``[M]``."""
    across = np.linalg.svd(np.eye(3) - np.outer(up, up))[0][:, :2]
    return points @ across, points @ up


def _cielab(thing: Selection, index: torch.Tensor) -> FloatArray:
    return cielab(colors_of(thing.gaussians.select(index)).astype(np.float64) / 255)


def _difference(colors: FloatArray, others: FloatArray, near: NDArray[np.intp]) -> FloatArray:
    """The difference of each color ``[M, 3]`` from the one of rank `_RANK` among its neighbors.

    Args:
        colors: CIELAB ``[M, 3]``.
        others: Those of which some are neighbors ``[S, 3]``.
        near: The neighbors of each ``[M, K]``.
    """
    found, rank = np.empty(len(colors)), min(_RANK, near.shape[1] - 1)
    for start in range(0, len(colors), _ROWS):
        rows = slice(start, start + _ROWS)
        apart = np.linalg.norm(others[near[rows]] - colors[rows, None], axis=2)
        found[rows] = np.partition(apart, rank, axis=1)[:, rank]
    return found
