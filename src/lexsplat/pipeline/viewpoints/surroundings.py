"""What is known of Gaussians without cameras: their solid points, the up direction, the ground, things to look at."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from lexsplat.geometry.boxes import Box, Up, fit_box, upright_frame
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering.compositing import NEAR
from lexsplat.runtime.errors import CaptureError

log = logging.getLogger("lexsplat")

SAMPLE = 30_000
"""Number of Gaussians that are looked at, at most."""
FEWEST = 50
"""Fewer solid Gaussians show no surface."""
_NEIGHBORS = 12
_TARGETS = 12
_ISOLATED = 4.0
"""A floater is this many times farther from its neighbors than usual, and than its own size."""
_FLAT = 0.02
"""Variance across a flat piece, relative to its second largest."""
_CONVENTIONS = ((0, 0, 1), (0, 1, 0), (0, -1, 0))
"""Up directions of files that follow a convention: z up, y up (glTF), y down (COLMAP)."""

_TILTED = math.cos(math.radians(15))
_ALIGNED, _OTHER = math.cos(math.radians(10)), math.cos(math.radians(20))
_CORE = 2.5
"""The middle of the scene reaches this many radii; beyond it is background."""
_LOW = 0.05
"""Share of the points below the ground, where nobody has looked and nothing is as it seems."""
_LEAD = 0.15
"""Difference of the scores of two up directions by which one is certain,"""
_GROUND = 0.25
"""if a ground lies under this share of the scene as seen from above: under a thing alone there is none."""
_GROUND_HEIGHT = 0.08
"""Half the height of the slab in which a ground lies, relative to the height of the scene."""
_GROUND_CELLS = 24
"""Cells along the longer side of the scene in which the ground is counted."""
_LEAST_RADIUS = 1.5 * NEAR
"""Radius of the smallest scene: cameras come about as near to things, and nothing nearer than `NEAR` is drawn."""
_SOLID = 0.3
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
    """

    tree: cKDTree
    up: Up
    ground: float
    height: float
    box: Box
    whole: Target
    targets: tuple[Target, ...]


