"""Gaussians that float free of all surfaces: where they are many, a scene without a capture leaves them out.

Small floaters are far from everything. Large ones are as near to others as the large Gaussians of walls are. What
tells them apart is that surfaces are seen behind floaters, and nothing is seen behind walls.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.candidates import around
from lexsplat.pipeline.viewpoints.looking import SMALL, draw_depth, look_from_above
from lexsplat.pipeline.viewpoints.surroundings import find_surroundings
from lexsplat.runtime.errors import CaptureError

log = logging.getLogger("lexsplat")

_NEIGHBORS = 12
_SOLID = 0.3
"""Opacity of Gaussians that count as neighbors."""
_ISOLATED = 4.0
"""A floater is this many times farther from its neighbors than usual; a small one, also than its middle radius."""
_CERTAIN = 6.0
"""The same for floaters that are counted to decide whether there are many."""
_MANY = 0.04
"""Share of certain floaters above which they are left out: captures of things have 0.01 to 0.02."""
_VIEWS = 300
"""Number of views, at most, in which large floaters are looked for."""
_IN_FRONT = 0.8
"""A large floater is in front of surfaces in this share of the views that show it in front of or on one."""
_SAME_DEPTH = 0.05
"""Difference of depth, relative to depth, within which a Gaussian lies on a surface, if it is smaller than that."""


@torch.no_grad()
def find_floaters(
    gaussians: Gaussians, subject: Path, *, up: NDArray[np.float64] | None = None, seed: int = 0
) -> NDArray[np.int64]:
    """Indices of the Gaussians that float, with a warning, if there are many; else none.

    Floaters hide things in the views that are searched, and carry the language of what lies behind them. Edges of a
    scene and its background have a few Gaussians that look alone; they stay.

    Args:
        gaussians: The scene.
        subject: The file, for the warning.
        up: The up direction; None estimates it.
        seed: Seed of samples.
    """
    relative, own = isolation(gaussians)
    alone = np.minimum(relative, own)
    if float((alone > _CERTAIN).mean()) < _MANY:
        return np.zeros(0, np.int64)
    floating = alone > _ISOLATED
    suspects = np.flatnonzero((relative > _ISOLATED) & ~floating)
    solid = np.flatnonzero(relative <= _ISOLATED)
    with contextlib.suppress(CaptureError):  # no surfaces: the choice of views refuses such splats
        floating[suspects] = _before_surfaces(gaussians, suspects, solid, up, seed)
    log.warning(
        "%s: %d of %d Gaussians float free of all surfaces and are left out; --keep-floaters keeps them",
        subject,
        int(floating.sum()),
        len(gaussians),
    )
    return np.flatnonzero(floating)


def isolation(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How alone each Gaussian is: the mean distance of its 12 nearest solid neighbors.

    Returns:
        The distance in units of its median over the solid Gaussians ``[N]``, and of the Gaussian's own middle radius
        ``[N]``.
    """
    points = gaussians.means.detach().cpu().double().numpy()
    solid = (gaussians.opacities > _SOLID).cpu().numpy()
    if solid.sum() <= _NEIGHBORS:
        return np.zeros(len(points)), np.zeros(len(points))
    distances = cKDTree(points[solid]).query(points, k=_NEIGHBORS + 1)[0]
    # A solid Gaussian finds itself first.
    apart = np.where(solid, distances[:, 1:].mean(1), distances[:, :-1].mean(1))
    usual = float(np.median(apart[solid]))
    return apart / max(usual, 1e-300), apart / np.maximum(_middle_radii(gaussians), 1e-300)


def _middle_radii(gaussians: Gaussians) -> NDArray[np.float64]:
    return np.asarray(np.sort(gaussians.scales.detach().cpu().double().numpy(), axis=1)[:, 1])


def _before_surfaces(
    gaussians: Gaussians,
    suspects: NDArray[np.int64],
    solid: NDArray[np.int64],
    up: NDArray[np.float64] | None,
    seed: int,
) -> NDArray[np.bool_]:
    """Whether each suspect hangs in front of what the solid Gaussians show, in most views that tell.

    Raises:
        CaptureError: If the solid Gaussians form no surfaces.
    """
    rest = gaussians.select(torch.from_numpy(solid).to(gaussians.device))
    found = find_surroundings(rest, up, look_from_above(rest), Path(), seed, warn=False)
    cameras = [camera for camera, _ in around(found, SMALL)]
    if len(cameras) > _VIEWS:
        chosen = np.random.default_rng(seed).choice(len(cameras), _VIEWS, replace=False)
        cameras = [cameras[index] for index in np.sort(chosen)]
    points = gaussians.means.detach().cpu().double().numpy()[suspects]
    radii = _middle_radii(gaussians)[suspects]
    before, on = (np.zeros(len(suspects), np.int64) for _ in range(2))
    for camera in cameras:
        gaps, depths = _gaps(rest, camera, points)
        margin = np.maximum(radii, _SAME_DEPTH * depths)
        before += gaps > margin
        on += np.abs(gaps) <= margin
    return np.asarray((before > 0) & (before >= _IN_FRONT * (before + on)))


def _gaps(
    gaussians: Gaussians, camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the surface of a view lies behind each point ``[M]``, and the depths of the points ``[M]``.

    NaN stands for points outside of the view and for pixels that are not opaque.
    """
    surface, _, alpha = draw_depth(gaussians, camera)
    rotated = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depths = rotated[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = rotated @ camera.K.T / depths[:, None]
    within = (
        (depths > 0) & (pixels[:, :2] >= 0).all(1) & (pixels[:, :2] < (camera.width, camera.height)).all(1)
    )
    columns, rows = pixels[within, :2].astype(int).T
    gaps = np.full(len(points), np.nan)
    gaps[within] = np.where(alpha[rows, columns] > 0.8, surface[rows, columns], np.nan) - depths[within]
    return gaps, depths
