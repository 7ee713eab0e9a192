"""Few photos: more initial points than structure from motion finds, and the expected quality of new views.

Few photos give few points, and a short training cannot fill the places between them. Points at the depths of their
neighbors in a photo start it close to the surfaces.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime import memory as budget
from lexsplat.runtime.progress import Listener, silent

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from lexsplat.captures import Capture, View
    from lexsplat.captures.sfm.triangulation import InitialPoints

log = logging.getLogger("lexsplat")

FEW_PHOTOS = 25
"""Captures with at most this many training views are treated as few photos."""

ENOUGH_POINTS = 1_500
PIXELS_A_POINT = 32
"""Points are added until there is one for so many pixels of the training views, and at most `ENOUGH_POINTS`. With 567
points of structure from motion they gain 1 dB, with 769 nothing, and 5,000 in place of 2,600 lose some tenths
(docs/lab-notes/2026-11-reconstruction.md)."""


def has_few_photos(capture: Capture) -> bool:
    """Whether a capture has so few training views that it is treated as few photos."""
    return len(capture.train_views) <= FEW_PHOTOS


def starting_points(
    capture: Capture,
    *,
    seed: int = 0,
    cache_dir: Path | None = None,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> InitialPoints:
    """The points from which a training starts: the initial points, with more between them for few photos.

    Args:
        capture: The capture, at the size of the training.
        seed: Seed of all that is random.
        cache_dir: Folder where triangulated points are kept; None keeps nothing.
        memory: Bytes of host memory for the triangulation.
        listener: Receives progress events of the triangulation.

    Raises:
        CaptureError: If a photo cannot be read.
    """
    from lexsplat.captures.sfm.triangulation import initial_points

    points = initial_points(capture, seed=seed, cache_dir=cache_dir, memory=memory, listener=listener)
    if has_few_photos(capture) and points.origin != "random":
        return points_between(capture, points, seed)
    return points


def points_between(
    capture: Capture, known: InitialPoints, seed: int = 0, *, enough: int | None = None
) -> InitialPoints:
    """The known points, and points at random pixels of the training views.

    A pixel has the depth of the known point that projects nearest to it, and the color of the photo.

    Args:
        capture: The capture, at the size of the training.
        known: Points of structure from motion.
        seed: Seed of the pixels.
        enough: Number of points up to which some are added, where there are pixels enough; None takes
            `ENOUGH_POINTS`.

    Raises:
        CaptureError: If a photo cannot be read.
    """
    views, rng = capture.train_views, np.random.default_rng(seed)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    enough = ENOUGH_POINTS if enough is None else enough
    lacking = max(0, min(enough, pixels // PIXELS_A_POINT) - len(known.points))
    share = lacking / max(pixels, 1)
    found = [_points_of(view, known.points, share, rng) for view in views]
    points, colors = (
        np.concatenate(parts).astype(np.float32) for parts in zip((known.points, known.colors), *found)
    )
    note = f"{known.note}, {len(points) - len(known.points):,} between them"
    return replace(known, points=points, colors=colors, note=note)


def _points_of(
    view: View, known: NDArray[np.float32], share: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Points of a share of the pixels of a view ``[P, 3]``, world, and their colors ``[P, 3]``."""
    camera = view.camera
    size, focal = np.array([camera.width, camera.height]), np.diag(camera.K)[:2]
    places, depth, inside = camera.project(known)
    if not inside.any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    chosen = rng.random((round(share * size.prod()), 2)) * size
    columns, rows = chosen.astype(int).T
    if (valid := view.load_valid()) is not None:
        counted = valid[rows, columns]
        chosen, columns, rows = chosen[counted], columns[counted], rows[counted]
    depths = depth[inside][cKDTree(places[inside]).query(chosen)[1]]
    rays = np.column_stack([(chosen - camera.K[:2, 2]) / focal, np.ones(len(chosen))])
    return camera.world(rays * depths[:, None]), view.load_image()[rows, columns]


def warn_of_few_photos(capture: Capture, gaussians: Gaussians) -> None:
    """Log the expected quality of new views of few photos, from the held-out photos if there are any."""
    measured = ""
    if capture.test_views:
        trained, held_out = (
            _psnr(capture, gaussians, views) for views in (capture.train_views, capture.test_views)
        )
        count = _counted(len(capture.test_views), "held-out")
        measured = f": {count} rendered at {held_out:.1f} dB, trained ones at {trained:.1f} dB"
    log.warning(
        "%s few%s; views far from every photo are guessed, so take 30 photos or more that overlap"
        " by 60 to 80 percent",
        _counted(len(capture.train_views), "training"),
        measured,
    )


def _counted(count: int, kind: str) -> str:
    """Begin of a sentence about photos: "1 training photo is", "2 training photos are"."""
    return f"{count} {kind} photo is" if count == 1 else f"{count} {kind} photos are"


@torch.no_grad()
def _psnr(capture: Capture, gaussians: Gaussians, views: Iterable[View]) -> float:
    """Mean PSNR of views in dB, over the pixels that are not masked."""
    from lexsplat.rendering import render

    background = torch.tensor(capture.background, dtype=torch.float32, device=gaussians.device)
    found = []
    for view in views:
        image = render(gaussians, view.camera, background=background).image.clamp(0, 1).cpu().numpy()
        valid, errors = view.load_valid(), (image - view.load_image()) ** 2
        found.append(-10 * np.log10(max(float((errors if valid is None else errors[valid]).mean()), 1e-10)))
    return float(np.mean(found))
