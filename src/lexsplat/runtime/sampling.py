"""Evenly spaced subsets of sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def evenly(items: Sequence[T], count: int) -> list[T]:
    """At most ``count`` evenly spaced items in order, including the first and the last.

    Args:
        items: The sequence.
        count: Maximum number of items.
    """
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(1, count - 1))] for i in range(count)]
