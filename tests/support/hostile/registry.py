"""The registry of hostile readers: a reader, a valid input, and mutations of the input."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile.mutations import Mutation


@dataclass
class Reader:
    """A reader and the mutations of its input.

    Args:
        make: Writes the valid input into a folder.
        read: Reads it.
        check: Raises AssertionError if the result is invalid.
        mutations: By file, relative to the folder: its mutations.
        exact: Files of which no part may be missing: if truncated, they fail or yield the same result.
        value_errors: Whether ValueError is documented for damaged content.
        told: Whether each error has a remedy and no text of Python.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    check: Callable[[Any], None]
    mutations: dict[str, Callable[[bytes, np.random.Generator], Iterator[Mutation]]]
    exact: tuple[str, ...] = ()
    value_errors: bool = False
    told: bool = False


READERS: dict[str, Callable[[], Reader]] = {}


def reader(make: Callable[[], Reader]) -> Callable[[], Reader]:
    """Register the function that makes a reader, under its name."""
    READERS[make.__name__] = make
    return make


def finite(*arrays: Any) -> None:
    """Assert that arrays hold finite numbers."""
    for array in arrays:
        values = np.asarray(array)
        assert values.dtype.kind in "fiub", f"an array of {values.dtype}"
        assert np.isfinite(values).all(), "NaN or infinity came through"


def grid(*shape: int) -> np.ndarray:
    """Random float32 numbers of a shape."""
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)
