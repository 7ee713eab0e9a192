"""Materials: one Principled shader with at most one procedural pattern. Needs Blender (``bpy``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

Color = tuple[float, float, float]

COLORS: dict[str, Color] = {
    "red": (0.55, 0.02, 0.02),
    "green": (0.04, 0.32, 0.05),
    "blue": (0.03, 0.09, 0.5),
    "yellow": (0.85, 0.6, 0.03),
    "orange": (0.85, 0.22, 0.01),
    "white": (0.8, 0.8, 0.78),
    "black": (0.015, 0.015, 0.017),
    "purple": (0.22, 0.04, 0.4),
    "pink": (0.85, 0.28, 0.42),
    "brown": (0.2, 0.09, 0.035),
    "gray": (0.25, 0.25, 0.26),
}
"""Named colors, linear RGB."""

METALS: dict[str, Color] = {
    "gold": (0.9, 0.58, 0.15),
    "silver": (0.75, 0.75, 0.77),
    "copper": (0.85, 0.4, 0.25),
}
"""Reflectance of metals, linear RGB."""


def color_of(name: str) -> Color:
    """Linear RGB of a color or metal by name."""
    return METALS[name] if name in METALS else COLORS[name]


def scaled(color: Color, factor: float) -> Color:
    """A color times a factor, clipped to 0..1."""
    return tuple(min(1.0, factor * channel) for channel in color)  # type: ignore[return-value]


def varied(color: Color, rng: np.random.Generator, amount: float = 0.12) -> Color:
    """A color close to ``color``: each channel times a random factor in 1 +- ``amount``."""
    factors = 1 + rng.uniform(-amount, amount, 3)
    return tuple(float(np.clip(channel * factor, 0, 1)) for channel, factor in zip(color, factors))  # type: ignore[return-value]


class _Nodes:
    """The node tree of a material, with methods that add nodes."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.shader = self.tree.nodes["Principled BSDF"]

    def add(self, kind: str, vector: Any = None, **inputs: float | Sequence[float]) -> Any:
        """A new node; ``inputs`` by name with "_" for space, ``vector`` is linked to its Vector input."""
        node = self.tree.nodes.new(kind)
        for name, value in inputs.items():
            node.inputs[name.replace("_", " ")].default_value = value
        if vector is not None:
            self.tree.links.new(vector, node.inputs["Vector"])
        return node

    def link(self, output: Any, target: Any) -> None:
        self.tree.links.new(output, target)

    def ramp(self, factor: Any, stops: Sequence[tuple[float, Color]]) -> Any:
        """Color by factor: (position, color), positions ascending."""
        node = self.add("ShaderNodeValToRGB", Fac=0.0)
        self.link(factor, node.inputs["Fac"])
        elements = node.color_ramp.elements
        elements[0].position, elements[0].color = stops[0][0], (*stops[0][1], 1)
        elements[1].position, elements[1].color = stops[-1][0], (*stops[-1][1], 1)
        for position, color in stops[1:-1]:
            elements.new(position).color = (*color, 1)
        return node.outputs["Color"]


