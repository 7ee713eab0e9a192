"""Gaussians that float free of all surfaces. If there are many, a scene without a capture leaves them out.

Small floaters are far from everything. Large ones are as near to others as the large Gaussians of walls are. They
differ in that surfaces are seen behind floaters, and nothing is seen behind walls. The largest engulf parts
of the scene, so surfaces lie before, on and behind them; what belongs to the scene and has details within its own
radius, such as a table top with a pattern, lies on surfaces everywhere.
"""

from __future__ import annotations

import contextlib
import logging
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import matrices_from_quaternions
from lexsplat.pipeline.viewpoints.candidates import around, some
from lexsplat.pipeline.viewpoints.looking import SMALL, draw_depth, look_from_above
from lexsplat.pipeline.viewpoints.surroundings import Surroundings, find_surroundings
from lexsplat.pipeline.viewpoints.upward import UpwardDirections
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.progress import Event, Listener, silent

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
_ENGULFING = 0.8
"""Gaussians are looked at, too, if neighbors are nearer than this many of their middle radii: 1 % of a scene."""
_VIEWS = 100
"""Number of views, at most, in which large floaters are looked for."""
_ROUNDS = 3
"""Number of searches, at most. Each leaves out the floaters found before, because they hide others."""
_PARTS = 4
"""Suspects are looked for in as many parts, each before the other ones: a wall is made of suspects."""
_IN_FRONT = 0.5
"""A large floater lies in front of a surface in this share of the places where it lies in front of or on one."""
_PIERCED = 0.2
"""The same share for a floater that engulfs others: surfaces pierce it."""
_LEAST = 2
"""Least number of points, over all views, at which a floater is in front of a surface."""
_SAME_DEPTH = (0.05, 0.2)
"""A point lies on a surface within its Gaussian's middle radius, at least and at most these parts of its depth."""


@torch.no_grad()
def find_floaters(
    gaussians: Gaussians,
    subject: Path,
    *,
    up: NDArray[np.float64] | None = None,
    seed: int = 0,
    listener: Listener = silent,
) -> NDArray[np.int64]:
    """Indices of the Gaussians that float, with a warning, if there are many; else none.

    Floaters hide things in the views that are searched, and carry the language of what lies behind them. Edges of a
    scene and its background have a few Gaussians that look alone; they stay.

    Args:
        gaussians: The scene.
        subject: The file, for the warning.
        up: The up direction; None estimates it.
        seed: Seed of samples.
        listener: Receives events of stage "floater views" in each search, one unit a view.
    """
    relative, own = isolation(gaussians)
    alone = np.minimum(relative, own)
    if float((alone > _CERTAIN).mean()) < _MANY:
        return np.zeros(0, np.int64)
    floating = alone > _ISOLATED
    upward: UpwardDirections | None = None
    with contextlib.suppress(CaptureError):  # no surfaces: the choice of views refuses such splats
        for _ in range(_ROUNDS):
            kept = np.flatnonzero(~floating)
            found, upward = _before_surfaces(_select(gaussians, kept), up, upward, seed, listener)
            floating[kept[found]] = True
            if not len(found):
                break
    log.warning(
        "%s: %d of %d Gaussians float free of all surfaces and are left out; --keep-floaters keeps them",
        subject,
        int(floating.sum()),
        len(gaussians),
    )
    return np.flatnonzero(floating)


def isolation(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Isolation of each Gaussian: the mean distance of its 12 nearest solid neighbors.

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
    up: NDArray[np.float64] | None,
    upward: UpwardDirections | None,
    seed: int,
    listener: Listener,
) -> tuple[NDArray[np.int64], UpwardDirections | None]:
    """Indices of the large Gaussians that hang in front of surfaces, or engulf them, and the directions of up.

    Raises:
        CaptureError: If the other Gaussians form no surfaces.
    """
    relative, own = isolation(gaussians)
    suspected = (relative > _ISOLATED) | (own < _ENGULFING)
    suspects, solid = np.flatnonzero(suspected), np.flatnonzero(~suspected)
    generator = np.random.default_rng(seed)
    parts = generator.integers(0, _PARTS, len(suspects))
    rest = [_select(gaussians, np.r_[solid, suspects[parts != part]]) for part in range(_PARTS)]
    points, radii = _spread(_select(gaussians, suspects)), _middle_radii(gaussians)[suspects]
    engulfing = own[suspects] < _ENGULFING
    before, on = (np.zeros(len(suspects), np.int64) for _ in range(2))
    shown = _select(gaussians, solid)
    found = find_surroundings(shown, up, look_from_above(shown), Path(), seed, warn=False, upward=upward)
    cameras = _cameras(found, generator)
    for done, camera in enumerate(cameras):
        listener(Event("floater views", done, len(cameras)))
        for part in np.unique(parts):
            members = np.flatnonzero(parts == part)
            gaps, depths = _gaps(rest[part], camera, points[members])
            margins = np.clip(np.where(engulfing, 0, radii)[members, None] / depths, *_SAME_DEPTH)
            before[members] += (gaps > margins).sum(1)
            on[members] += (np.abs(gaps) <= margins).sum(1)
    listener(Event("floater views", len(cameras), len(cameras)))
    least = np.where(engulfing, _PIERCED, _IN_FRONT)
    return suspects[(before >= _LEAST) & (before >= least * (before + on))], found.upward


def _select(gaussians: Gaussians, indices: NDArray[np.int64]) -> Gaussians:
    return gaussians.select(torch.from_numpy(indices).to(gaussians.device))


def _cameras(found: Surroundings, generator: np.random.Generator) -> list[Camera]:
    """Views around a scene."""
    return [camera for camera, _ in around(found, SMALL, partial(some, most=_VIEWS, generator=generator))]


def _spread(gaussians: Gaussians) -> NDArray[np.float64]:
    """The center of each Gaussian, and the ends of its two longest axes ``[N, 5, 3]``."""
    scales = gaussians.scales.detach().cpu().double()
    axes = matrices_from_quaternions(gaussians.quats.detach().cpu().double()).mT * scales[..., None]
    longest = scales.topk(2, dim=1).indices
    arms = axes.gather(1, longest[..., None].expand(-1, -1, 3))
    center = gaussians.means.detach().cpu().double()[:, None]
    return np.asarray(torch.cat([center, center + arms, center - arms], 1).numpy())


def _gaps(
    gaussians: Gaussians, camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance of the surface of a view behind points ``[..., 3]`` as a share of their depths, and the depths
    ``[...]``.

    NaN stands for points outside of the view and for pixels that are not opaque.
    """
    surface, _, alpha = draw_depth(gaussians, camera)
    pixels, depths, within = camera.project(points)
    depths = np.where(depths > 0, depths, np.nan)
    columns, rows = pixels[within].astype(int).T
    gaps = np.full(depths.shape, np.nan)
    gaps[within] = np.where(alpha[rows, columns] > 0.8, surface[rows, columns] / depths[within] - 1, np.nan)
    return gaps, depths
