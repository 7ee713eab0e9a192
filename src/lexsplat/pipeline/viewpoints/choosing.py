"""Chooses views that show surfaces, until nearly all visible Gaussians are in one of them."""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.candidates import FOV_Y, around, inside, some
from lexsplat.pipeline.viewpoints.interior import (
    Interior,
    Looks,
    Side,
    examine,
    examine_inside,
    without_lonely_points,
)
from lexsplat.pipeline.viewpoints.looking import SMALL, look, look_from_above
from lexsplat.pipeline.viewpoints.one_photo import Photo, find_photo
from lexsplat.pipeline.viewpoints.surroundings import SOLID, Surroundings, Target, find_surroundings
from lexsplat.rendering import measure_weights
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.progress import Event, Listener, silent, uncounted

log = logging.getLogger("lexsplat")

SIZE = (960, 720)
"""Width and height of the chosen views in pixels."""
_MOST_CANDIDATES = 600
_MOST_VIEWS = 96
_FEWEST_VIEWS = 8
_SAMPLE = 40_000
"""Gaussians whose coverage is followed, at most."""
_TIMES = 6
"""Number of views that should see each Gaussian: the mean over views cancels the errors of single ones."""
_SEEN = 0.1
"""Weight in pixels of a small view at which a Gaussian counts as seen: a quarter of a cell of a feature map."""
_LEAST_GAIN = 0.001
"""The choice ends when no view adds this share of all coverage."""
_LEAST_CLEAR = 0.2
"""Least share of the drawn pixels of a good view that show a surface; there is none in a room."""
_LEAST_OF_BEST = 0.65
"""Least share of such pixels relative to the best views: where a splat is sharp, a view of fog is no use."""
_ENOUGH = 0.05
"""Least share of good views among the candidates of an object; with fewer, both least shares are reduced."""
_ENOUGH_INSIDE = 0.5
"""The same in a room, which looks alike from everywhere except for the floaters in front."""
_LENIENT = (1.0, 0.5, 0.25)
"""Factors on both least shares, tried in this order."""
_SOME = 1 / 3
"""Where fewer of the clear views see into the scene, it has no inside: a solid thing hides its own middle."""
_USUALLY_VISIBLE = 0.5
"""Least share of the opaque Gaussians that some view should show: of captures it is .9, of made-up rooms .6."""
_HIDDEN = 0.75
"""Share of what can be seen in none of fewer views than `_FEWEST_VIEWS` at which splats are refused."""
_MOST_OTHERS = 128
"""Largest number of views that are not good enough to be chosen, but show which Gaussians are visible at all."""


@dataclass(frozen=True)
class ChosenViews:
    """Views of a splat without a capture.

    Args:
        cameras: The cameras, best first.
        up: The up direction.
        candidates: Number of cameras that were tried.
        left_out: Number of those that showed floaters, holes, or something in front of their target.
        visible: Number of Gaussians that can be seen from around an object, or from free places within a room.
        unseen: Number of those that no chosen view shows.
        room: Whether the scene was taken as a room.
    """

    cameras: tuple[Camera, ...]
    up: Up
    candidates: int
    left_out: int
    visible: int
    unseen: int
    room: bool = False

    @property
    def note(self) -> str:
        """One line for the user."""
        kind = "a room or another closed place, from inside" if self.room else "an object, from around"
        return (
            f"{len(self.cameras)} views chosen of {self.candidates} ({self.left_out} showed no surfaces), "
            f"as of {kind}; "
            f"{self.unseen:,} of {self.visible:,} visible Gaussians are in none of them"
        )


@torch.no_grad()
def choose_views(
    gaussians: Gaussians,
    *,
    up: NDArray[np.float64] | None = None,
    side: Side = "auto",
    subject: Path = Path("splats"),
    seed: int = 0,
    listener: Listener = silent,
) -> ChosenViews:
    """Choose cameras that see the surfaces of a splat well.

    Args:
        gaussians: The scene.
        up: The up direction; None estimates it.
        side: From where they look: "inside" a room, "around" an object; "auto" finds out.
        subject: The file, for errors and warnings.
        seed: Seed of samples.
        listener: Receives events of the stages "surroundings", "views" (candidates) and "comparison" (the good ones
            and others).

    Raises:
        CaptureError: If the Gaussians form no surfaces, or hardly any place shows some.
    """

    with uncounted(listener, "surroundings", subject):
        photo = find_photo(gaussians) if side == "auto" else None
        if photo is None:
            found = find_surroundings(gaussians, up, look_from_above(gaussians), subject, seed)
        else:
            found, side = _before_photo(gaussians, photo, up, subject, seed), "around"
    tried = _good_candidates(gaussians, found, side, seed, listener, photo)
    if not tried.cameras:
        raise CaptureError(
            subject,
            expected="a place from which the Gaussians look like surfaces",
            found=f"none of {tried.count} tried (fog, holes, or no free space)",
            remedy="give the capture it was made from, the up direction with --up x,y,z, or --views-from",
        )
    _warn(tried, found, gaussians, subject)
    chosen, visible, unseen = _cover(tried)
    if len(chosen) < _FEWEST_VIEWS and unseen > _HIDDEN * visible:
        raise CaptureError(
            subject,
            expected="views that show most of the visible Gaussians",
            found=f"chosen views: {len(chosen)}; floaters or haze hide {unseen / visible:.0%} of these Gaussians",
            remedy="remove the large floaters in an editor of splats, give the capture it was made from, "
            "or the up direction with --up x,y,z",
        )
    cameras = tuple(tried.cameras[index].resized(*SIZE) for index in chosen)
    share = len(gaussians) / max(tried.weights.shape[1], 1)
    opaque = int((gaussians.opacities > SOLID).sum())
    if visible * share < _USUALLY_VISIBLE * opaque:
        log.warning(
            "%s: only %s of %s opaque Gaussians can be seen from any place tried; floaters or walls hide the others",
            subject,
            f"{round(visible * share):,}",
            f"{opaque:,}",
        )
    return ChosenViews(
        cameras,
        found.up,
        tried.count,
        tried.count - len(tried.cameras),
        round(visible * share),
        round(unseen * share),
        tried.interior.is_room,
    )