def _wood(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    mapping.inputs["Scale"].default_value = (1, 7, 1)  # the grain runs along x
    vector = mapping.outputs["Vector"]
    noise = nodes.add("ShaderNodeTexNoise", vector, Scale=scale * 0.5, Detail=9, Distortion=1.2)
    stops = [(0.3, second), (0.48, color), (0.55, scaled(color, 0.8)), (0.72, scaled(color, 1.25))]
    return nodes.ramp(noise.outputs["Fac"], stops), noise.outputs["Fac"]


def _brick(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    mapping.inputs["Rotation"].default_value = (math.pi / 2, 0, 0)  # courses in the xz plane
    brick = nodes.add(
        "ShaderNodeTexBrick",
        mapping.outputs["Vector"],
        Scale=scale,
        Color1=(*color, 1),
        Color2=(*second, 1),
        Mortar=(0.5, 0.47, 0.43, 1),
        Mortar_Size=0.025,
    )
    relief = nodes.add("ShaderNodeMath")
    relief.operation = "SUBTRACT"
    relief.inputs[0].default_value = 1
    nodes.link(brick.outputs["Fac"], relief.inputs[1])
    return brick.outputs["Color"], relief.outputs[0]


def _checker(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    # Off the origin: a boundary between squares on the surface itself would flicker.
    mapping.inputs["Location"].default_value = (0.013, 0.017, 0.5)
    checker = nodes.add(
        "ShaderNodeTexChecker",
        mapping.outputs["Vector"],
        Scale=scale,
        Color1=(*color, 1),
        Color2=(*second, 1),
    )
    return checker.outputs["Color"], None


def _stripes(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    wave = nodes.add("ShaderNodeTexWave", mapping.outputs["Vector"], Scale=scale)
    wave.bands_direction = "Z"
    return nodes.ramp(wave.outputs["Fac"], [(0.49, color), (0.51, second)]), None


def _noise(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    noise = nodes.add("ShaderNodeTexNoise", mapping.outputs["Vector"], Scale=scale, Detail=6)
    return nodes.ramp(noise.outputs["Fac"], [(0.35, second), (0.65, color)]), noise.outputs["Fac"]


def _plaster(nodes: _Nodes, mapping: Any, color: Color, second: Color, scale: float) -> tuple[Any, Any]:
    """Fine blotches with sharp edges: features for structure from motion on a plain wall."""
    noise = nodes.add("ShaderNodeTexNoise", mapping.outputs["Vector"], Scale=scale, Detail=2, Roughness=0.7)
    return nodes.ramp(noise.outputs["Fac"], [(0.42, second), (0.46, color), (1.0, color)]), noise.outputs[
        "Fac"
    ]


PATTERNS = {
    "wood": _wood,
    "brick": _brick,
    "checker": _checker,
    "stripes": _stripes,
    "noise": _noise,
    "plaster": _plaster,
}
_REGULAR = {"brick", "checker", "stripes"}  # patterns that look the same wherever they start


def material(
    color: Color,
    rng: np.random.Generator,
    *,
    roughness: float = 0.45,
    metallic: float = 0.0,
    transmission: float = 0.0,
    coat: float = 0.0,
    emission: float = 0.0,
    subsurface: float = 0.0,
    bump: float = 0.0,
    pattern: str | None = None,
    second: Color | None = None,
    scale: float = 5.0,
) -> Any:
    """A Blender material.

    Args:
        color: Base color, linear RGB.
        rng: Where the pattern starts.
        roughness, metallic, transmission, coat, subsurface: Weights of the Principled shader, 0..1.
        emission: Strength of light in ``color``, 0 for none.
        bump: Strength of relief; it follows the pattern where that has one, else fine noise.
        pattern: Key of ``PATTERNS`` or None.
        second: The pattern's other color; a darker ``color`` if None.
        scale: Repeats of the pattern per scene unit, roughly.
    """
    nodes = _Nodes("material")
    inputs = nodes.shader.inputs
    inputs["Base Color"].default_value = (*color, 1)
    inputs["Roughness"].default_value = roughness
    inputs["Metallic"].default_value = metallic
    inputs["Transmission Weight"].default_value = transmission
    inputs["Coat Weight"].default_value = coat
    if subsurface:
        inputs["Subsurface Weight"].default_value = subsurface
        inputs["Subsurface Radius"].default_value = (0.05, 0.02, 0.01)
    if emission:
        inputs["Emission Color"].default_value = (*color, 1)
        inputs["Emission Strength"].default_value = emission

    coordinates = nodes.add("ShaderNodeTexCoord").outputs["Object"]
    relief = None
    if pattern is not None:
        mapping = nodes.add("ShaderNodeMapping", coordinates)
        if pattern not in _REGULAR:
            mapping.inputs["Location"].default_value = rng.uniform(-9, 9, 3).tolist()
        base, relief = PATTERNS[pattern](nodes, mapping, color, second or scaled(color, 0.55), scale)
        nodes.link(base, inputs["Base Color"])
    if bump:
        if relief is None:
            relief = nodes.add("ShaderNodeTexNoise", coordinates, Scale=40.0).outputs["Fac"]
        node = nodes.add("ShaderNodeBump", Strength=bump, Distance=0.02)
        nodes.link(relief, node.inputs["Height"])
        nodes.link(node.outputs["Normal"], inputs["Normal"])
    return nodes.material
