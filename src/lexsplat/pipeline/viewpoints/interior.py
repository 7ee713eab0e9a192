"""Whether splats are a room, viewed from inside, or an object, viewed from around.

A room is closed all around its free places, and holds things. A ball or crate from a mesh converter is also closed,
but empty: from any place inside, only the convex shell around that place is seen.
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
"""Least share of surfaces all around a closed place; others are hazy: between the things of a hazy capture it is .13
in the middle, and .20 at most."""
_ENCLOSED = 0.4
"""Least share of closed and hazy places among the free ones of a room. The corners of its box may be outside."""
_CLEARLY = 0.1
"""Least share of closed places alone among the free ones of a room."""
_MOSTLY = 0.6
"""Share of closed places from which a room is certain."""
_PARTLY = 0.2
"""Share of closed and hazy places from which an object might be a room."""
_LEVELS = (0.3, 0.85)
"""Heights, relative to that of the scene, that are looked at, too, where it is closed at eye height: what has legs
and a neck is open there."""
_DEEP = 0.1
"""Things are this far within the hull of what a place shows, relative to the smaller one of the height of the scene
and the middle distance of what is seen."""
_NEAR = 0.05
"""Things are this close to solid points, relative to the same; floaters are not."""
_THINGS = 0.004
"""Least share of things in what is seen from the places of a room; an empty shell has 0."""
_CERTAINLY = 0.012
"""Share of things from which a room is certain."""
_LONELY = 3.0
"""Lonely Gaussians are this many times farther from their neighbors than usual, whatever their size."""
_NEIGHBORS = 12
_FEW_PLACES = 10
_POINTS = 3000
"""Points of what a place shows, at most."""


@dataclass(frozen=True)
class Interior:
    """Statistics of the views from free places within a scene.

    Args:
        places: Number of free places.
        enclosed: Share of those that are closed all around, in 0..1.
        things: Share of what closed places show that stands free of the shell around them, in 0..1.
        hazy: Share of the places around which something is drawn everywhere that is no clear surface.
        side: The setting of the user; "auto" leaves it to the shares.
    """

    places: int
    enclosed: float
    things: float
    hazy: float = 0.0
    side: Side = "auto"

    @property
    def is_room(self) -> bool:
        """Whether the scene is a room; else it is an object, or things on a table."""
        if self.side != "auto":
            return self.side == "inside"
        drawn = self.enclosed + self.hazy
        return self.enclosed >= _CLEARLY and drawn >= _ENCLOSED and self.things >= _THINGS

    @property
    def is_shell(self) -> bool:
        """Whether the scene is closed and empty: its outer side is all there is to see."""
        return not self.is_room and self.enclosed > 0 and self.things < _THINGS

    @property
    def is_certain(self) -> bool:
        """Whether the user set it, or the evidence is clear.

        It is for a closed place with things in it, and for free places that are hardly ever closed. A closed shell
        without things may be an empty room, and where there is no free place, nothing is known.
        """
        if self.side != "auto":
            return True
        if self.is_room:
            return self.enclosed >= _MOSTLY and self.things >= _CERTAINLY and self.hazy < _ENCLOSED
        return self.places > 0 and self.enclosed + self.hazy < _PARTLY


@dataclass(frozen=True)
class Looks:
    """Renderings of several cameras.

    Args:
        cameras: Cameras of `candidates.inside`: as many as `TURNS` at each free place.
        depths: Depths ``[H, W]`` of each, infinite where nothing is drawn.
        qualities: Share of surfaces in each.
    """

    cameras: list[Camera]
    depths: list[Image]
    qualities: NDArray[np.float32]

    @classmethod
    def at(cls, gaussians: Gaussians, cameras: list[Camera]) -> Looks:
        """Render Gaussians with each camera."""
        looks = [look(gaussians, camera) for camera in cameras]
        return cls(
            cameras, [depth for depth, _ in looks], np.array([clear for _, clear in looks], np.float32)
        )


@torch.no_grad()
def examine_inside(gaussians: Gaussians, found: Surroundings) -> Interior:
    """Examine the inside of a scene from a part of its free places."""
    places = free_places(without_lonely_points(found))
    cameras = [
        camera
        for place in places[:: -(-len(places) // _FEW_PLACES) or 1]
        for camera in all_around(place, found, SMALL)
    ]
    return examine(gaussians, found, Looks.at(gaussians, cameras))


@torch.no_grad()
def examine(gaussians: Gaussians, found: Surroundings, looks: Looks) -> Interior:
    """Examine the inside of a scene, and again without floaters if it is hazy.

    Floaters fill a room like haze; the space above a table has walls of haze only. Lonely Gaussians are left out, and
    the others reach no farther than to their neighbors.

    Args:
        gaussians: The scene.
        found: Its surroundings.
        looks: Renderings from its free places.
    """
    result = _examined(gaussians, found, looks)
    if result.is_room or not result.hazy:
        return result
    rest = _without_floaters(gaussians)
    return _examined(rest, found, Looks.at(rest, looks.cameras))


def _without_floaters(gaussians: Gaussians) -> Gaussians:
    """The Gaussians that are not lonely, none larger than the distance of its neighbors."""
    relative, own = isolation(gaussians)
    radii = np.sort(gaussians.scales.detach().cpu().double().numpy(), axis=1)[:, 1]
    sociable = torch.from_numpy(np.flatnonzero(relative < _LONELY)).to(gaussians.device)
    rest = gaussians.select(sociable)
    reach = torch.from_numpy(np.log(np.maximum(own * radii, 1e-12))).to(rest.log_scales)[sociable]
    return replace(rest, log_scales=torch.minimum(rest.log_scales, reach[:, None]))


def without_lonely_points(found: Surroundings) -> Surroundings:
    """The same surroundings, whose places are free even if a floater is near."""
    points = found.tree.data
    apart = found.tree.query(points, k=min(_NEIGHBORS + 1, len(points)))[0][:, 1:].mean(1)
    return replace(found, tree=cKDTree(points[apart < _LONELY * np.median(apart)]))


def _examined(gaussians: Gaussians, found: Surroundings, looks: Looks) -> Interior:
    found = without_lonely_points(found)
    closed, hazy, things = [], [], []
    for first in range(0, len(looks.cameras), TURNS):
        views = slice(first, first + TURNS)
        drawn, clear = _is_closed(looks.depths[views]), float(looks.qualities[views].mean()) >= _CLEAR
        closed.append(drawn and clear)
        hazy.append(drawn and not clear)
        if closed[-1]:
            things.append(_share_of_things(looks.cameras[views], looks.depths[views], found))
    if not closed:
        return Interior(0, 0.0, 0.0)
    result = Interior(
        len(closed), float(np.mean(closed)), float(np.median(things)) if things else 0.0, float(np.mean(hazy))
    )
    if not result.is_room:
        return result
    for level in _LEVELS:
        for place in free_places(found, level):
            around = all_around(place, found, SMALL)[::2]
            closed.append(_is_closed([look(gaussians, camera)[0] for camera in around]))
    return replace(result, enclosed=float(np.mean(closed)))


def _is_closed(depths: list[Image]) -> bool:
    return float(np.isfinite(depths).mean()) >= _DRAWN


def _share_of_things(cameras: list[Camera], depths: list[Image], found: Surroundings) -> float:
    """Share of what is seen from a place that lies deep within the convex hull of all that is seen from it."""
    points = np.concatenate([_seen_points(camera, depth) for camera, depth in zip(cameras, depths)])
    points = points[:: max(1, len(points) // _POINTS)]
    if not len(points):
        return 0.0
    size = min(found.height, float(np.median(np.linalg.norm(points - cameras[0].position, axis=1))))
    points = points[found.tree.query(points)[0] < _NEAR * size]
    try:
        planes = ConvexHull(points).equations
    except (QhullError, ValueError):  # hardly a point, or all in one plane
        return 0.0
    depth = -(points @ planes[:, :3].T + planes[:, 3]).max(1)
    return float((depth > _DEEP * size).mean())


def _seen_points(camera: Camera, depth: Image) -> NDArray[np.float64]:
    """The points of the drawn pixels ``[M, 3]``, world."""
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    return camera.world(pixels @ np.linalg.inv(camera.K).T * depth[rows, columns, None])
