"""Gaussians that float free of all surfaces: where they are many, a scene without a capture leaves them out."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.scenes.formats.reading import read_splats

log = logging.getLogger("lexsplat")

_NEIGHBORS = 12
_SOLID = 0.3
"""Opacity of Gaussians that count as neighbors."""
_ISOLATED = 4.0
"""A floater is this many times farther from its neighbors than usual, and than its own middle radius."""
_CERTAIN = 6.0
"""The same for floaters that are counted to decide whether there are many."""
_MANY = 0.04
"""Share of certain floaters above which they are left out: captures of things have 0.01 to 0.02."""


def read_without_floaters(splats: Path, *, keep: bool = False) -> Gaussians:
    """The Gaussians of a file without floaters, with a warning, if there are many; else all of them.

    Floaters hide things in the views that are searched, and carry the language of what lies behind them. Edges of a
    scene and its background have a few Gaussians that look alone; they stay.

    Args:
        splats: The file.
        keep: Keep floaters too.

    Raises:
        FileFormatError: If the file is missing or damaged.
    """
    gaussians = read_splats(splats)
    if keep:
        return gaussians
    alone = isolation(gaussians)
    if float((alone > _CERTAIN).mean()) < _MANY:
        return gaussians
    floating = alone > _ISOLATED
    log.warning(
        "%s: %d of %d Gaussians float free of all surfaces and are left out; --keep-floaters keeps them",
        splats,
        int(floating.sum()),
        len(gaussians),
    )
    return gaussians.select(torch.from_numpy(np.flatnonzero(~floating)).to(gaussians.device))


def isolation(gaussians: Gaussians) -> NDArray[np.float64]:
    """How alone each Gaussian is ``[N]``: its distance from its nearest solid neighbors.

    The mean distance of 12 neighbors, in units of its median over the solid Gaussians or of the Gaussian's own middle
    radius, whichever makes it less.
    """
    points = gaussians.means.detach().cpu().double().numpy()
    solid = (gaussians.opacities > _SOLID).cpu().numpy()
    if solid.sum() <= _NEIGHBORS:
        return np.zeros(len(points))
    distances = cKDTree(points[solid]).query(points, k=_NEIGHBORS + 1)[0]
    # A solid Gaussian finds itself first.
    apart = np.where(solid, distances[:, 1:].mean(1), distances[:, :-1].mean(1))
    radii = np.sort(gaussians.scales.detach().cpu().double().numpy(), axis=1)[:, 1]
    usual = float(np.median(apart[solid]))
    return np.minimum(apart / max(usual, 1e-300), apart / np.maximum(radii, 1e-300))
