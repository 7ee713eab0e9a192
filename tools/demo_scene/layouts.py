"""The layouts of the two demo scenes and of a scene of parts: objects, camera paths and prompts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Placement:
    """One object: kind, color, position on the table, rotation in radians, scale."""

    kind: str
    color: str
    x: float
    y: float
    turn: float = 0.0
    scale: float = 1.0
    z: float = 0.0


@dataclass(frozen=True)
class CameraPath:
    """A continuous camera path: sweeps from side to side in front of the table, each at its own height.

    Args:
        sweeps: Elevation in degrees at the (start, end) of each sweep.
        half_arc: Azimuth to either side of the table's front, degrees.
        distance: Mean distance from the target, scene units.
        distance_swing: How far the distance moves about its mean.
        target: Mean point looked at.
        target_swing: How far that point moves along x, against the camera.
    """

    sweeps: tuple[tuple[float, float], ...]
    half_arc: float
    distance: float
    distance_swing: float
    target: tuple[float, float, float]
    target_swing: float

    def poses(self, count: int) -> list[NDArray[np.float64]]:
        """``count`` camera-to-world matrices ``[4, 4]``, OpenGL axes (x right, y up, looking along -z)."""
        poses = []
        for step in range(count):
            position = (step + 0.5) / count * len(self.sweeps)
            sweep = min(int(position), len(self.sweeps) - 1)
            along = position - sweep
            sideways = (2 * along - 1) * (-1 if sweep % 2 else 1)
            start, end = self.sweeps[sweep]
            azimuth = math.radians(self.half_arc * sideways)
            elevation = math.radians(start + (end - start) * along)
            distance = self.distance + self.distance_swing * math.sin(2.3 * math.pi * position)
            target = np.array(self.target)
            target[0] -= self.target_swing * sideways
            outward = np.array(
                [
                    math.cos(elevation) * math.sin(azimuth),
                    -math.cos(elevation) * math.cos(azimuth),
                    math.sin(elevation),
                ]
            )
            poses.append(look_from(target + distance * outward, target))
        return poses


def look_from(position: NDArray, target: NDArray) -> NDArray[np.float64]:
    """Camera to world ``[4, 4]`` (OpenGL axes) of a level camera at ``position`` that looks at ``target``."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, position], 1)
    return pose


@dataclass(frozen=True)
class Prompt:
    """A prompt of the scene.

    Args:
        kind: What the words name: name, color (with a name), material, attribute or part.
        selects: The objects that match, by kind; "KIND.PART" for a part alone.
    """

    kind: str
    selects: tuple[str, ...]


