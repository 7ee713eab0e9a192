"""Whether splats are a room, to be looked at from inside, or an object, to be looked at from around.

A room is closed all around its free places, and holds things. What mesh converters make of a ball or of a crate is
closed, too, but empty: from any place inside, all that is seen is the convex shell around that place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.candidates import TURNS, all_around, free_places
from lexsplat.pipeline.viewpoints.floaters import isolation
from lexsplat.pipeline.viewpoints.looking import SMALL, Image, look
from lexsplat.pipeline.viewpoints.surroundings import Surroundings

Side = Literal["auto", "inside", "around"]
"""From where splats are looked at: as a room, as an object, or as `examine` finds."""

_DRAWN = 0.9
"""Least share of the pixels all around a closed place that are drawn: doors and windows are holes."""
_CLEAR = 0.2
"""Least share of surfaces all around a closed place: between the things of a hazy capture it is .13 in the middle,
and .20 at most."""
_ENCLOSED = 0.6
"""Least share of closed places among the free ones of a room,"""
_PARTLY = 0.3
"""and share above which it may be a room."""
_LEVELS = (0.3, 0.85)
"""Heights, relative to that of the scene, that are looked at, too, where it is closed at eye height: what has legs
and a neck is open there."""
_DEEP = 0.1
"""Things are this far within the hull of what a place shows, relative to the height of the scene."""
_NEAR = 0.05
"""Things are this close to solid points, relative to the height of the scene; floaters are not."""
_THINGS = 0.008
"""Least share of things in what is seen from the places of a room: it is 0.014 for two balls on the floor,"""
_HARDLY = 0.003
"""and share above which it may be a room; an empty shell has 0."""
_LONELY = 3.0
"""Lonely Gaussians are this many times farther from their neighbors than usual, whatever their size."""
_NEIGHBORS = 12
_POINTS = 3000
"""Points of what a place shows, at most."""


@dataclass(frozen=True)
class Interior:
    """What is seen from the free places within a scene.

    Args:
        places: Number of free places.
        enclosed: Share of those that are closed all around, in 0..1.
        things: Share of what closed places show that stands free of the shell around them, in 0..1.
        side: What the user says; "auto" leaves it to the shares.
    """

    places: int
    enclosed: float
    things: float
    side: Side = "auto"

    @property
    def is_room(self) -> bool:
        """Whether the scene is a room; else it is an object, or things on a table."""
        if self.side != "auto":
            return self.side == "inside"
        return self.enclosed >= _ENCLOSED and self.things >= _THINGS

    @property
    def is_shell(self) -> bool:
        """Whether the scene is closed and empty: its outer side is all there is to see."""
        return not self.is_room and self.enclosed > 0 and self.things < _THINGS

    @property
    def is_certain(self) -> bool:
        """Whether the user says it, or both shares are far from where the answer changes."""
        if self.side != "auto":
            return True
        if self.is_room:
            return self.things >= 1.2 * _THINGS
        return self.enclosed < _PARTLY or self.things < _HARDLY


@torch.no_grad()
def examine(
    gaussians: Gaussians,
    found: Surroundings,
    cameras: list[Camera],
    depths: list[Image],
    qualities: NDArray[np.float32],
) -> Interior:
    """Examine the inside of a scene, and again without lonely Gaussians if it is neither a room nor empty.

    Floaters fill a room like haze; the space above a table has walls of haze only.

    Args:
        gaussians: The scene.
        found: Its surroundings.
        cameras: Cameras of `candidates.inside`: as many as `TURNS` at each free place.
        depths: What they show, ``[H, W]`` each, infinite where nothing is drawn.
        qualities: Share of surfaces in each.
    """
    result = _examined(gaussians, found, cameras, depths, qualities)
    empty = result.enclosed >= _ENCLOSED and result.things < _HARDLY
    if result.is_room or empty or not cameras:
        return result
    sociable = isolation(gaussians)[0] < _LONELY
    rest = gaussians.select(torch.from_numpy(np.flatnonzero(sociable)).to(gaussians.device))
    looks = [look(rest, camera) for camera in cameras]
    shares = np.array([clear for _, clear in looks], np.float32)
    without = _examined(rest, found, cameras, [depth for depth, _ in looks], shares)
    return without if without.is_room else result


def without_lonely_points(found: Surroundings) -> Surroundings:
    """The same surroundings, whose places are free even if a floater is near."""
    points = found.tree.data
    apart = found.tree.query(points, k=min(_NEIGHBORS + 1, len(points)))[0][:, 1:].mean(1)
    return replace(found, tree=cKDTree(points[apart < _LONELY * np.median(apart)]))


def _examined(
    gaussians: Gaussians,
    found: Surroundings,
    cameras: list[Camera],
    depths: list[Image],
    qualities: NDArray[np.float32],
) -> Interior:
    found = without_lonely_points(found)
    closed, things = [], []
    for first in range(0, len(cameras), TURNS):
        views = slice(first, first + TURNS)
        closed.append(_is_closed(depths[views]) and float(qualities[views].mean()) >= _CLEAR)
        if closed[-1]:
            things.append(_share_of_things(cameras[views], depths[views], found))
    result = Interior(
        len(closed), float(np.mean(closed)) if closed else 0.0, float(np.median(things)) if things else 0.0
    )
    if not result.is_room:
        return result
    for level in _LEVELS:
        for place in free_places(found, level):
            around = all_around(place, found, SMALL)[::2]
            closed.append(_is_closed([look(gaussians, camera)[0] for camera in around]))
    return Interior(result.places, float(np.mean(closed)), result.things)


def _is_closed(depths: list[Image]) -> bool:
    return float(np.isfinite(depths).mean()) >= _DRAWN


def _share_of_things(cameras: list[Camera], depths: list[Image], found: Surroundings) -> float:
    """Share of what is seen from a place that lies deep within the convex hull of all that is seen from it."""
    points = np.concatenate([_seen_points(camera, depth) for camera, depth in zip(cameras, depths)])
    points = points[:: max(1, len(points) // _POINTS)]
    points = points[found.tree.query(points)[0] < _NEAR * found.height]
    try:
        planes = ConvexHull(points).equations
    except (QhullError, ValueError):  # hardly a point, or all in one plane
        return 0.0
    depth = -(points @ planes[:, :3].T + planes[:, 3]).max(1)
    return float((depth > _DEEP * found.height).mean())


def _seen_points(camera: Camera, depth: Image) -> NDArray[np.float64]:
    """The points of the drawn pixels ``[M, 3]``, world."""
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    local = pixels @ np.linalg.inv(camera.K).T * depth[rows, columns, None]
    return np.asarray((local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
