"""Single numbers as text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def number(value: float | None, digits: int = 3) -> str:
    """A number with a fixed number of decimals; "-" for None and NaN."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def size_text(count: int | None) -> str:
    """A number of bytes in the largest fitting unit (powers of 1000)."""
    if count is None:
        return "-"
    value, unit = float(count), "B"
    for larger in ("KB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


def known_values(values: Any) -> list[float]:
    """The finite numbers of one value or a list of values."""
    listed = values if isinstance(values, (list, tuple)) else [values]
    return [float(value) for value in listed if value is not None and math.isfinite(value)]


def mean_and_std(values: Any) -> tuple[float | None, float | None]:
    """Mean and sample standard deviation of the finite values; None where there are too few."""
    known = known_values(values)
    if not known:
        return None, None
    return float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else None
