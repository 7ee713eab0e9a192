"""Table, cloth, wall, floor and light. Needs Blender."""

from __future__ import annotations

import math

import bpy
import numpy as np
from materials import COLORS, material, varied
from mathutils import Vector
from shapes import box, draped_sheet, joined
from things import Thing

PLAIN_WALLS = {"white": (0.72, 0.7, 0.66), "blue": (0.28, 0.4, 0.55), "green": (0.35, 0.48, 0.36)}


def make_table(number: int, rng: np.random.Generator) -> Thing:
    """A wooden table whose top is z = 0."""
    table = Thing("table", "brown", number, rng)
    color = varied((0.36, 0.17, 0.065), rng, 0.1)
    top = material(color, rng, roughness=0.45, pattern="wood", scale=rng.uniform(2, 4), bump=0.12, coat=0.08)
    table.add(box((4.4, 3.2, 0.12), (0, 0, -0.06)), top, smooth=False, bevel=0.02)
    legs = joined([box((0.16, 0.16, 2.0), (x, y, -1.1)) for x in (-2, 2) for y in (-1.4, 1.4)])
    table.add(legs, material((0.25, 0.12, 0.05), rng, roughness=0.5, pattern="wood"), smooth=False)
    return table


def make_cloth(color: str, number: int, rng: np.random.Generator, x: float, y: float, turn: float) -> Thing:
    """A checkered cloth on the table around (x, y)."""
    cloth = Thing("cloth", color, number, rng)
    fabric = material(
        COLORS[color],
        rng,
        roughness=0.9,
        pattern="checker",
        second=(0.74, 0.72, 0.68),
        scale=rng.uniform(6, 9),
        bump=0.15,
    )
    cloth.add(draped_sheet(1.0, 0.7, rng.uniform(0, 6, 3)), fabric)
    cloth.place(x, y, 0.0, turn)
    return cloth


def make_wall(color: str, surface: str, number: int, rng: np.random.Generator) -> Thing:
    """A wall behind the table: ``surface`` is "brick" or "plain"."""
    wall = Thing("wall", color, number, rng)
    if surface == "brick":
        finish = material(
            varied((0.36, 0.1, 0.06), rng),
            rng,
            roughness=0.85,
            pattern="brick",
            second=(0.24, 0.07, 0.05),
            scale=rng.uniform(1.8, 2.6),
            bump=0.9,
        )
    else:
        own = varied(PLAIN_WALLS[color], rng, 0.1)
        second = tuple(0.72 * channel for channel in own)
        finish = material(own, rng, roughness=0.85, pattern="plaster", second=second, scale=9, bump=0.3)
    wall.add(box((24, 0.2, 9), (0, 2.6, 1.5)), finish, smooth=False)
    return wall


def make_floor(number: int, rng: np.random.Generator) -> Thing:
    """A tiled stone floor below the table."""
    floor = Thing("floor", "gray", number, rng)
    tiles = material(
        (0.3, 0.29, 0.28), rng, roughness=0.6, pattern="checker", second=(0.2, 0.19, 0.18), scale=1.5
    )
    floor.add(box((24, 14, 0.1), (0, -4.3, -2.15)), tiles, smooth=False)
    return floor


def _add_area_light(position: tuple[float, float, float], size: float, watts: float, color: tuple) -> None:
    data = bpy.data.lights.new("area", "AREA")
    data.size, data.energy, data.color = size, watts, color
    light = bpy.data.objects.new("area", data)
    bpy.context.scene.collection.objects.link(light)
    light.location = position
    light.rotation_euler = (-Vector(position)).to_track_quat("-Z", "Y").to_euler()


def light_room(key_azimuth: float, key_watts: float, key_size: float, fill_watts: float, sky: float) -> None:
    """A warm key light at ``key_azimuth`` (radians about z from +x), a cool fill opposite, an even sky."""
    x, y = 5 * math.cos(key_azimuth), 5 * math.sin(key_azimuth)
    _add_area_light((x, y, 4.4), key_size, key_watts, (1, 0.93, 0.82))
    _add_area_light((-0.8 * x, -3, 4), 4, fill_watts, (0.75, 0.85, 1))
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0.6, 0.7, 0.85, 1)
    background.inputs["Strength"].default_value = sky