def _before_photo(
    gaussians: Gaussians, photo: Photo, up: NDArray[np.float64] | None, subject: Path, seed: int
) -> Surroundings:
    """The surroundings of splats that were made from one photo, whose up direction is that of the photo."""
    log.warning(
        "%s: shows things only from the side of a camera at the origin, as splats made from one photo do; views are "
        "chosen near it, and --views-from around or inside chooses from all sides",
        subject,
    )
    given = photo.up if up is None else up
    found = find_surroundings(gaussians, given, look_from_above(gaussians), subject, seed, warn=False)
    if up is None:
        direction = ",".join(f"{value + 0.0:g}" for value in photo.up)
        log.warning(
            "%s: the up direction is a guess (%s), that of the photo; give it with --up x,y,z if it was tilted",
            subject,
            direction,
        )
        found = replace(found, up=Up(photo.up, False))
    return found


def _warn(tried: _Tried, found: Surroundings, gaussians: Gaussians, subject: Path) -> None:
    """Warn if room or object is uncertain, or depends on an up direction that is a guess."""
    interior = tried.interior
    taken = (
        ("a room and looked at from inside", "around")
        if interior.is_room
        else ("an object and looked at from around", "inside")
    )
    for rival in found.rivals if interior.side == "auto" else ():
        if examine_inside(gaussians, rival).is_room != interior.is_room:
            log.warning(
                "%s: taken as %s, which depends on the up direction, a guess: give --up x,y,z, or --views-from %s",
                subject,
                *taken,
            )
            return
    if not interior.is_certain:
        log.warning(
            "%s: taken as %s, which is uncertain; see the contact sheet, and give --views-from %s if it is wrong",
            subject,
            *taken,
        )


@dataclass(frozen=True)
class _Tried:
    """Good candidates.

    Args:
        count: Number of all candidates.
        cameras: The good ones, small.
        qualities: Share of their pixels that show a surface ``[C]``.
        weights: Weight of a sample of the Gaussians in each ``[C, n]``, pixels.
        elsewhere: Whether other candidates show them ``[n]``.
        interior: Whether the scene is a room.
    """

    count: int
    cameras: list[Camera]
    qualities: NDArray[np.float32]
    weights: NDArray[np.float32]
    elsewhere: NDArray[np.bool_]
    interior: Interior


