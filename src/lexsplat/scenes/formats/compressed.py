"""The compressed PLY of SuperSplat and ``.ksplat``, through the library GaussForge (Apache-2.0).

It is an optional dependency: ``pip install "lexsplat[formats]"``. Damaged ``.ksplat`` files corrupt its memory, so it
works in a process of its own. Three faults of GaussForge 0.6 are corrected here: it drops the comment of the mip
filter, writes the spherical harmonics of a compressed PLY coefficient by coefficient instead of channel by channel,
and takes all degrees of a ``.ksplat`` for one. splat-transform agrees with the result
(tests/scenes/test_splat_transform.py).
"""

from __future__ import annotations

import importlib.util
import io
import math
import struct
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats.foreign import Damage, damaged, parsing, read_content, warn
from lexsplat.scenes.formats.ply import MIP, is_antialiased, parse_ply, write_ply
from lexsplat.scenes.formats.ply_elements import (
    byte_order,
    data_left,
    header_lines,
    parse_elements,
    warn_of_ignored,
)

COMPRESSED = {".compressed.ply": "compressed.ply", ".ksplat": "ksplat"}
"""GaussForge's name of each format, by file suffix."""

_CHUNK = 256
_BARE = str.maketrans("", "", "{}")
_KSPLAT_HEADER, _KSPLAT_SECTION = 4096, 1024
_KSPLAT = struct.Struct("<4xIIIIH")
"""Sections, those in use, and of Gaussians; number of Gaussians; compression level."""
_KSPLAT_PART = struct.Struct("<IIIIfHxxIIIIH")
"""Of a section: Gaussians, and how many there is space for; of buckets size, number, extent and bytes; range, bytes,
full and partial buckets; degree of the harmonics."""
_KSPLAT_BYTES = {0: (44, 4), 1: (24, 2), 2: (24, 1)}
"""Bytes of a Gaussian, and of a coefficient, at each compression level."""

_FORMAT_LINE = b"format binary_little_endian 1.0\n"
_CONVERT = """
import sys
from pathlib import Path
from gaussforge import GaussForge
source, kind, target, wanted = sys.argv[1:]
answer = GaussForge().convert(Path(source).read_bytes(), kind, wanted)
if "data" not in answer:
    sys.exit(str(answer.get("error")))
Path(target).write_bytes(answer["data"])
"""


def write_compressed(gaussians: Gaussians, path: Path, kind: str) -> None:
    """Write a file of one of the formats in `COMPRESSED`; the order of the Gaussians may change.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If GaussForge cannot convert the Gaussians.
    """
    with tempfile.TemporaryDirectory() as folder:
        plain, converted = Path(folder) / "plain.ply", Path(folder) / "converted"
        write_ply(replace(gaussians, shN=_as_the_library_writes(gaussians.shN, kind)), plain)
        _convert(plain, "ply", converted, kind, subject=path)
        content = converted.read_bytes()
    if kind == "compressed.ply" and gaussians.antialiased:
        content = content.replace(_FORMAT_LINE, _FORMAT_LINE + MIP.encode() + b"\n", 1)
    path.write_bytes(content)


