"""The 18 kinds of objects: each is a function that builds one from meshes and materials. Needs Blender.

Every mesh has an object index, which the renderer writes per pixel: ``10 * number`` for the body of object
``number`` and ``10 * number + part`` for its named parts. The object of a pixel is ``index // 10``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import bpy
import numpy as np
from materials import COLORS, Color, color_of, material, scaled, varied
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray
from shapes import (
    TINY,
    Mesh,
    box,
    ellipsoid,
    joined,
    lathe,
    leaf,
    smooth_profile,
    torus,
    tube,
)

MAX_PARTS = 9


@dataclass
class Thing:
    """An object: its meshes, and the numbers of its named parts."""

    kind: str
    color: str
    number: int
    rng: np.random.Generator
    parts: dict[str, int] = field(default_factory=dict)
    objects: list[Any] = field(default_factory=list)

    def paint(self, color: Color | None = None, *, vary: float = 0.07, **finish: Any) -> Any:
        """A material in the color of the object, or in ``color`` exactly."""
        if color is None:
            color = varied(color_of(self.color), self.rng, vary)
        return material(color, self.rng, **finish)

    def add(
        self,
        mesh: Mesh,
        finish: Any,
        *,
        part: str | None = None,
        smooth: bool = True,
        bevel: float = 0.0,
    ) -> None:
        """Add a mesh; ``part`` gives it its own index under this name, ``bevel`` rounds its edges."""
        if part is not None and part not in self.parts:
            if len(self.parts) == MAX_PARTS:
                raise ValueError(f"{self.kind} has more than {MAX_PARTS} parts")
            self.parts[part] = len(self.parts) + 1
        data = bpy.data.meshes.new(self.kind)
        data.from_pydata(mesh.vertices.tolist(), [], mesh.faces)
        data.polygons.foreach_set("use_smooth", [smooth] * len(data.polygons))
        data.materials.append(finish)
        data.update()
        blender_object = bpy.data.objects.new(f"{self.kind} {part or ''}", data)
        blender_object.pass_index = 10 * self.number + (self.parts[part] if part else 0)
        bpy.context.scene.collection.objects.link(blender_object)
        if bevel:
            modifier = blender_object.modifiers.new("bevel", "BEVEL")
            modifier.width, modifier.segments = bevel, 2
        self.objects.append(blender_object)

    def place(self, x: float, y: float, z: float = 0.0, rotation: float = 0.0, scale: float = 1.0) -> None:
        """Move the object to (x, y, z), rotated about the vertical by ``rotation`` radians."""
        pose = Matrix.Translation((x, y, z)) @ Matrix.Rotation(rotation, 4, "Z") @ Matrix.Scale(scale, 4)
        for blender_object in self.objects:
            blender_object.matrix_world = pose


def open_vessel(outside: ArrayLike, thickness: float, lift: float) -> NDArray[np.float64]:
    """The profile ``[n, 2]`` of a vessel, outside and inside."""
    outside = np.asarray(outside, float)
    inside = np.maximum(outside - [thickness, 0], [TINY, -np.inf]) + np.array([0, lift])
    return np.concatenate([outside, inside[::-1]])


def apple(thing: Thing) -> None:
    profile = smooth_profile(
        [(0, 0.05), (0.1, 0), (0.24, 0.12), (0.3, 0.32), (0.22, 0.47), (0.08, 0.49), (0, 0.42)]
    )
    mottle = tuple(0.6 * channel + 0.06 for channel in color_of(thing.color))
    skin = thing.paint(roughness=0.35, pattern="noise", second=mottle, scale=6, coat=0.25)
    thing.add(lathe(profile), skin)
    stalk = tube([(0, 0, 0.42), (0.02, 0, 0.5), (0.05, 0, 0.57)], [0.014, 0.012, 0.016], 8)
    thing.add(stalk, thing.paint(COLORS["brown"], roughness=0.7), part="stalk")


def duck(thing: Thing) -> None:
    rubber = thing.paint(roughness=0.4, coat=0.15)
    thing.add(ellipsoid((0, 0, 0.2), (0.32, 0.24, 0.2)), rubber)
    thing.add(ellipsoid((0.2, 0, 0.5), (0.17, 0.16, 0.17)), rubber)
    thing.add(ellipsoid((-0.3, 0, 0.34), (0.15, 0.1, 0.06)), rubber)
    eye = thing.paint(COLORS["black"], roughness=0.1)
    for side in (-1, 1):
        thing.add(ellipsoid((-0.02, side * 0.21, 0.24), (0.18, 0.06, 0.1)), rubber)
        thing.add(ellipsoid((0.33, side * 0.08, 0.56), (0.025, 0.025, 0.03)), eye)
    beak = COLORS["red" if thing.color == "orange" else "orange"]
    thing.add(ellipsoid((0.38, 0, 0.47), (0.1, 0.08, 0.03)), thing.paint(beak, roughness=0.35), part="beak")


def mug(thing: Thing) -> None:
    radius, height = 0.2, 0.44
    wall = [
        (TINY, 0),
        (radius * 0.96, 0),
        (radius, 0.02),
        (radius, height - 0.01),
        (radius - 0.01, height),
        (radius - 0.025, height - 0.01),
        (radius - 0.025, 0.04),
        (TINY, 0.035),
    ]
    glaze = thing.paint(roughness=0.22, coat=0.35)
    thing.add(lathe(wall), glaze)
    handle = torus(0.12, 0.028, 24, 12, arc=np.pi).turned_about_x(np.pi / 2).moved((radius, 0, height / 2))
    thing.add(handle, glaze, part="handle")
    coffee = lathe([(TINY, height * 0.8), (radius - 0.025, height * 0.8)])
    thing.add(coffee, thing.paint((0.05, 0.02, 0.008), roughness=0.1))


def books(thing: Thing) -> None:
    rng, bottom = thing.rng, 0.0
    others = rng.choice([name for name in COLORS if name != thing.color], 3, replace=False)
    for name in [thing.color, *others][: rng.integers(2, 5)]:
        thickness, width, depth = rng.uniform(0.08, 0.13), rng.uniform(0.55, 0.7), rng.uniform(0.4, 0.48)
        turn = rng.uniform(-0.25, 0.25)
        cover = thing.paint(varied(color_of(str(name)), rng), roughness=0.5, bump=0.1)
        boards = [box((width, depth, 0.016), (0, 0, bottom + z)) for z in (0.008, thickness - 0.008)]
        spine = box((0.016, depth, thickness), (-width / 2, 0, bottom + thickness / 2))
        thing.add(joined([*boards, spine]).turned_about_z(turn), cover, smooth=False)
        block = box((width - 0.03, depth - 0.03, thickness - 0.03), (0, 0, bottom + thickness / 2))
        paper = thing.paint(
            (0.75, 0.7, 0.58), roughness=0.8, pattern="stripes", second=(0.6, 0.55, 0.42), scale=30
        )
        thing.add(block.turned_about_z(turn), paper, smooth=False)
        bottom += thickness


def vase(thing: Thing) -> None:
    outside = smooth_profile(
        [(0.12, 0), (0.16, 0.03), (0.24, 0.25), (0.2, 0.45), (0.09, 0.6), (0.08, 0.68), (0.13, 0.76)]
    )
    profile = np.concatenate([open_vessel(outside, 0.02, 0.0), [(TINY, 0.03)]])
    thing.add(lathe(profile), thing.paint(roughness=0.25, coat=0.35))


def ring(thing: Thing) -> None:
    metal = thing.paint(vary=0.0, roughness=0.28, metallic=1)
    thing.add(torus(0.24, 0.07).moved((0, 0, 0.07)), metal)


def cone(thing: Thing) -> None:
    own, white = thing.paint(roughness=0.4), thing.paint(COLORS["white"], roughness=0.4)
    foot, tip, height, base = 0.2, 0.04, 0.62, 0.04

    def point(z: float) -> tuple[float, float]:
        return foot + (tip - foot) * z / height, z + base

    heights = [0, 0.2, 0.33, 0.45, 0.53, height]
    for band, (low, high) in enumerate(pairwise(heights)):
        thing.add(lathe([point(low), point(high)]), white if band % 2 else own)
    thing.add(lathe([point(height), (TINY, height + base + 0.005)]), own)
    thing.add(box((0.5, 0.5, 0.05), (0, 0, 0.025)), own, smooth=False, bevel=0.015)


def plant(thing: Thing) -> None:
    rng = thing.rng
    pot = [
        (TINY, 0),
        (0.15, 0),
        (0.21, 0.3),
        (0.24, 0.3),
        (0.24, 0.37),
        (0.2, 0.37),
        (0.19, 0.33),
        (TINY, 0.33),
    ]
    thing.add(lathe(pot), thing.paint(varied((0.5, 0.17, 0.07), rng), roughness=0.8, bump=0.2), part="pot")
    soil = lathe([(TINY, 0.335), (0.2, 0.335)])
    thing.add(soil, thing.paint((0.05, 0.03, 0.02), roughness=0.95, bump=0.8))
    blades = []
    for _ in range(rng.integers(28, 45)):
        azimuth = rng.uniform(0, 2 * np.pi)
        base = (0.05 * np.cos(azimuth), 0.05 * np.sin(azimuth), 0.33)
        blades.append(
            leaf(base, azimuth, rng.uniform(0.35, 1.4), rng.uniform(0.3, 0.6), rng.uniform(0.05, 0.09))
        )
    own = (0.06, 0.28, 0.04) if thing.color == "green" else color_of(thing.color)
    foliage = thing.paint(
        varied(own, rng, 0.3), roughness=0.4, pattern="noise", second=scaled(own, 0.5), scale=8
    )
    thing.add(joined(blades), foliage, part="leaves")


def lamp(thing: Thing) -> None:
    stand = smooth_profile([(TINY, 0), (0.18, 0), (0.17, 0.04), (0.05, 0.07), (0.025, 0.12), (0.025, 0.7)])
    thing.add(lathe(stand), thing.paint((0.3, 0.2, 0.08), roughness=0.45), part="stand")
    own = (0.95, 0.78, 0.52) if thing.color == "yellow" else color_of(thing.color)
    shade = thing.paint(varied(own, thing.rng, 0.05), roughness=0.8, emission=0.9)
    thing.add(lathe([(0.3, 0.6), (0.16, 1.0)]), shade, part="shade")
    thing.add(ellipsoid((0, 0, 0.75), (0.06, 0.06, 0.08)), thing.paint((1, 0.8, 0.5), emission=12))


def banana(thing: Thing) -> None:
    angle = np.linspace(-0.9, 0.9, 22)
    path = np.stack([0.42 * np.sin(angle), 0 * angle, 0.5 - 0.42 * np.cos(angle)], 1)
    radii = 0.085 * np.clip(np.sin(np.linspace(0.12, 3.02, 22)), 0.1, 1) ** 0.55
    own = color_of(thing.color)
    thing.add(
        tube(path, radii, 9), thing.paint(roughness=0.45, pattern="noise", second=scaled(own, 0.7), scale=7)
    )
    end = path[-1]
    stalk = tube(end + np.array([(0, 0, 0), (0.03, 0, 0.05), (0.04, 0, 0.1)]), [0.03, 0.022, 0.025], 8)
    thing.add(stalk, thing.paint((0.16, 0.1, 0.02), roughness=0.7), part="stalk")


def teddy(thing: Thing) -> None:
    fur = thing.paint(roughness=0.95, pattern="noise", scale=25, bump=1.0)
    light = thing.paint((0.6, 0.42, 0.25), roughness=0.95, bump=0.8)
    black = thing.paint(COLORS["black"], roughness=0.2)

    def blob(center: ArrayLike, radii: ArrayLike, finish: Any = fur, part: str | None = None) -> None:
        thing.add(ellipsoid(center, radii), finish, part=part)

    blob((0, 0, 0.27), (0.24, 0.26, 0.28))
    blob((0.03, 0, 0.67), 0.22)
    blob((0.2, 0, 0.62), (0.1, 0.11, 0.09), light)
    blob((0.29, 0, 0.65), (0.035, 0.05, 0.038), black, part="nose")
    blob((0.14, 0, 0.27), (0.14, 0.17, 0.18), light, part="belly")
    for side in (-1, 1):
        blob((0, side * 0.18, 0.85), (0.05, 0.09, 0.09), part="ears")
        blob((0.04, side * 0.27, 0.38), (0.1, 0.1, 0.17))
        blob((0.22, side * 0.17, 0.1), (0.2, 0.1, 0.1))
        blob((0.42, side * 0.17, 0.11), (0.03, 0.07, 0.07), light)
        blob((0.22, side * 0.08, 0.74), 0.028, black)


def ball(thing: Thing) -> None:
    second = color_of(
        str(thing.rng.choice([c for c in ("white", "blue", "yellow", "red") if c != thing.color]))
    )
    scale = thing.rng.uniform(1.6, 2.6)
    rubber = thing.paint(roughness=0.35, pattern="stripes", second=second, scale=scale, coat=0.2)
    thing.add(ellipsoid((0, 0, 0.25), 0.25, 28, 44), rubber)


def bowl(thing: Thing) -> None:
    outside = smooth_profile([(TINY, 0), (0.12, 0), (0.14, 0.03), (0.27, 0.12), (0.33, 0.24)], 20)
    thing.add(lathe(open_vessel(outside, 0.02, 0.012)), thing.paint(roughness=0.25, coat=0.3))


def candle(thing: Thing) -> None:
    wax = [(TINY, 0), (0.1, 0), (0.1, 0.45), (0.085, 0.46), (TINY, 0.44)]
    thing.add(lathe(wax), thing.paint(roughness=0.5, subsurface=0.5))
    thing.add(
        tube([(0, 0, 0.44), (0.005, 0, 0.5)], [0.008, 0.006], 6), thing.paint(COLORS["black"], roughness=0.9)
    )
    flame = smooth_profile([(TINY, 0.49), (0.025, 0.52), (0.018, 0.57), (TINY, 0.63)], 12)
    thing.add(lathe(flame, 12), thing.paint((1, 0.55, 0.12), emission=8), part="flame")
    saucer = [(TINY, 0), (0.2, 0), (0.21, 0.03), (0.19, 0.025), (TINY, 0.012)]
    thing.add(lathe(saucer), thing.paint((0.6, 0.6, 0.62), roughness=0.3, metallic=1), part="saucer")


def bottle(thing: Thing) -> None:
    profile = smooth_profile(
        [(TINY, 0), (0.13, 0), (0.145, 0.04), (0.145, 0.45), (0.06, 0.62), (0.05, 0.8)], 36
    )
    tint = tuple(channel**0.5 for channel in color_of(thing.color))
    thing.add(lathe(profile), thing.paint(tint, roughness=0.08, transmission=0.75))
    cork = lathe([(0.055, 0.76), (0.055, 0.86), (TINY, 0.86)])
    thing.add(cork, thing.paint((0.5, 0.3, 0.15), roughness=0.8), part="cork")


def pumpkin(thing: Thing) -> None:
    profile = smooth_profile(
        [(0, 0.06), (0.15, 0.01), (0.3, 0.15), (0.32, 0.28), (0.2, 0.42), (0.05, 0.41), (0, 0.38)]
    )
    skin = thing.paint(roughness=0.5, bump=0.1, pattern="noise", second=scaled(color_of(thing.color), 0.8))
    thing.add(lathe(profile, 90, ribs=9, rib_depth=0.14), skin)
    stalk = tube([(0, 0, 0.37), (0.01, 0, 0.45), (0.06, 0, 0.52)], [0.05, 0.03, 0.035], 8)
    thing.add(stalk, thing.paint((0.14, 0.18, 0.05), roughness=0.8), part="stalk")


def car(thing: Thing) -> None:
    lacquer = thing.paint(roughness=0.25, metallic=0.1, coat=0.5)
    glass = thing.paint((0.02, 0.03, 0.04), roughness=0.15)
    tyre, hub = thing.paint(COLORS["black"], roughness=0.8), thing.paint((0.6, 0.6, 0.6), roughness=0.4)
    lens = thing.paint((0.9, 0.9, 0.7), roughness=0.2)
    thing.add(box((0.7, 0.34, 0.15), (0, 0, 0.17)), lacquer, smooth=False, bevel=0.04)
    cabin = box((0.4, 0.3, 0.16), (-0.03, 0, 0.31)).tapered_above(0.3, (0.75, 0.88, 1))
    thing.add(cabin, lacquer, smooth=False, bevel=0.03)
    side_panes = box((0.33, 0.305, 0.09), (-0.03, 0, 0.32)).tapered_above(0.3, (0.85, 0.9, 1))
    front_panes = box((0.41, 0.22, 0.085), (-0.03, 0, 0.315)).tapered_above(0.3, (0.8, 0.9, 1))
    thing.add(joined([side_panes, front_panes]), glass, smooth=False)
    for side in (-1, 1):
        for x in (-0.22, 0.22):
            wheel = torus(0.06, 0.035, 20, 10).turned_about_x(np.pi / 2).moved((x, side * 0.16, 0.095))
            thing.add(wheel, tyre, part="wheels")
            cap = ellipsoid((0, 0, 0), (0.05, 0.05, 0.02)).turned_about_x(np.pi / 2)
            thing.add(cap.moved((x, side * 0.165, 0.095)), hub, part="wheels")
        thing.add(ellipsoid((0.345, side * 0.11, 0.19), (0.02, 0.04, 0.03)), lens)


def crate(thing: Thing) -> None:
    own = (0.42, 0.24, 0.1) if thing.color == "brown" else color_of(thing.color)
    wood = thing.paint(varied(own, thing.rng), roughness=0.6, pattern="wood", scale=5, bump=0.2)
    for z in (0.07, 0.21, 0.35):
        for side in (-1, 1):
            thing.add(box((0.6, 0.03, 0.11), (0, side * 0.22, z)), wood, smooth=False, bevel=0.006)
            thing.add(box((0.03, 0.42, 0.11), (side * 0.29, 0, z)), wood, smooth=False, bevel=0.006)
    thing.add(box((0.56, 0.42, 0.02), (0, 0, 0.02)), wood, smooth=False)
    posts = [box((0.04, 0.04, 0.42), (x * 0.26, y * 0.19, 0.21)) for x in (-1, 1) for y in (-1, 1)]
    thing.add(joined(posts), wood, smooth=False)


@dataclass(frozen=True)
class Kind:
    """A builder, the natural colors of the kind, and the radius of its footprint."""

    build: Callable[[Thing], None]
    colors: tuple[str, ...]
    radius: float


KINDS: dict[str, Kind] = {
    "apple": Kind(apple, ("red", "green", "yellow"), 0.3),
    "duck": Kind(duck, ("yellow", "pink", "blue"), 0.42),
    "mug": Kind(mug, ("blue", "white", "red", "green", "black"), 0.34),
    "books": Kind(books, ("red", "blue", "green", "brown"), 0.42),
    "vase": Kind(vase, ("white", "blue", "green", "purple"), 0.26),
    "ring": Kind(ring, ("gold", "silver", "copper"), 0.32),
    "cone": Kind(cone, ("orange", "red", "blue"), 0.36),
    "plant": Kind(plant, ("green",), 0.45),
    "lamp": Kind(lamp, ("yellow",), 0.32),
    "banana": Kind(banana, ("yellow", "green"), 0.38),
    "teddy": Kind(teddy, ("brown", "white", "pink"), 0.42),
    "ball": Kind(ball, ("red", "blue", "green", "pink"), 0.27),
    "bowl": Kind(bowl, ("white", "green", "blue", "orange"), 0.34),
    "candle": Kind(candle, ("white", "red", "purple"), 0.22),
    "bottle": Kind(bottle, ("green", "brown", "blue"), 0.2),
    "pumpkin": Kind(pumpkin, ("orange",), 0.34),
    "car": Kind(car, ("red", "blue", "yellow", "green"), 0.44),
    "crate": Kind(crate, ("brown",), 0.4),
}


def make(kind: str, color: str, number: int, rng: np.random.Generator) -> Thing:
    """An object of ``kind`` at the origin.

    Args:
        kind: Key of ``KINDS``.
        color: Key of ``COLORS`` or ``METALS``.
        number: Its number in the scene, from 1.
        rng: For what differs from one such thing to the next: shade, leaves, book sizes.
    """
    thing = Thing(kind, color, number, rng)
    KINDS[kind].build(thing)
    return thing