def find_surroundings(
    gaussians: Gaussians,
    up: Points | None,
    look: Callable[[Surroundings], float],
    subject: Path,
    seed: int = 0,
    *,
    warn: bool = True,
) -> Surroundings:
    """Look at a sample of the Gaussians.

    Args:
        gaussians: The scene.
        up: The up direction of the user; None estimates it.
        look: How much the splat looks like surfaces from above its ground, in 0..1; helps to estimate up.
        subject: The file, for errors.
        seed: Seed of the sample and of the targets.
        warn: Warn of an up direction that is a guess or seems wrong, and of a flat scene.

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
        ground, top = np.quantile(core @ direction.direction, [_LOW, 1 - _LOW])
        box = fit_box(core, direction.direction, trim=_LOW)
        return Surroundings(tree, direction, float(ground), float(top - ground), box, whole, targets)

    candidates = up_candidates(core)
    scores = np.array([score + look(facing(Up(direction, True))) for direction, score in candidates])
    best = candidates[int(scores.argmax())][0]
    others = [s for s, (direction, _) in zip(scores, candidates) if direction @ best < _OTHER]
    certain = scores.max() - max(others) > _LEAD and ground_share(core, best) > _GROUND
    estimated = Up(best, bool(certain))
    if warn:
        _warn(estimated, up, points, subject)
    return facing(estimated if up is None else Up(up / np.linalg.norm(up), True))


def _check_points(points: Points, gaussians: Gaussians, subject: Path) -> None:
    """Refuse Gaussians that form no surfaces; the error is that of `find_surroundings`."""
    opaque = int((gaussians.opacities > _SOLID).sum())
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


def _warn(estimated: Up, given: Points | None, points: Points, subject: Path) -> None:
    direction = ",".join(f"{value + 0.0:.2g}" for value in np.round(estimated.direction, 2))
    if given is None and not estimated.reliable:
        log.warning(
            "%s: the up direction is a guess (%s); give it with --up x,y,z if pictures are tilted",
            subject,
            direction,
        )
    if given is not None and estimated.reliable and given @ estimated.direction < 0.7 * np.linalg.norm(given):
        log.warning("%s: --up is not the direction in which things seem to stand (%s)", subject, direction)
    values = np.linalg.eigvalsh(np.cov(points.T))
    if values[0] < _FLAT**3 * values[1]:
        log.warning(
            "%s: all Gaussians lie in one plane, like a picture; depth tells nothing apart in it", subject
        )


def _solid_points(gaussians: Gaussians, seed: int) -> Points:
    """Centers of a sample of the Gaussians, without transparent ones and floaters ``[M, 3]``."""
    solid = np.flatnonzero((gaussians.opacities > _SOLID).cpu().numpy())
    if len(solid) > SAMPLE:
        solid = np.sort(np.random.default_rng(seed).choice(solid, SAMPLE, replace=False))
    points = gaussians.means.detach().cpu().double().numpy()[solid]
    if len(points) <= _NEIGHBORS:
        return points
    sizes = gaussians.scales.detach().cpu().double().numpy()[solid].max(1)
    apart = cKDTree(points).query(points, k=_NEIGHBORS)[0][:, 1:].mean(1)
    usual = float(np.median(apart))
    return np.asarray(points[(apart < _ISOLATED * usual) | (apart < _ISOLATED * sizes)])


def _normals(neighborhoods: NDArray) -> tuple[Points, Points]:
    """Unit normals ``[M, 3]`` of neighborhoods ``[M, k, 3]``, and how flat they are ``[M]`` in 0..1."""
    offsets = neighborhoods - neighborhoods.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))
    return vectors[:, :, 0], 1 - np.clip(values[:, 0] / np.maximum(values[:, 1], 1e-12), 0, 1)


def up_candidates(points: Points) -> list[tuple[Points, float]]:
    """Directions that may be up, with scores.

    They are the normals of the largest planes, either way, and the directions of the usual conventions. A direction
    scores by the area of surfaces across it in the lower third of the scene, less that in the upper third; by what
    stands above them; by how low the points lie; and a little by convention.

    Args:
        points: Solid points ``[M, 3]`` of the middle of the scene.
    """
    distances, neighbors = cKDTree(points).query(points, k=_NEIGHBORS)
    normals, flatness = _normals(points[neighbors])
    reach = distances[:, -1]
    areas = np.minimum(reach, 3 * np.median(reach)) ** 2 * flatness
    shares = areas / max(float(areas.sum()), 1e-300)
    candidates = [np.array(axis, float) for axis in _CONVENTIONS]
    left = shares.copy()
    for _ in range(3):
        tried = normals[np.argsort(-left, kind="stable")[:: max(1, len(left) // 200)]]
        support = (np.abs(normals @ tried.T) > _ALIGNED).T @ left
        first = tried[int(support.argmax())]
        near = np.abs(normals @ first) > _ALIGNED
        mean = (normals[near] * np.sign(normals[near] @ first)[:, None] * left[near, None]).sum(0)
        if np.linalg.norm(mean) < 1e-12:
            break
        candidates += [mean / np.linalg.norm(mean), -mean / np.linalg.norm(mean)]
        left = np.where(near, 0, left)
    return [(candidate, _up_score(points, normals, shares, candidate)) for candidate in candidates]


def _up_score(points: Points, normals: Points, shares: Points, up: Points) -> float:
    heights = points @ up
    low, high = np.quantile(heights, [_LOW, 1 - _LOW])
    level = (heights - low) / max(high - low, 1e-12)
    across = np.where(np.abs(normals @ up) > _TILTED, shares, 0)
    floor = float(across[level < 0.33].sum() - across[level > 0.67].sum())
    standing = float(((level > 0.33) & (level < 0.67)).mean() - (level > 0.67).mean())
    lying = 0.5 - float(np.median(level))
    usual = max(float(up @ np.array(axis)) for axis in _CONVENTIONS)
    return floor + 0.5 * standing + lying + (0.2 if usual > math.cos(math.radians(20)) else 0.0)


def ground_share(points: Points, up: Points) -> float:
    """Share of a scene, as seen from above, under which a level ground lies, in 0..1.

    The ground is the slab in the lower third that holds most pieces of surface across the up direction.

    Args:
        points: Solid points ``[M, 3]`` of the middle of the scene.
        up: The up direction ``[3]``, of unit length.
    """
    normals, flatness = _normals(points[cKDTree(points).query(points, k=_NEIGHBORS)[1]])
    heights = points @ up
    low, high = np.quantile(heights, [_LOW, 1 - _LOW])
    level = (np.abs(normals @ up) > _TILTED) & (flatness > 0.5) & (heights < low + (high - low) / 3)
    half = _GROUND_HEIGHT * (high - low)
    if not level.any() or half <= 0:
        return 0.0
    counts, edges = np.histogram(heights[level], max(1, math.ceil(float(np.ptp(heights[level])) / half)))
    middle = edges[counts.argmax()] + half / 2
    footprint = points @ np.stack(upright_frame(up)[:2]).T
    first, last = np.quantile(footprint, [0.02, 0.98], axis=0)
    cells = np.floor((footprint - first) / max(float((last - first).max()) / _GROUND_CELLS, 1e-300))
    ground = level & (np.abs(heights - middle) < half)
    return len(np.unique(cells[ground], axis=0)) / len(np.unique(cells, axis=0))


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