@dataclass(frozen=True)
class Layout:
    """A whole scene. Angles of the light in radians, field of view (horizontal) in degrees."""

    seed: int
    width: int
    height: int
    views: int
    test_every: int
    field_of_view: float
    path: CameraPath
    placements: tuple[Placement, ...]
    cloth: tuple[str, float, float, float]
    """Color, x, y, turn."""
    wall: tuple[str, str]
    """Color and surface."""
    key_light: tuple[float, float, float]
    """Azimuth, watts, size."""
    fill_watts: float
    sky: float
    prompts: dict[str, Prompt]

    def names(self) -> list[str]:
        return [f"view_{number:03d}" for number in range(self.views)]

    def test_names(self) -> list[str]:
        """Every ``test_every``-th view, never the first or last: each lies between training views of the path."""
        return self.names()[self.test_every // 2 :: self.test_every]


TABLETOP = Layout(
    seed=6,
    width=480,
    height=360,
    views=72,
    test_every=6,
    field_of_view=44,
    path=CameraPath(
        sweeps=((17, 24), (31, 37), (46, 40)),
        half_arc=40,
        distance=5.0,
        distance_swing=0.45,
        target=(0, 0.05, 0.22),
        target_swing=0.15,
    ),
    placements=(
        Placement("apple", "red", -0.55, -0.75, 0.4, z=0.03),
        Placement("duck", "yellow", 0.35, -0.8, -1.0, z=0.03),
        Placement("mug", "blue", -0.15, -0.1, -0.6, z=0.03),
        Placement("books", "green", 1.25, 0.2, 0.4, 1.1),
        Placement("vase", "white", -1.1, 0.45, 0.0, 1.15),
        Placement("ring", "gold", 1.0, -0.8, 0.0, 0.8),
        Placement("cone", "orange", -1.55, -0.5, 0.3, 0.95),
        Placement("plant", "green", 0.2, 0.95, 0.0, 1.15),
        Placement("lamp", "yellow", 1.5, 0.95, 0.0, 1.1),
        Placement("banana", "yellow", -0.55, -1.25, 0.5),
        Placement("teddy", "brown", -0.6, 0.75, -1.3, 1.15),
        Placement("pumpkin", "orange", 0.65, 0.1, 0.0, 0.95),
        Placement("car", "red", 1.55, -0.5, -2.4),
        Placement("bottle", "green", -1.6, 0.9, 0.0, 1.1),
    ),
    cloth=("red", -0.2, -0.4, 0.25),
    wall=("red", "brick"),
    key_light=(-2.2, 520, 2.0),
    fill_watts=110,
    sky=0.3,
    prompts={
        "red apple": Prompt("color", ("apple",)),
        "blue mug": Prompt("color", ("mug",)),
        "white vase": Prompt("color", ("vase",)),
        "gold ring": Prompt("color", ("ring",)),
        "brown teddy bear": Prompt("color", ("teddy",)),
        "green bottle": Prompt("color", ("bottle",)),
        "rubber duck": Prompt("name", ("duck",)),
        "stack of books": Prompt("name", ("books",)),
        "traffic cone": Prompt("name", ("cone",)),
        "potted plant": Prompt("name", ("plant",)),
        "table lamp": Prompt("name", ("lamp",)),
        "banana": Prompt("name", ("banana",)),
        "pumpkin": Prompt("name", ("pumpkin",)),
        "toy car": Prompt("name", ("car",)),
        "wooden table": Prompt("material", ("table",)),
        "brick wall": Prompt("material", ("wall",)),
        "something made of metal": Prompt("material", ("ring",)),
        "checkered cloth": Prompt("attribute", ("cloth",)),
        "fruit": Prompt("attribute", ("apple", "banana")),
        "something to drink from": Prompt("attribute", ("mug",)),
        "mug handle": Prompt("part", ("mug.handle",)),
        "bear nose": Prompt("part", ("teddy.nose",)),
    },
)

SECOND = Layout(
    seed=11,
    width=320,
    height=240,
    views=30,
    test_every=5,
    field_of_view=46,
    path=CameraPath(
        sweeps=((22, 28), (40, 34)),
        half_arc=40,
        distance=4.2,
        distance_swing=0.3,
        target=(0, 0.0, 0.2),
        target_swing=0.1,
    ),
    placements=(
        Placement("crate", "brown", -1.15, 0.5, 0.35, 1.2),
        Placement("teddy", "white", 0.85, 0.7, -1.9, 1.1),
        Placement("ball", "pink", -0.2, 0.65, 0.6, 1.15),
        Placement("bowl", "green", 0.15, -0.2, 0.0, 1.1, z=0.03),
        Placement("mug", "red", -0.75, -0.3, -0.3, z=0.03),
        Placement("candle", "purple", 1.3, 0.1, 0.0, 1.1),
        Placement("car", "blue", 0.85, -0.75, -2.6, 1.0),
        Placement("apple", "green", 0.0, -1.0, 0.0),
        Placement("ring", "silver", -1.1, -0.85, 0.0, 0.85),
    ),
    cloth=("blue", -0.15, -0.15, -0.2),
    wall=("white", "plain"),
    key_light=(-0.9, 480, 2.0),
    fill_watts=110,
    sky=0.3,
    prompts={
        "green apple": Prompt("color", ("apple",)),
        "red mug": Prompt("color", ("mug",)),
        "green bowl": Prompt("color", ("bowl",)),
        "silver ring": Prompt("color", ("ring",)),
        "blue toy car": Prompt("color", ("car",)),
        "purple candle": Prompt("color", ("candle",)),
        "teddy bear": Prompt("name", ("teddy",)),
        "striped ball": Prompt("name", ("ball",)),
        "wooden crate": Prompt("name", ("crate",)),
        "wall": Prompt("name", ("wall",)),
        "table": Prompt("name", ("table",)),
        "something made of metal": Prompt("material", ("ring", "candle.saucer")),
        "checkered cloth": Prompt("attribute", ("cloth",)),
        "fruit": Prompt("attribute", ("apple",)),
        "something to drink from": Prompt("attribute", ("mug",)),
        "mug handle": Prompt("part", ("mug.handle",)),
        "bear nose": Prompt("part", ("teddy.nose",)),
    },
)

PARTS = Layout(
    seed=23,
    width=320,
    height=240,
    views=30,
    test_every=5,
    field_of_view=46,
    path=CameraPath(
        sweeps=((20, 27), (38, 33)),
        half_arc=40,
        distance=4.3,
        distance_swing=0.3,
        target=(0, 0.0, 0.25),
        target_swing=0.1,
    ),
    placements=(
        Placement("plant", "green", -1.15, 0.65, 0.3, 1.05),
        Placement("lamp", "yellow", 1.2, 0.75, 0.0, 1.0),
        Placement("teddy", "pink", 0.1, 0.6, -1.5, 1.15),
        Placement("mug", "green", 0.75, -0.15, -0.9, 1.0),
        Placement("duck", "blue", -0.6, -0.05, -1.2, 1.0),
        Placement("car", "yellow", -1.1, -0.65, -0.7, 1.0),
        Placement("bottle", "brown", -0.55, 0.85, 0.0, 1.05),
        Placement("pumpkin", "orange", 0.2, -0.75, 0.5, 0.9),
        Placement("candle", "white", 1.25, -0.55, 0.0, 1.05),
    ),
    cloth=("green", 0.1, -0.2, 0.35),
    wall=("blue", "plain"),
    key_light=(-1.5, 500, 2.0),
    fill_watts=110,
    sky=0.3,
    prompts={
        "mug handle": Prompt("part", ("mug.handle",)),
        "bear nose": Prompt("part", ("teddy.nose",)),
        "bear ears": Prompt("part", ("teddy.ears",)),
        "bear belly": Prompt("part", ("teddy.belly",)),
        "duck beak": Prompt("part", ("duck.beak",)),
        "plant pot": Prompt("part", ("plant.pot",)),
        "lamp shade": Prompt("part", ("lamp.shade",)),
        "lamp stand": Prompt("part", ("lamp.stand",)),
        "bottle cork": Prompt("part", ("bottle.cork",)),
        "pumpkin stalk": Prompt("part", ("pumpkin.stalk",)),
        "car wheels": Prompt("part", ("car.wheels",)),
        "candle flame": Prompt("part", ("candle.flame",)),
        "candle saucer": Prompt("part", ("candle.saucer",)),
        "green mug": Prompt("color", ("mug",)),
        "rubber duck": Prompt("name", ("duck",)),
        "teddy bear": Prompt("name", ("teddy",)),
        "toy car": Prompt("name", ("car",)),
        "table lamp": Prompt("name", ("lamp",)),
    },
)
"""Not bundled: questions for parts of things."""

LAYOUTS = {"tabletop": TABLETOP, "second": SECOND, "parts": PARTS}
BUNDLED = ("tabletop", "second")