def read_compressed(path: Path, kind: str) -> Gaussians:
    """Read a file of one of the formats in `COMPRESSED`.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If the file is damaged or has another format.
    """
    content, antialiased = read_content(path, kind), False
    _require_library(path)
    if kind == "compressed.ply":
        lines = header_lines(io.BytesIO(content), path)
        antialiased, count = is_antialiased(lines), _chunked_count(lines, content, path)
    else:
        count = _sectioned_count(content, path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        _convert(path, kind, plain, "ply", subject=path)
        try:
            found = parse_ply(plain)
        except FileFormatError as error:  # its text concerns the temporary file, not the user's
            raise damaged(path, f"a {kind} file", "damaged content") from error
    if len(found) != count:
        raise damaged(path, f"{count:,} Gaussians", f"{len(found):,}")
    if kind == "ksplat":
        values = found.shN.transpose(1, 2).flatten(1)
        found = replace(found, shN=values[:, _places_in_ksplat(found.sh_degree)].reshape_as(found.shN))
    return replace(found, antialiased=antialiased)


def _chunked_count(lines: list[str], content: bytes, path: Path) -> int:
    """Number of Gaussians of a compressed PLY, which must be that of its chunks and of its data."""
    elements = parse_elements(lines, path)
    counts = {element.name: element.count for element in elements}
    count = counts.get("vertex", 0)
    start = content.index(b"end_header") + len(b"end_header")
    available = len(content) - content.index(b"\n", start) - 1
    left = data_left(elements, byte_order(lines, path), available, lambda: content[-available:])
    fits = counts.get("chunk") == math.ceil(count / _CHUNK) and counts.get("sh", count) == count
    if left or not fits:
        more = f"{left:,} bytes after them" if left > 0 else "fewer bytes" if left else f"elements {counts}"
        raise damaged(path, f"{count:,} Gaussians in chunks of {_CHUNK}", more.translate(_BARE))
    others = [element for element in elements if element.name not in ("chunk", "vertex", "sh")]
    warn_of_ignored(others, count, path)
    return count


def _sectioned_count(content: bytes, path: Path) -> int:
    """Number of Gaussians of a ``.ksplat``, which must be that of its sections and of its data."""
    with parsing(path, "a ksplat file"):
        sections, _, _, count, level = _KSPLAT.unpack_from(content)
        place, held = _KSPLAT_HEADER + _KSPLAT_SECTION * sections, 0
        if level not in _KSPLAT_BYTES or place > len(content):
            raise Damage(f"compression level {level} and {sections:,} sections")
        for number in range(sections):
            here, most, _, buckets, _, bucket, _, _, _, partial, degree = _KSPLAT_PART.unpack_from(
                content, _KSPLAT_HEADER + _KSPLAT_SECTION * number
            )
            fixed, coefficient = _KSPLAT_BYTES[level]
            size = fixed + coefficient * 3 * ((min(degree, 4) + 1) ** 2 - 1)
            place += 4 * partial + bucket * buckets + size * most
            held += here
            if here != most:
                raise Damage(f"a section of {here:,} Gaussians with data of {most:,}")
        if not 0 <= len(content) - place < _KSPLAT_BYTES[level][0]:
            raise Damage(f"{held:,} Gaussians in sections, and {len(content):,} bytes instead of {place:,}")
        if held != count:
            raise Damage(f"a count of {count:,}, and {held:,} Gaussians in sections")
    if place < len(content):
        warn("%s: %d bytes after the last Gaussian are ignored", path, len(content) - place)
    return int(count)


def _as_the_library_writes(shN: Tensor, kind: str) -> Tensor:
    """Coefficients ``[N, K, 3]`` in the order in which GaussForge writes them rightly."""
    if kind == "compressed.ply":
        return shN.transpose(1, 2).reshape(shN.shape)
    degree = round((shN.shape[1] + 1) ** 0.5) - 1
    values = torch.zeros_like(shN.flatten(1))
    values[:, _places_in_ksplat(degree)] = shN.flatten(1)
    return values.reshape(len(shN), 3, shN.shape[1]).transpose(1, 2)


def _places_in_ksplat(degree: int) -> Tensor:
    """Where a ``.ksplat`` has coefficient k of channel c ``[3 K]``, k slowest: degrees, then channels, then k."""
    places = torch.zeros((degree + 1) ** 2 - 1, 3, dtype=torch.long)
    for order in range(1, degree + 1):
        first, count = order * order - 1, 2 * order + 1
        rows = torch.arange(count)[:, None] + count * torch.arange(3)
        places[first : first + count] = 3 * first + rows
    return places.flatten()


def _require_library(subject: Path) -> None:
    """Refuse to go on without GaussForge; the error is that of `_convert`."""
    if importlib.util.find_spec("gaussforge") is None:
        raise BackendError(
            subject,
            expected="the library gaussforge",
            found="not installed",
            remedy='pip install "lexsplat[formats]"',
        )


def _convert(source: Path, kind: str, target: Path, wanted: str, subject: Path) -> None:
    """Convert a file with GaussForge in another process.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If it refuses the file or ends by a signal.
    """
    _require_library(subject)
    command = [sys.executable, "-c", _CONVERT, str(source), kind, str(target), wanted]
    run = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if run.returncode:
        last = (run.stderr.strip().splitlines() or [""])[-1][:200]
        raise damaged(
            subject,
            f"a {kind if wanted == 'ply' else wanted} file",
            last if "failed" in last else "damaged content",
        )
