"""The up direction and the scale of a scene.

Photos alone determine neither. Up is estimated from the camera poses, or from splats without photos, and can be
given; the scale is known once a distance in the scene has been given (``lexsplat scale``). Both are stored in
``scene.json`` as ``world``::

    {"up": {"direction": [x, y, z], "reliable": true, "from": "cameras" | "splats" | "user"},
     "meters_per_unit": 0.41 | null,
     "measured": {"as": "height" | "distance", "up": [x, y, z]} | null, "poses": "..."}

"measured" is how the scale was measured, and the up direction at that time, along which a height is one. "poses" is a
fingerprint of the camera poses; stored values are valid only for these poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.boxes import Up, gravity_up
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.runtime.fingerprints import digest

Source = Literal["cameras", "splats", "user"]
Measure = Literal["height", "distance"]


class Measured(NamedTuple):
    """How the scale of a scene was measured.

    Args:
        kind: From a height, which depends on the up direction, or from a distance between two places.
        up: Up direction at that time ``[3]``, of unit length.
    """

    kind: Measure
    up: tuple[float, ...]

    def tilt(self, up: Up) -> float:
        """Angle between the up direction of the measurement and another one, in degrees."""
        return angle_between(np.array(self.up), up.direction)


@dataclass(frozen=True)
class World:
    """Up and scale of a scene.

    Args:
        up: The direction away from the ground.
        source: Origin of the up direction: the cameras, the splats that came without cameras, or the user.
        meters_per_unit: Length of a world unit in meters; None if unknown.
        measured: How the scale was measured; None if it is unknown, or was stored by an earlier version.

    Raises:
        ValueError: If the scale is not positive and finite.
    """

    up: Up
    source: Source = "cameras"
    meters_per_unit: float | None = None
    measured: Measured | None = None

    def __post_init__(self) -> None:
        scale = self.meters_per_unit
        if scale is not None and not 0 < scale < math.inf:
            raise ValueError(f"meters_per_unit must be positive and finite, got {scale}")

    @classmethod
    def of_cameras(cls, cameras: Iterable[Camera]) -> World:
        """Up estimated from the cameras (z if there are none), without scale."""
        cameras = list(cameras)
        return cls(gravity_up(cameras) if cameras else Up(np.array([0.0, 0.0, 1.0]), False))

    def with_up(self, direction: Iterable[float]) -> World:
        """The same world with an up direction given by the user.

        Raises:
            ValueError: If the direction is not three finite numbers, or all are 0.
        """
        vector = np.asarray(list(direction), dtype=np.float64)
        length = float(np.linalg.norm(vector))
        if vector.shape != (3,) or not 0 < length < math.inf:
            raise ValueError(f"up must be three numbers that are not all 0, got {vector.tolist()}")
        return replace(self, up=Up(vector / length, True), source="user")

    def meters(self, length: float) -> float | None:
        """A length in world units, in meters; None if the scale is unknown."""
        return None if self.meters_per_unit is None else float(length) * self.meters_per_unit

    def units(self, meters: float) -> float:
        """A length in meters, in world units.

        Raises:
            QueryError: If the scale is unknown.
        """
        if self.meters_per_unit is None:
            raise QueryError(
                f"{meters:g} m",
                expected="a scene with a known scale",
                found="none",
                remedy="set it with: lexsplat scale; or give the length in scene units",
            )
        return meters / self.meters_per_unit

    def to_json(self) -> dict[str, Any]:
        """Plain data for ``scene.json`` and for JSON output."""
        direction = [round(float(v), 6) + 0.0 for v in self.up.direction]
        return {
            "up": {"direction": direction, "reliable": self.up.reliable, "from": self.source},
            "meters_per_unit": self.meters_per_unit,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> World:
        """The inverse of `to_json`.

        Raises:
            SceneFolderError: If the content is not what `to_json` writes.
        """
        try:
            up, scale = content["up"], content["meters_per_unit"]
            source: Source = up["from"] if up["from"] in ("splats", "user") else "cameras"
            world = cls(Up(np.array([0.0, 0.0, 1.0]), False)).with_up(float(v) for v in up["direction"])
            world = replace(world, up=replace(world.up, reliable=bool(up["reliable"])), source=source)
            known = content.get("measured")
            measured = None if known is None else _measured(known)
            scale = None if scale is None else float(scale)
            return replace(world, meters_per_unit=scale, measured=measured)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SceneFolderError(
                "world in scene.json",
                expected="an up direction and meters_per_unit",
                found=str(error),
                remedy="take it out of the file, or run: lexsplat build again",
            ) from error


def _measured(content: Mapping[str, Any]) -> Measured:
    kind: Measure = "height" if content["as"] == "height" else "distance"
    return Measured(kind, tuple(World.of_cameras(()).with_up(content["up"]).up.direction.tolist()))


def angle_between(first: NDArray, second: NDArray) -> float:
    """Angle between two directions ``[3]`` of unit length, in degrees."""
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second)))


def world_of(record: Mapping[str, Any], cameras: Mapping[str, Camera]) -> World:
    """Up and scale of a scene.

    Args:
        record: The content of its ``scene.json``.
        cameras: Its cameras by name; they determine up if nothing is stored for their poses.

    Raises:
        SceneFolderError: If the stored data are damaged.
    """
    stored = record.get("world")
    if isinstance(stored, Mapping) and stored.get("poses") == _poses_of(cameras):
        return World.from_json(stored)
    return World.of_cameras(cameras.values())


def stored_world(world: World, cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """The entry ``world`` of ``scene.json``; `world_of` reads it."""
    measured = world.measured
    how = None if measured is None else {"as": measured.kind, "up": [round(v, 6) + 0.0 for v in measured.up]}
    return {**world.to_json(), "measured": how, "poses": _poses_of(cameras)}


def _poses_of(cameras: Mapping[str, Camera]) -> str:
    poses = ((name, np.round(cameras[name].viewmat, 6) + 0.0) for name in sorted(cameras))
    return digest(name.encode("utf-8", "surrogatepass") + pose.tobytes() for name, pose in poses)


def parse_vector(text: str, name: str = "up") -> tuple[float, float, float]:
    """Three finite numbers from "x,y,z".

    Args:
        text: The text.
        name: What it is given for, for the error.

    Raises:
        ValueError: If the text is not that.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{name}: expected three numbers such as 0,0,1, found {text!r}")
    return numbers[0], numbers[1], numbers[2]
