"""Estimates about Gaussians without cameras: solid points, the up direction, the ground, things to look at."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from lexsplat.geometry.boxes import Box, Up, trimmed_box
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.upward import LOW, UpwardDirections, find_upward
from lexsplat.rendering.compositing import NEAR
from lexsplat.runtime.errors import CaptureError

log = logging.getLogger("lexsplat")

SAMPLE = 30_000
"""Largest number of Gaussians that are examined."""
FEWEST = 50
"""Fewer solid Gaussians show no surface."""
_NEIGHBORS = 12
_TARGETS = 12
_ISOLATED = 4.0
"""A floater is this many times farther from its neighbors than usual, and than its own size."""
_FLAT = 0.02
"""Variance across a flat piece, relative to its second largest."""
_CORE = 2.5
"""The middle of the scene reaches this many radii; beyond it is background."""
_LEAST_RADIUS = 5 * NEAR
"""Radius of the smallest scene: cameras come about as near to things, and nothing nearer than `NEAR` is drawn."""
SOLID = 0.3
"""Opacity of solid Gaussians."""

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """Something to look at.

    Args:
        center: ``[3]``, world.
        radius: Extent, world units.
        normal: Unit normal ``[3]`` towards the middle of the scene if it is a flat piece such as a wall, else None.
    """

    center: Points
    radius: float
    normal: Points | None = None


@dataclass(frozen=True)
class Surroundings:
    """The solid part of a scene.

    Args:
        tree: Points of solid Gaussians, without floaters.
        up: The up direction; not reliable where it is a guess.
        ground: Height of the lowest points along up, world units.
        height: Height of the highest points above the ground.
        box: An upright box around the scene without its background.
        whole: The scene as a target.
        targets: Its parts.
        rivals: The same with other up directions that are nearly as likely, if up is a guess.
        upward: The directions from which up was taken; None if it was given.
    """

    tree: cKDTree
    up: Up
    ground: float
    height: float
    box: Box
    whole: Target
    targets: tuple[Target, ...]
    rivals: tuple[Surroundings, ...] = ()
    upward: UpwardDirections | None = None


def find_surroundings(
    gaussians: Gaussians,
    up: Points | None,
    look: Callable[[Target, Points], float],
    subject: Path,
    seed: int = 0,
    *,
    warn: bool = True,
    upward: UpwardDirections | None = None,
) -> Surroundings:
    """Look at a sample of the Gaussians.

    Args:
        gaussians: The scene.
        up: The up direction of the user; None estimates it.
        look: Function of the whole and the up direction. It returns the share of surfaces in views from above the
            ground, in 0..1, and helps to estimate the direction.
        subject: The file, for errors.
        seed: Seed of the sample and of the targets.
        warn: Warn of an up direction that is a guess or seems wrong, and of a flat scene.
        upward: The directions that may be up, if they are known from most of the Gaussians; None finds them.

    Raises:
        CaptureError: If fewer than `FEWEST` Gaussians are solid, all are at one point, or the scene is too small to
            be rendered.
    """
    points = _solid_points(gaussians, seed)
    _check_points(points, gaussians, subject)
    tree = cKDTree(points)
    center = np.median(points, axis=0)
    away = np.linalg.norm(points - center, axis=1)
    whole = Target(center, float(np.quantile(away, 0.6)))
    if whole.radius < _LEAST_RADIUS:
        factor = 10.0 ** math.ceil(-math.log10(max(whole.radius, 1e-12)))
        raise CaptureError(
            subject,
            expected=f"a scene with a radius of at least {_LEAST_RADIUS:g} units",
            found=f"{whole.radius:.2g}, and nothing nearer to a camera than {NEAR:g} is drawn",
            remedy=f"scale the splats up, as does: splat-transform {subject.name} --scale {factor:.0f} scaled.ply",
        )
    core = points[away < _CORE * whole.radius]
    targets = tuple(_targets(core, center, seed))

    def facing(direction: Up) -> Surroundings:
        ground, top = np.quantile(core @ direction.direction, [LOW, 1 - LOW])
        box = trimmed_box(core, direction.direction, LOW)
        return Surroundings(tree, direction, float(ground), float(top - ground), box, whole, targets)

    given = None if up is None else facing(Up(up / np.linalg.norm(up), True))
    if given is not None and not warn:
        return given
    upward = upward or find_upward(core, lambda direction: look(whole, direction))
    if warn:
        _warn(upward, up, points, subject)
    if given is not None:
        return given
    estimated = replace(facing(Up(upward.directions[0], upward.reliable)), upward=upward)
    if upward.reliable:
        return estimated
    return replace(estimated, rivals=tuple(facing(Up(rival, False)) for rival in upward.rivals()))


def _check_points(points: Points, gaussians: Gaussians, subject: Path) -> None:
    """Refuse Gaussians that form no surfaces; the error is that of `find_surroundings`."""
    opaque = int((gaussians.opacities > SOLID).sum())
    if opaque < FEWEST:
        found = f"{opaque:,} of {len(gaussians):,} opaque"
    elif len(points) < FEWEST:
        found = f"{len(points):,} of {len(gaussians):,}"
    elif np.ptp(points, axis=0).max() <= 0:
        found = f"{len(gaussians):,} at one point"
    else:
        return
    raise CaptureError(
        subject,
        expected=f"at least {FEWEST} Gaussians that form surfaces",
        found=found,
        remedy="check the file, or give the capture it was made from",
    )


def _warn(upward: UpwardDirections, given: Points | None, points: Points, subject: Path) -> None:
    direction = ",".join(f"{value + 0.0:.2g}" for value in np.round(upward.directions[0], 2))
    if given is None and not upward.reliable:
        log.warning(
            "%s: the up direction is a guess (%s); give it with --up x,y,z if the views are tilted",
            subject,
            direction,
        )
    if given is not None and upward.contradict(given):
        sure = "is not" if upward.reliable else "may not be"
        log.warning("%s: --up %s the direction in which things seem to stand (%s)", subject, sure, direction)
    values = np.linalg.eigvalsh(np.cov(points.T))
    if values[0] < _FLAT**3 * values[1]:
        log.warning(
            "%s: all Gaussians lie in one plane, as in an image; depth separates nothing in it", subject
        )


def _solid_points(gaussians: Gaussians, seed: int) -> Points:
    """Centers of a sample of the Gaussians, without transparent ones and floaters ``[M, 3]``."""
    solid = np.flatnonzero((gaussians.opacities > SOLID).cpu().numpy())
    if len(solid) > SAMPLE:
        solid = np.sort(np.random.default_rng(seed).choice(solid, SAMPLE, replace=False))
    points = gaussians.means.detach().cpu().double().numpy()[solid]
    if len(points) <= _NEIGHBORS:
        return points
    sizes = gaussians.scales.detach().cpu().double().numpy()[solid].max(1)
    apart = cKDTree(points).query(points, k=_NEIGHBORS)[0][:, 1:].mean(1)
    usual = float(np.median(apart))
    return np.asarray(points[(apart < _ISOLATED * usual) | (apart < _ISOLATED * sizes)])


def _targets(points: Points, middle: Points, seed: int) -> list[Target]:
    """Clusters of points; details have many Gaussians, so they get clusters of their own."""
    number = min(_TARGETS, len(points) // 10)
    centers, labels = kmeans2(points, number, minit="++", seed=seed)
    found = []
    for label in range(number):
        inside = points[labels == label]
        if len(inside) < 4:
            continue
        offsets = inside - inside.mean(0)
        values, vectors = np.linalg.eigh(offsets.T @ offsets / len(inside))
        normal = None
        towards = float(vectors[:, 0] @ (middle - centers[label]))
        if values[0] < _FLAT * values[1] and abs(towards) > 2 * math.sqrt(max(values[0], 0)):
            normal = vectors[:, 0] * np.sign(towards)
        found.append(Target(inside.mean(0), 1.5 * math.sqrt(values.sum()), normal))
    return found
