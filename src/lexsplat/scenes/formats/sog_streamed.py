"""Reading streamed SOG: ``lod-meta.json`` with a tree of regions, each at several levels of detail in SOG files.

The finest level of every region is read, and the environment, if there is one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from lexsplat.geometry.gaussians import Gaussians, joined
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import Damage, damaged, parsing, read_content, warn
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
    with parsing(path, "a streamed SOG of version 1"):
        meta = json.loads(content)
        if meta.get("version", 1) != 1:
            raise Damage(f"version {meta['version']!r:.40}")
        names = list(meta["filenames"])
        levels = list(_ranges(meta["tree"]))
        ranges = sorted({found for is_finest, found in levels if is_finest})
        files = {file: _inside(path, _named(names, file)) for file, _, _ in ranges}
        environment = [_inside(path, meta["environment"])] if meta.get("environment") else []
    parts = []
    for file, part_path in files.items():
        part = read_sog(part_path)
        named = _rows(path, part, [found for _, found in levels], file)
        if len(named) < len(part):
            left = len(part) - len(named)
            warn("%s: %d of %d Gaussians of %s are in no region", path, left, len(part), names[file])
        parts.append(part.select(_rows(path, part, ranges, file)))
    parts += [read_sog(part) for part in environment]
    if not parts:
        raise FileFormatError(
            path, expected="at least one Gaussian", found="none", remedy="export a scene that is not empty"
        )
    return joined(parts)


def _ranges(node: Any) -> Iterator[tuple[bool, _Range]]:
    """The ranges of all levels of each region of the tree, and whether each is the finest of its region."""
    levels = node.get("lods") or {}
    for level, lod in levels.items():
        found = lod["file"], lod.get("offset", 0), lod["count"]
        if any(type(number) is not int or number < 0 for number in found):
            raise Damage(f"a range {found!r:.80}")
        yield level == min(levels, key=int), found
    for child in node.get("children") or []:
        yield from _ranges(child)


def _named(names: list[Any], file: int) -> Any:
    """The name of a file by its number."""
    if file >= len(names):
        raise Damage(f"file {file} of {len(names)}")
    return names[file]


def _inside(path: Path, name: Any) -> Path:
    """A part, in the folder of the file or below."""
    part = (path.parent / name).resolve()
    if not part.is_relative_to(path.parent.resolve()) or not part.is_file():
        raise Damage(f"no part {str(name)[:80]!r} in the folder")
    return part


def _rows(path: Path, part: Gaussians, ranges: list[_Range], file: int) -> torch.Tensor:
    """Which Gaussians of a file belong to the finest level."""
    chosen = torch.zeros(len(part), dtype=torch.bool)
    for _, start, count in (found for found in ranges if found[0] == file):
        if start + count > len(part):
            raise damaged(path, f"{start + count:,} Gaussians in file {file}", f"{len(part):,}")
        chosen[start : start + count] = True
    return chosen.nonzero()[:, 0]
