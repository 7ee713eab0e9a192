"""Random table tops for training: any kind in any color, any surface, light and camera. Needs Blender."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

# The recipes of the things are those of the demo scenes; make.py puts their folder on the path.
from layouts import look_from
from materials import COLORS, METALS, material, scaled, varied
from numpy.typing import NDArray
from shapes import box, draped_sheet, joined
from surroundings import light_room, make_table
from things import KINDS, Thing, make
from vocabulary import HELD_OUT_PAIRS

TOP = (1.75, 1.3)
"""Half extents of the table's free area, scene units."""


@dataclass
class RandomScene:
    """The objects of a random scene, and its views."""

    things: list[Thing]
    poses: list[NDArray[np.float64]]
    field_of_view: float
    exposure: float
    finishes: dict[int, str] = field(default_factory=dict)
    """Of surfaces: number of the thing to wood, brick, plain, checkered, striped, tiled or painted."""


def random_scene(rng: np.random.Generator, views: int, *, held_out: bool) -> RandomScene:
    """Fill the empty Blender file.

    Args:
        rng: Decides everything.
        views: Number of cameras.
        held_out: Whether half of the things are of the pairs that training never sees.
    """
    things: list[Thing] = []
    finishes: dict[int, str] = {}
    spots: list[tuple[float, float, float]] = []
    for _ in range(int(rng.integers(9, 14))):
        kind, color = _pair(rng, held_out)
        scale = float(rng.uniform(0.8, 1.25))
        spot = _free_spot(spots, KINDS[kind].radius * scale, rng)
        if spot is None:
            continue
        spots.append((*spot, KINDS[kind].radius * scale))
        thing = make(kind, color, len(things) + 1, rng)
        lift = 0.03 if rng.random() < 0.7 else float(rng.uniform(0.0, 0.1))
        thing.place(*spot, lift, float(rng.uniform(0, 2 * math.pi)), scale)
        things.append(thing)

    def add(thing: Thing, finish: str) -> None:
        things.append(thing)
        finishes[thing.number] = finish

    add(*_table(len(things) + 1, rng))
    if rng.random() < 0.75:
        add(*_cloth(len(things) + 1, rng))
    add(*_wall(len(things) + 1, rng))
    add(*_floor(len(things) + 1, rng))
    light_room(
        float(rng.uniform(-2.8, -0.3)),
        float(rng.uniform(380, 620)),
        float(rng.uniform(1.0, 3.0)),
        float(rng.uniform(60, 180)),
        float(rng.uniform(0.2, 0.45)),
    )
    poses = [_camera(rng, spots) for _ in range(views)]
    return RandomScene(things, poses, float(rng.uniform(40, 50)), float(rng.uniform(-0.3, 0.35)), finishes)


def _pair(rng: np.random.Generator, held_out: bool) -> tuple[str, str]:
    """A kind and a color: in half of the cases a natural color of the kind, else any."""
    if held_out and rng.random() < 0.5:
        return sorted(HELD_OUT_PAIRS)[int(rng.integers(len(HELD_OUT_PAIRS)))]
    while True:
        kind = str(rng.choice(sorted(KINDS)))
        natural = rng.random() < 0.45
        color = str(rng.choice(KINDS[kind].colors if natural else [*COLORS, *METALS]))
        if (kind, color) not in HELD_OUT_PAIRS:
            return kind, color


def _free_spot(
    taken: list[tuple[float, float, float]], radius: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """A position on the table with little overlap with other objects."""
    for _ in range(40):
        x, y = (float(rng.uniform(-half, half)) for half in TOP)
        if all(math.hypot(x - a, y - b) > 0.85 * (radius + other) for a, b, other in taken):
            return x, y
    return None


def _camera(rng: np.random.Generator, spots: list[tuple[float, float, float]]) -> NDArray[np.float64]:
    """A level camera in front of the table that looks close to one of the objects."""
    x, y, _ = spots[int(rng.integers(len(spots)))]
    pull = rng.uniform(0.3, 1.0)
    target = np.array([x * pull, y * pull, rng.uniform(0.1, 0.45)])
    azimuth, elevation = rng.uniform(-1.0, 1.0), math.radians(rng.uniform(12, 55))
    distance = rng.uniform(2.2, 5.4)
    outward = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            -math.cos(elevation) * math.cos(azimuth),
            math.sin(elevation),
        ]
    )
    return look_from(target + distance * outward, target)


