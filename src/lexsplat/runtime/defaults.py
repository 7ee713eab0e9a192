"""Settings that were given, told from those left at their defaults."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

T = TypeVar("T")


def where_not_given(settings: T, **values: Any) -> T:
    """Settings with other values in place of their defaults.

    Args:
        settings: A dataclass of which every field has a default.
        values: Values by field. A field that differs from its default was given, and keeps what was given.
    """
    usual = type(settings)()
    left = {name: value for name, value in values.items() if getattr(settings, name) == getattr(usual, name)}
    return replace(settings, **left)  # type: ignore[type-var]
