"""Where a thing is and how large it is: as plain data for JSON, and in words with their unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.world import World
from lexsplat.runtime.errors import QueryError

if TYPE_CHECKING:
    from lexsplat.queries.selection import Selection

UNITS = "scene units"
"""The unit of lengths whose meters are not known, in words."""


def place_of(selection: Selection) -> dict[str, Any]:
    """Number of Gaussians, score, box and best view of a selection (`Selection.geometry`).

    Returns:
        "center" and "size" are in world units, "axes" in the axes of the scene. "center_meters" and "size_meters"
        are there only where the scale is known.

    Raises:
        QueryError: If nothing is selected.
    """
    return {
        "name": selection.phrase,
        "gaussians": selection.num_gaussians,
        "score": round(selection.score, 4),
        **lengths_of(selection),
        "axes": [_rounded(axis) for axis in selection.box.axes],
        "best_view": selection.shown_in,
    }


def lengths_of(selection: Selection) -> dict[str, list[float]]:
    """`lengths` of the box of a selection."""
    scale = selection.world.meters_per_unit if selection.world else None
    return lengths(selection.center, selection.size, scale)


def lengths(
    center: Iterable[float], size: Iterable[float], meters_per_unit: float | None
) -> dict[str, list[float]]:
    """Center and size of a box in world units, and in meters as "center_meters" and "size_meters" if known."""
    known = {"center": list(center), "size": list(size)}
    units = {name: _rounded(values) for name, values in known.items()}
    if meters_per_unit is None:
        return units
    meters = {
        f"{name}_meters": _rounded(v * meters_per_unit for v in values) for name, values in known.items()
    }
    return {**units, **meters}


def angle_of_box(axes: Sequence[Sequence[float]] | NDArray[np.float64]) -> float:
    """How far an upright box is turned about the vertical, in degrees with one decimal, at least 0 and below 180.

    It is the angle from the scene's x axis to the first axis of the box, counterclockwise as seen from above. Where x
    is within 45 degrees of the vertical, the scene's y axis takes its place.

    Args:
        axes: The axes of the box as rows ``[3, 3]``, the last one up (`lexsplat.geometry.boxes.Box`).
    """
    rows = np.asarray(axes, dtype=np.float64)
    up = rows[2]
    start = np.eye(3)[0 if up[0] ** 2 <= 0.5 else 1]
    across, along = np.cross(up, start) @ rows[0], start @ rows[0]
    return round(float(np.degrees(np.arctan2(across, along))) % 180.0, 1) % 180.0


def given_length(world: World | None, distance: float | None, meters: float | None) -> float | None:
    """A length that is given in world units or in meters, in world units; None if it is not given.

    Raises:
        QueryError: If it is given in both ways, negative or no number, or in meters and the scale is unknown.
    """
    if distance is not None and meters is not None:
        raise QueryError(
            "distance", expected="scene units or meters", found="both", remedy="give one of them"
        )
    given = distance if meters is None else meters
    if given is None:
        return None
    if isinstance(given, str) or not hasattr(given, "__float__") or not float(given) >= 0:
        raise QueryError("distance", expected="a number from 0", found=repr(given)[:40])
    return float(given) if meters is None else (world or World.of_cameras(())).units(float(given))


def position(thing: Mapping[str, Any]) -> str:
    """The center of a thing (`place_of`) in words: "(-0.08, -0.11, 0.05) m", in scene units without a scale."""
    if meters := thing.get("center_meters"):
        return f"({', '.join(f'{value:.3f}' for value in meters)}) m"
    return f"({', '.join(f'{value:.2f}' for value in thing['center'])}) {UNITS}"


def extent(thing: Mapping[str, Any]) -> str:
    """The size of a thing (`place_of`) in words: "0.093 x 0.080 x 0.086 m", in scene units without a scale."""
    if meters := thing.get("size_meters"):
        return f"{' x '.join(f'{value:.3f}' for value in meters)} m"
    return f"{' x '.join(f'{value:.2f}' for value in thing['size'])} {UNITS}"


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), 5) for value in values]
