"""The header of a PLY: its elements, and how much data they have.

Data that no element declares is damage: a count that is too small would make half a scene pass for a whole one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import EXPORT_AGAIN, damaged, warn

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ENCODINGS = {
    "format ascii 1.0": "",
    "format binary_little_endian 1.0": "<",
    "format binary_big_endian 1.0": ">",
}
"""Byte order of the numbers, "" for text, by the line of the header that states it."""

SPLATS = "use a .ply of 3D Gaussians; a mesh or a point cloud has none"
"""The remedy for a PLY of something else."""

_NO_GAUSSIANS = {"extrinsic", "intrinsic", "image_size", "frame", "disparity", "color_space", "version"}
"""Elements in which Apple's SHARP describes its photo."""
_MOST_ROWS = 16
"""Largest number of rows of such an element."""

_BLOCK = 1 << 20
"""Bytes of text whose numbers are counted at a time."""

_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class Element:
    """An element of a PLY.

    Args:
        name: Such as "vertex".
        count: Number of its rows.
        columns: Name and numpy type of each property, and the type of a list's length, "" if it is no list.
    """

    name: str
    count: int
    columns: tuple[tuple[str, str, str], ...]

    @property
    def has_lists(self) -> bool:
        """Whether its rows differ in length."""
        return any(length for _, _, length in self.columns)

    def row_size(self, order: str) -> int:
        """Bytes of a row, or numbers of a row of text; of lists, only those of their lengths."""
        return sum(np.dtype(length or kind).itemsize if order else 1 for _, kind, length in self.columns)


def header_lines(file: BinaryIO, path: Path) -> list[str]:
    """The lines of a PLY header up to ``end_header``, without line ends.

    Raises:
        FileFormatError: If the file does not begin with one.
    """
    lines: list[str] = []
    left = _MAX_HEADER_BYTES
    while not lines or lines[-1] != "end_header":
        raw = file.readline(left + 1)
        left -= len(raw)
        if not lines and raw.strip() != b"ply":
            raise _no_ply(raw, path)
        if left < 0:
            expected, found = f"a header of up to {_MAX_HEADER_BYTES:,} bytes", "more bytes before end_header"
            raise FileFormatError(path, expected=expected, found=found, remedy="shorten its comments")
        if not raw.endswith(b"\n"):
            found = "a file that ends in its header"
            raise damaged(path, "a PLY header up to end_header", found)
        lines.append(raw.decode("ascii", "replace").strip())
    return lines


def _no_ply(first: bytes, path: Path) -> FileFormatError:
    """The error for a file whose first line is not that of a PLY."""
    if not first:
        return damaged(path, "a PLY header", "an empty file")
    if first.startswith(b"ply\r"):
        return damaged(path, "a PLY header with line feeds", "carriage returns alone", EXPORT_AGAIN)
    return FileFormatError(path, expected="a PLY header", found=repr(first[:20])[1:], remedy=SPLATS)


def byte_order(lines: Sequence[str], path: Path) -> str:
    """The byte order of `ENCODINGS`.

    Raises:
        FileFormatError: If the header has none of them.
    """
    order = next((ENCODINGS[line] for line in lines if line in ENCODINGS), None)
    if order is None:
        found = next((line for line in lines if line.startswith("format")), "no format line")
        raise damaged(path, " or ".join(ENCODINGS), found[:80], EXPORT_AGAIN)
    return order


def parse_elements(lines: Sequence[str], path: Path) -> list[Element]:
    """The elements of a header, in the order of their data.

    Raises:
        FileFormatError: If an element or a property cannot be understood, or two elements have the same name, of
            which the second would be ignored.
    """
    elements: list[Element] = []
    for line in lines:
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal():
                raise damaged(path, "'element NAME COUNT'", repr(line[:80]), EXPORT_AGAIN)
            if words[1] in [element.name for element in elements]:
                raise FileFormatError(
                    path,
                    expected="one element of each name",
                    found=f"two named {words[1]!r:.40}",
                    remedy="export the file again, as one list of Gaussians",
                )
            elements.append(Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"]:
            column = _column(words)
            if column is None or not elements:
                raise damaged(path, "a property of an element", repr(line[:80]), EXPORT_AGAIN)
            last = elements[-1]
            elements[-1] = Element(last.name, last.count, (*last.columns, column))
    return elements


def warn_of_ignored(elements: Sequence[Element], count: int, path: Path) -> None:
    """Warn of elements that are not read and may hold Gaussians other than the ``count`` ones."""
    ignored = [
        f"{element.name!r:.40} of length {element.count:,}"
        for element in elements
        if element.count * len(element.columns)
        and not (element.name in _NO_GAUSSIANS and element.count <= _MOST_ROWS)
    ]
    if ignored:
        warn(
            "%s: elements other than the %s Gaussians are ignored: %s",
            path,
            f"{count:,}",
            ", ".join(ignored)[:200],
        )


def _column(words: Sequence[str]) -> tuple[str, str, str] | None:
    if len(words) == 3 and words[1] in _TYPES:
        return words[2], _TYPES[words[1]], ""
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        return words[4], _TYPES[words[3]], _TYPES[words[2]]
    return None


def uneven_line(text: bytes, count: int, width: int) -> tuple[int, int] | None:
    """The first of ``count`` lines that are not blank with other than ``width`` numbers.

    Returns:
        How many lines are before it, and how many numbers it has; None if there is none.
    """
    data, words, before = np.frombuffer(text, np.uint8), 0, True
    counts = []  # numbers up to the end of each line
    for start in range(0, len(data), _BLOCK):
        block = data[start : start + _BLOCK]
        blank = block <= ord(" ")
        begins = ~blank
        begins[1:] &= blank[:-1]
        begins[0] &= before
        places = begins.nonzero()[0]
        counts.append(words + np.searchsorted(places, (block == ord("\n")).nonzero()[0]))
        words, before = words + len(places), bool(blank[-1])
    each = np.diff(np.concatenate([*counts, [words]]), prepend=0)
    filled = each.nonzero()[0][:count]
    uneven = filled[each[filled] != width]
    return (int(uneven[0]), int(each[uneven[0]])) if len(uneven) else None


def data_left(
    elements: Sequence[Element], order: str, available: int, load: Callable[[], bytes | NDArray[np.float64]]
) -> int:
    """How much is left after all elements, in bytes, or in numbers of a text; negative if something is missing.

    Args:
        elements: The elements.
        order: The byte order, "" for text.
        available: Bytes or numbers that the file has for them.
        load: Gives these bytes or numbers; called if lists make rows differ in length.
    """
    if not any(element.has_lists for element in elements):
        return available - sum(element.count * element.row_size(order) for element in elements)
    data, place = load(), 0
    for element in elements:
        size = element.row_size(order)
        if place + element.count * size > available:
            return -1
        if not element.has_lists:
            place += element.count * size
            continue
        for _ in range(element.count):
            place = _after_row(element, order, data, place)
            if not 0 <= place <= available:
                return -1
    return available - place


def _after_row(element: Element, order: str, data: bytes | NDArray[np.float64], place: int) -> int:
    """Where the next row of an element with lists begins; beyond the end if this one does not end, or -1."""
    for _, kind, length in element.columns:
        size = np.dtype(kind).itemsize if order else 1
        if not length:
            place += size
            continue
        step = np.dtype(length).itemsize if order else 1
        if place + step > len(data):
            return len(data) + 1
        number = np.frombuffer(data, order + length, 1, place)[0] if isinstance(data, bytes) else data[place]
        if not 0 <= number <= len(data):
            return -1
        place += step + int(number) * size
    return place