def _good_candidates(
    gaussians: Gaussians, found: Surroundings, side: Side, seed: int, listener: Listener, photo: Photo | None
) -> _Tried:
    generator = np.random.default_rng(seed)
    choose = partial(some, most=_MOST_CANDIDATES, generator=generator)
    seen_from = around(found, SMALL, choose) if photo is None else choose(photo.candidates(found, SMALL))
    outer: list[tuple[Camera, Target | None]] = list(seen_from)
    inner = inside(without_lonely_points(found), SMALL)
    candidates = [*outer, *((camera, None) for camera in inner)]
    qualities, depths = np.zeros(len(candidates), np.float32), []
    for done, (camera, target) in enumerate(candidates, start=1):
        depth, clear = look(gaussians, camera)
        if target is None:
            depths.append(depth)
        qualities[done - 1] = 0 if target is not None and is_hidden(depth, camera, target) else clear
        listener(Event("views", done, len(candidates)))
    seen_inside = Looks(inner, depths, qualities[len(outer) :])
    interior = replace(examine(gaussians, found, seen_inside), side=side)
    cameras = [camera for camera, _ in candidates]
    allowed = _on_its_side(interior, found, cameras, len(outer))
    good = np.zeros(len(candidates), bool)
    for part in _LENIENT:
        if good[allowed].mean() < (_ENOUGH_INSIDE if interior.is_room else _ENOUGH):
            least = 0.0 if interior.is_room else _LEAST_CLEAR
            good[allowed] = _clear_enough(qualities[allowed], part, least)
            if not (interior.is_room or interior.is_shell):
                good = _before_walls(gaussians, cameras, good, found)
    looked_at = np.arange(len(gaussians))
    if len(looked_at) > _SAMPLE:
        looked_at = np.sort(generator.choice(looked_at, _SAMPLE, replace=False))
    others = np.flatnonzero(allowed & ~good)
    others = others[:: -(-len(others) // _MOST_OTHERS) or 1]
    chosen_from = np.flatnonzero(good)

    compared, total = itertools.count(), len(chosen_from) + len(others)

    def weigh(indices: NDArray[np.int64]) -> NDArray[np.float32]:
        weights = np.zeros((len(indices), len(looked_at)), np.float32)
        for row, index in enumerate(indices):
            listener(Event("comparison", next(compared), total))
            weights[row] = measure_weights(gaussians, cameras[index]).cpu().numpy()[looked_at]
        return weights

    weights, elsewhere = weigh(chosen_from), (weigh(others) > _SEEN).any(axis=0)
    listener(Event("comparison", total, total))
    good_cameras = [cameras[index] for index in chosen_from]
    return _Tried(len(candidates), good_cameras, qualities[good], weights, np.asarray(elsewhere), interior)


def _on_its_side(
    interior: Interior, found: Surroundings, cameras: list[Camera], outer: int
) -> NDArray[np.bool_]:
    """Which cameras are within a room, or around an object; ``outer`` is the number of those that look at targets."""
    within = found.box.contains(np.stack([camera.position for camera in cameras]))
    looking_around = np.arange(len(cameras)) >= outer
    if interior.is_room:  # from outside, walls show their backs
        return np.asarray(within | looking_around)
    if interior.is_shell:
        return np.asarray(~(within | looking_around))
    return ~looking_around  # what looks around is between things, or beside them


def is_hidden(depth: NDArray[np.float32], camera: Camera, target: Target) -> bool:
    """Whether something stands between a camera and its target, or close in front of the camera.

    Args:
        depth: Depth ``[H, W]``, infinite where nothing is drawn.
        camera: The camera.
        target: Target in the middle of its image.
    """
    rows, columns = (slice(size * 2 // 5, size * 3 // 5) for size in depth.shape)
    distance = float(np.linalg.norm(camera.position - target.center))
    before = float(np.median(depth[rows, columns])) < distance - 1.5 * target.radius
    return before or float((depth < 0.3 * distance).mean()) > 0.05


def _clear_enough(
    qualities: NDArray[np.float32], part: float, least: float = _LEAST_CLEAR
) -> NDArray[np.bool_]:
    """Which views show enough surfaces, with both least shares reduced to a part of them."""
    enough = qualities >= part * least
    best = float(np.quantile(qualities[enough], 0.9)) if enough.any() else 0.0
    return np.asarray(enough & (qualities > part * _LEAST_OF_BEST * best))


def _before_walls(
    gaussians: Gaussians, cameras: list[Camera], good: NDArray[np.bool_], found: Surroundings
) -> NDArray[np.bool_]:
    """Which of the good cameras are not behind a wall; all of them if nearly all seem to be."""
    before = good.copy()
    for index in np.flatnonzero(good):
        before[index] = not _is_behind_a_wall(gaussians, cameras[index], found)
    return before if before.sum() >= _SOME * good.sum() else good


def _is_behind_a_wall(gaussians: Gaussians, camera: Camera, found: Surroundings) -> bool:
    """Whether a camera outside of the scene does not see into it: it would show the back of a wall."""
    if found.box.contains(camera.position[None])[0]:
        return False
    whole = found.whole
    steep = abs(float((whole.center - camera.position) @ found.up.direction)) > 0.9 * float(
        np.linalg.norm(whole.center - camera.position)
    )
    upwards = camera.viewmat[0, :3] if steep else found.up.direction
    inwards = look_at(camera.position, whole.center, upwards, *SMALL, FOV_Y)
    depth, _ = look(gaussians, inwards)
    return is_hidden(depth, inwards, Target(whole.center, whole.radius * 2 / 3))


def _cover(tried: _Tried) -> tuple[list[int], int, int]:
    """Greedy choice: the view that adds most coverage, again and again.

    Returns:
        Indices of the chosen candidates; how many Gaussians of the sample any candidate of
        the kind that is taken shows; how many of these no
        chosen one shows.
    """
    shown = np.minimum(tried.weights / _SEEN, 1)
    covered = np.zeros(shown.shape[1], np.float32)
    possible = np.minimum(shown.sum(0), _TIMES)
    left = set(range(len(shown)))
    chosen: list[int] = []
    while left and len(chosen) < _MOST_VIEWS:
        indices = sorted(left)
        gains = [
            float(np.minimum(shown[i], _TIMES - covered).sum() * tried.qualities[i] ** 2) for i in indices
        ]
        best = int(np.argmax(gains))
        if len(chosen) >= _FEWEST_VIEWS and gains[best] < _LEAST_GAIN * possible.sum():
            break
        chosen.append(indices[best])
        left.remove(indices[best])
        covered = np.minimum(covered + shown[indices[best]], _TIMES)
    visible = (possible > 0.5) | tried.elsewhere
    return chosen, int(visible.sum()), int((visible & (covered < 0.5)).sum())