def _table(number: int, rng: np.random.Generator) -> tuple[Thing, str]:
    if rng.random() < 0.6:
        return make_table(number, rng), "wooden"
    table = Thing("table", str(rng.choice([c for c in COLORS if c != "brown"])), number, rng)
    if rng.random() < 0.4:
        # Other woods keep the grain and the name.
        table.color, tone = "brown", varied((0.5, 0.3, 0.14), rng, 0.25)
        top = material(tone, rng, roughness=0.5, pattern="wood", scale=rng.uniform(2, 5), bump=0.1)
    else:
        top = table.paint(vary=0.15, roughness=float(rng.uniform(0.3, 0.8)))
    table.add(box((4.4, 3.2, 0.12), (0, 0, -0.06)), top, smooth=False, bevel=0.02)
    legs = joined([box((0.16, 0.16, 2.0), (x, y, -1.1)) for x in (-2, 2) for y in (-1.4, 1.4)])
    table.add(legs, top, smooth=False)
    return table, "wooden" if table.color == "brown" else "painted"


def _cloth(number: int, rng: np.random.Generator) -> tuple[Thing, str]:
    cloth = Thing("cloth", str(rng.choice([*COLORS])), number, rng)
    style = str(rng.choice(["checkered", "checkered", "plain", "striped"]))
    pattern = {"checkered": "checker", "plain": None, "striped": "stripes"}[style]
    light = (0.74, 0.72, 0.68) if cloth.color != "white" else (0.5, 0.48, 0.45)
    fabric = cloth.paint(
        roughness=0.9, pattern=pattern, second=light, scale=float(rng.uniform(5, 10)), bump=0.15
    )
    if style == "striped":
        style = "plain"  # stripes run along z, which a cloth hardly has: what is seen is one color
    cloth.add(
        draped_sheet(float(rng.uniform(0.8, 1.2)), float(rng.uniform(0.5, 0.8)), rng.uniform(0, 6, 3)), fabric
    )
    cloth.place(*(float(rng.uniform(-half, half)) for half in (0.7, 0.5)), 0.0, float(rng.uniform(-0.5, 0.5)))
    return cloth, style


def _wall(number: int, rng: np.random.Generator) -> tuple[Thing, str]:
    wall = Thing("wall", str(rng.choice([*COLORS])), number, rng)
    if rng.random() < 0.45:
        wall.color = str(rng.choice(["red", "red", "gray", "white", "brown"]))
        tone = {"red": (0.36, 0.1, 0.06)}.get(wall.color, COLORS[wall.color])
        finish, style = (
            material(
                varied(tone, rng),
                rng,
                roughness=0.85,
                pattern="brick",
                second=scaled(tone, float(rng.uniform(0.55, 0.8))),
                scale=rng.uniform(1.5, 2.8),
                bump=0.9,
            ),
            "brick",
        )
    else:
        own = tuple(0.35 * channel + 0.22 for channel in COLORS[wall.color])  # walls are pale
        second = scaled(own, 0.72)
        pattern = "plaster" if rng.random() < 0.6 else None
        finish, style = (
            material(
                varied(own, rng, 0.1), rng, roughness=0.85, pattern=pattern, second=second, scale=9, bump=0.3
            ),
            "plain",
        )
    wall.add(box((24, 0.2, 9), (0, float(rng.uniform(2.2, 3.2)), 1.5)), finish, smooth=False)
    return wall, style


def _floor(number: int, rng: np.random.Generator) -> tuple[Thing, str]:
    floor = Thing("floor", "gray", number, rng)
    tone = varied((0.3, 0.29, 0.28), rng, 0.3)
    pattern = "checker" if rng.random() < 0.7 else "noise"
    tiles = material(
        tone, rng, roughness=0.6, pattern=pattern, second=scaled(tone, 0.66), scale=rng.uniform(1, 2)
    )
    floor.add(box((24, 14, 0.1), (0, -4.3, -2.15)), tiles, smooth=False)
    return floor, "tiled" if pattern == "checker" else "plain"
