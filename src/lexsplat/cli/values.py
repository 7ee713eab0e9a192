"""Values that are written in more than one way on the command line: lengths and colors."""

from __future__ import annotations

import re
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from lexsplat.scenes.colors import parse_color

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
