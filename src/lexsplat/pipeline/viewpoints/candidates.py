"""Candidate cameras: around the scene and its parts, and looking around inside a room."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.boxes import upright_frame
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.pipeline.viewpoints.surroundings import Surroundings, Target

FOV_Y = math.radians(40)
"""Vertical field of view, that of a phone held upright or of a 45 mm lens."""
_AZIMUTHS = 16
"""Cameras on a circle around a part; twice as many around the whole scene, of which photos are taken mostly."""
_ELEVATIONS = (10, 25, 45)
_DISTANCES = (0.75, 1.1)
"""In distances from which the target fills the height of the image."""
_CLEARANCE = 0.15
"""Free radius around a camera, relative to its distance from the target."""
_CLEARANCE_INSIDE = (0.2, 0.1, 0.05)
"""The same within a room, relative to the free height there: the largest at which there is a place."""
_CLOSEST = 0.5
"""Least distance, relative to that from which the whole scene fills the image."""
_EYE = 0.6
"""Eye height in a room, relative to the free height: 1.5 m of 2.5 m."""
_GRID = (8, 48)
"""Least and largest number of columns along either side of the scene in which free places are looked for."""
_COLUMN = 0.2
"""Width of a column, relative to the height of the scene."""
_STEPS = 24
"""Heights that are tried in each column."""
_WALL = 0.05
"""Distance from solid points within which nothing is free, relative to the height of the scene."""
_STOREY = 0.3
"""Least free height of a place, relative to that of the scene: none under a table, but in each of three stories."""
_APART = 0.4
"""Least distance of places within the scene, relative to their free height: every room gets some."""
_MOST_PLACES = 40
"""They are looked around from, which takes time."""
_TILTS = ((-0.2, 8), (-1.2, 4))
"""Slopes of the cameras at each place within the scene, and how many of each: down is the floor."""
TURNS = sum(count for _, count in _TILTS)
"""Cameras at each place within the scene."""

Points = NDArray[np.float64]
T = TypeVar("T")
Looking = tuple[Points, Target]


def some(items: list[T], most: int, generator: np.random.Generator) -> list[T]:
    """All items, or as many of them in their order as may be."""
    if len(items) <= most:
        return items
    return [items[index] for index in np.sort(generator.choice(len(items), most, replace=False))]


def around(
    surroundings: Surroundings, size: tuple[int, int], choose: Callable[[list[Looking]], list[Looking]] = list
) -> list[tuple[Camera, Target]]:
    """Cameras on circles around the scene and its parts that see their targets from free, sensible places.

    A camera is above the ground, on the inner side of a wall it looks at, and not close to anything.

    Args:
        surroundings: The scene.
        size: Width and height of the cameras in pixels.
        choose: Takes some of the positions with their targets; to make a camera takes longer than to find its place.
    """
    found: list[Looking] = []
    up, whole = surroundings.up.direction, surroundings.whole
    least = _CLOSEST * whole.radius / math.sin(FOV_Y / 2)
    for target in (whole, *surroundings.targets):
        reach = max(target.radius / math.sin(FOV_Y / 2), least)
        positions = _circle_positions(target, reach, up, 2 * _AZIMUTHS if target is whole else _AZIMUTHS)
        free = surroundings.tree.query(positions)[0]
        for position, room in zip(positions, free):
            away = position - target.center
            distance = float(np.linalg.norm(away))
            behind = target.normal is not None and away @ target.normal < 0.1 * distance
            under = position @ up < surroundings.ground + 0.05 * surroundings.height
            if not (behind or under or room < _CLEARANCE * distance):
                found.append((position, target))
    return [
        (look_at(position, target.center, up, *size, FOV_Y), target) for position, target in choose(found)
    ]


def above(whole: Target, up: Points, size: tuple[int, int]) -> list[Camera]:
    """Cameras on a circle above the whole scene, wherever that is."""
    reach = whole.radius / math.sin(FOV_Y / 2)
    positions = _circle_positions(whole, reach, up, 2 * _AZIMUTHS)[2 * _AZIMUTHS : 4 * _AZIMUTHS : 2]
    return [look_at(position, whole.center, up, *size, FOV_Y) for position in positions]


def _circle_positions(target: Target, reach: float, up: Points, azimuths: int) -> list[Points]:
    first, second, up = upright_frame(up)
    positions = []
    for ring, (distance, elevation) in enumerate((d, e) for d in _DISTANCES for e in _ELEVATIONS):
        for number in range(azimuths):
            angle = 2 * math.pi * (number + 0.5 * (ring % 2)) / azimuths
            level, rise = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
            direction = level * (math.cos(angle) * first + math.sin(angle) * second) + rise * up
            positions.append(target.center + distance * reach * direction)
    return positions


def inside(surroundings: Surroundings, size: tuple[int, int]) -> list[Camera]:
    """Cameras at eye height at free places within the scene that look all around, `TURNS` at each."""
    return [camera for place in free_places(surroundings) for camera in all_around(place, surroundings, size)]


def free_places(surroundings: Surroundings, level: float = _EYE) -> list[Points]:
    """Places within the scene that are not close to anything, far from each other.

    They are in columns that are free from a floor to a ceiling, or to the height of the scene: there may be several
    above each other.

    Args:
        surroundings: The scene.
        level: Height of the places, relative to the free height.
    """
    height = surroundings.height
    if height <= 0:
        return []
    places, rooms = _free_spans(surroundings, level)
    distances = surroundings.tree.query(places)[0] if len(places) else np.zeros(0)
    for clearance in _CLEARANCE_INSIDE:
        free = np.flatnonzero(distances >= clearance * rooms)
        if len(free):
            return _spread(places[free], distances[free], rooms[free])
    return []


def _free_spans(surroundings: Surroundings, level: float) -> tuple[Points, Points]:
    """Places at a level of every free span of the columns ``[M, 3]``, and the heights of these spans ``[M]``."""
    box, up, height = surroundings.box, surroundings.up.direction, surroundings.height
    cells = np.clip(np.ceil(2 * box.half_sizes[:2] / (_COLUMN * height)), *_GRID).astype(int)
    first, second = (
        np.outer((2 * np.arange(count) + 1) / count - 1, half * axis)
        for count, half, axis in zip(cells, box.half_sizes, box.axes)
    )
    columns = (box.center + first[:, None] + second[None]).reshape(-1, 3)
    columns += np.outer(surroundings.ground - columns @ up, up)
    heights = (np.arange(_STEPS) + 0.5) / _STEPS * height
    apart = surroundings.tree.query(columns[:, None] + heights[:, None] * up)[0]
    free = np.pad(apart > _WALL * height, ((0, 0), (1, 1)))
    starts, ends = (np.argwhere(free[:, 1:] & ~free[:, :-1]), np.argwhere(~free[:, 1:] & free[:, :-1]))
    low, high = starts[:, 1] / _STEPS * height, ends[:, 1] / _STEPS * height
    low, high = np.maximum(low - _WALL * height, 0), np.minimum(high + _WALL * height, height)
    kept = high - low >= _STOREY * height
    places = columns[starts[:, 0]] + np.outer(low + level * (high - low), up)
    return places[kept], (high - low)[kept]


def _spread(places: Points, distances: Points, rooms: Points) -> list[Points]:
    """Places far from each other: the freest one first, then repeatedly the one farthest from those taken."""
    chosen = [int(distances.argmax())]
    nearest = np.full(len(places), np.inf)
    while len(chosen) < _MOST_PLACES:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
        farthest = int((nearest / rooms).argmax())
        if nearest[farthest] < _APART * rooms[farthest]:
            break
        chosen.append(farthest)
    return list(places[chosen])


def all_around(place: Points, surroundings: Surroundings, size: tuple[int, int]) -> list[Camera]:
    """`TURNS` cameras at a place that look all around, slightly down and at the floor."""
    first, second, up = upright_frame(surroundings.up.direction)
    cameras = []
    for slope, count in _TILTS:
        for angle in np.arange(count) * (2 * math.pi / count):
            ahead = math.cos(angle) * first + math.sin(angle) * second + slope * up
            cameras.append(look_at(place, place + ahead, up, *size, FOV_Y))
    return cameras
