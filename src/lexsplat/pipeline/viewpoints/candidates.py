"""Cameras among which views are chosen: around the scene and its parts, and around oneself in a room."""

from __future__ import annotations

import math

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
_CLEARANCE_INSIDE = 0.2
"""The same within a room, relative to its height."""
_CLOSEST = 0.5
"""Least distance, relative to that from which the whole scene fills the image."""
_EYE = 0.6
"""Eye height in a room, relative to its height: 1.5 m of 2.5 m."""
_CELL = 1.0
"""Distance of places within the scene, relative to its height: every room gets some,"""
_GRID = 4
"""and at least as many along either side,"""
_MOST_PLACES = 48
"""but not more in all: they are looked around from, which takes time."""
TURNS = 8
"""Cameras at each place within the scene."""

Points = NDArray[np.float64]


def around(surroundings: Surroundings, size: tuple[int, int]) -> list[tuple[Camera, Target]]:
    """Cameras on circles around the scene and its parts that see their targets from free, sensible places.

    A camera is above the ground, on the inner side of a wall it looks at, and not close to anything.
    """
    found = []
    least = _CLOSEST * surroundings.whole.radius / math.sin(FOV_Y / 2)
    for target in (surroundings.whole, *surroundings.targets):
        reach = max(target.radius / math.sin(FOV_Y / 2), least)
        for position in _circle_positions(target, reach, surroundings):
            away = position - target.center
            distance = float(np.linalg.norm(away))
            behind = target.normal is not None and away @ target.normal < 0.1 * distance
            under = position @ surroundings.up.direction < surroundings.ground + 0.05 * surroundings.height
            close = surroundings.tree.query(position)[0] < _CLEARANCE * distance
            if not (behind or under or close):
                found.append(
                    (look_at(position, target.center, surroundings.up.direction, *size, FOV_Y), target)
                )
    return found


def above(surroundings: Surroundings, size: tuple[int, int]) -> list[Camera]:
    """Cameras on a circle above the whole scene, wherever that is."""
    whole = surroundings.whole
    reach = whole.radius / math.sin(FOV_Y / 2)
    positions = _circle_positions(whole, reach, surroundings)[2 * _AZIMUTHS : 4 * _AZIMUTHS : 2]
    return [
        look_at(position, whole.center, surroundings.up.direction, *size, FOV_Y) for position in positions
    ]


def _circle_positions(target: Target, reach: float, surroundings: Surroundings) -> list[Points]:
    first, second, up = upright_frame(surroundings.up.direction)
    positions = []
    azimuths = 2 * _AZIMUTHS if target is surroundings.whole else _AZIMUTHS
    for ring, (distance, elevation) in enumerate((d, e) for d in _DISTANCES for e in _ELEVATIONS):
        for number in range(azimuths):
            angle = 2 * math.pi * (number + 0.5 * (ring % 2)) / azimuths
            level, rise = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
            direction = level * (math.cos(angle) * first + math.sin(angle) * second) + rise * up
            positions.append(target.center + distance * reach * direction)
    return positions


def inside(surroundings: Surroundings, size: tuple[int, int]) -> list[Camera]:
    """Cameras at eye height on a grid of free places within the scene that look all around, `TURNS` at each."""
    return [camera for place in free_places(surroundings) for camera in all_around(place, surroundings, size)]


def free_places(surroundings: Surroundings, level: float = _EYE) -> list[Points]:
    """Places within the scene that are not close to anything, on a grid along the sides of its box.

    Args:
        surroundings: The scene.
        level: Height of the places, relative to that of the scene.
    """
    box, up, height = surroundings.box, surroundings.up.direction, surroundings.height
    cells = np.maximum(np.ceil(2 * box.half_sizes[:2] / max(_CELL * height, 1e-12)), _GRID)
    cells = np.minimum(cells, _MOST_PLACES).astype(int)
    while cells.prod() > _MOST_PLACES:
        cells = np.maximum(cells * 9 // 10, _GRID)
    first, second = (
        np.outer((2 * np.arange(count) + 1) / count - 1, half * axis)
        for count, half, axis in zip(cells, box.half_sizes, box.axes)
    )
    places = (box.center + first[:, None] + second[None]).reshape(-1, 3)
    places += np.outer(surroundings.ground + level * height - places @ up, up)
    return list(places[surroundings.tree.query(places)[0] >= _CLEARANCE_INSIDE * height])


def all_around(place: Points, surroundings: Surroundings, size: tuple[int, int]) -> list[Camera]:
    """`TURNS` cameras at a place that look all around, slightly down."""
    first, second, up = upright_frame(surroundings.up.direction)
    cameras = []
    for angle in np.arange(TURNS) * (2 * math.pi / TURNS):
        ahead = math.cos(angle) * first + math.sin(angle) * second - 0.2 * up
        cameras.append(look_at(place, place + ahead, up, *size, FOV_Y))
    return cameras
