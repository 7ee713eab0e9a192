"""Reading streamed SOG: ``lod-meta.json`` with a tree of regions, each at several levels of detail in SOG files.

The finest level of every region is read, and the environment, if there is one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import joined, read_content
from lexsplat.scenes.formats.sog import read_sog

LOD_META = "lod-meta.json"
"""The file that names the others."""

_Range = tuple[int, int, int]
"""Number of a file, first Gaussian in it, and number of Gaussians."""


def read_streamed_sog(path: Path) -> Gaussians:
    """Read the finest level of a streamed SOG by its ``lod-meta.json``, in the axes of a PLY.

    Raises:
        FileFormatError: If a part is missing, damaged or outside the folder, or the version is unknown.
    """
    content = read_content(path, LOD_META)
    try:
        meta = json.loads(content)
        if meta.get("version", 1) != 1:
            raise ValueError(f"version {meta['version']!r:.40}")
        names = list(meta["filenames"])
        ranges = sorted(set(_finest(meta["tree"])))
        files = {file: _inside(path, names[file]) for file, _, _ in ranges}
        environment = [_inside(path, meta["environment"])] if meta.get("environment") else []
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        OSError,
        RecursionError,
    ) as error:
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise FileFormatError(
            path, expected="a streamed SOG of version 1", found=f"damaged content: {found}"
        ) from error
    parts = [
        part.select(_rows(path, part, ranges, file))
        for file, part in ((f, read_sog(p)) for f, p in files.items())
    ]
    parts += [read_sog(part) for part in environment]
    if not parts:
        raise FileFormatError(path, expected="at least one Gaussian", found="none")
    return joined(parts)


def _finest(node: Any) -> Iterator[_Range]:
    """The ranges of the finest level of each region of the tree."""
    levels = node.get("lods") or {}
    if levels:
        lod = levels[min(levels, key=int)]
        found = lod["file"], lod.get("offset", 0), lod["count"]
        if any(type(number) is not int or number < 0 for number in found):
            raise ValueError(f"a range {found!r:.80}")
        yield found
    for child in node.get("children") or []:
        yield from _finest(child)


def _inside(path: Path, name: Any) -> Path:
    """A part, in the folder of the file or below."""
    part = (path.parent / name).resolve()
    if not part.is_relative_to(path.parent.resolve()) or not part.is_file():
        raise ValueError(f"no part {str(name)[:80]!r} in the folder")
    return part


def _rows(path: Path, part: Gaussians, ranges: list[_Range], file: int) -> torch.Tensor:
    """Which Gaussians of a file belong to the finest level."""
    chosen = torch.zeros(len(part), dtype=torch.bool)
    for _, start, count in (found for found in ranges if found[0] == file):
        if start + count > len(part):
            raise FileFormatError(
                path, expected=f"{start + count:,} Gaussians in file {file}", found=f"{len(part):,}"
            )
        chosen[start : start + count] = True
    return chosen.nonzero()[:, 0]
