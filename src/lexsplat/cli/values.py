"""Values that are written in more than one way on the command line: lengths and colors."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from lexsplat.scenes.colors import parse_color

if TYPE_CHECKING:
    from lexsplat.geometry.world import World

METERS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3, "in": 0.0254, "ft": 0.3048}
"""Meters in each unit of length that is accepted."""


def parse_length(text: str) -> float:
    """Meters of "0.095", "9.5cm" or "4 in"; a plain number is meters.

    Raises:
        ValueError: If it is not a number with one of these units.
    """
    match = re.fullmatch(r"\s*([-+.\w]*?[\d.])\s*([a-z]*)\s*", text.lower())
    try:
        number, unit = (float(match[1]), match[2] or "m") if match else (0.0, "")
        return number * METERS[unit]
    except (ValueError, KeyError):
        units = ", ".join(METERS)
        raise ValueError(f"expected a length such as 0.095 or 9.5cm ({units}), found {text!r}") from None


@dataclasses.dataclass(frozen=True)
class Lengths:
    """Lengths as they are given: in world units, or in meters.

    Args:
        values: The lengths.
        in_meters: Whether they are in meters; False for plain numbers, which are in world units.
    """

    values: tuple[float, ...]
    in_meters: bool = False

    def units(self, world: World) -> tuple[float, ...]:
        """The lengths in world units.

        Raises:
            QueryError: If they are in meters and the scale is unknown.
        """
        return tuple(map(world.units, self.values)) if self.in_meters else self.values


def parse_lengths(words: Sequence[str]) -> Lengths:
    """World units of plain numbers such as "0.5 0 0", meters of lengths with units such as "20cm 0 0".

    Raises:
        ValueError: If one is neither, or a number other than 0 stands beside lengths with units.
    """
    plain = [_number(word) for word in words]
    numbers = [number for number in plain if number is not None]
    if len(numbers) == len(words):
        return Lengths(tuple(numbers))
    if any(numbers):
        raise ValueError(f"expected a unit with each length or with none, found {' '.join(words)!r}")
    return Lengths(tuple(map(parse_length, words)), in_meters=True)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _is_none_or(kind: type) -> Any:
    return lambda value: value is None or isinstance(value, kind)


Length = Annotated[
    float | None,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="LENGTH",
        instance_from_str=lambda words: parse_length(words[0]),
        is_instance=_is_none_or(float),
        str_from_instance=lambda value: ["none" if value is None else f"{value:g}"],
    ),
]
"""An option that is a length in meters."""


def _lengths(count: int, metavar: str) -> PrimitiveConstructorSpec[Any]:
    return PrimitiveConstructorSpec(
        nargs=count,
        metavar=metavar,
        instance_from_str=parse_lengths,
        is_instance=_is_none_or(Lengths),
        str_from_instance=lambda value: ["none"] if value is None else [f"{v:g}" for v in value.values],
    )


Reach = Annotated[Lengths | None, _lengths(1, "LENGTH")]
"""An option that is a length in world units, or in meters if it has a unit."""

Shift = Annotated[Lengths, _lengths(3, "X Y Z")]
"""An option that is a vector in world units, or in meters if its lengths have units."""

Color = Annotated[
    tuple[float, float, float] | None,
    PrimitiveConstructorSpec(
        nargs=(1, 3),
        metavar="COLOR",
        instance_from_str=parse_color,
        is_instance=_is_none_or(tuple),
        str_from_instance=lambda value: ["none"] if value is None else [f"{v:g}" for v in value],
    ),
]
"""An option that is a color."""
