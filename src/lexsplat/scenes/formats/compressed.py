"""The compressed PLY of SuperSplat and ``.ksplat``, through the library GaussForge (Apache-2.0).

It is an optional dependency: ``pip install "lexsplat[formats]"``. Damaged ``.ksplat`` files corrupt its memory, so it
works in a process of its own. Three faults of GaussForge 0.6 are corrected here: it drops the comment of the mip
filter, writes the spherical harmonics of a compressed PLY coefficient by coefficient instead of channel by channel,
and takes all degrees of a ``.ksplat`` for one. splat-transform agrees with the result
(tests/scenes/test_splat_transform.py).
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats.foreign import read_content
from lexsplat.scenes.formats.ply import MIP, header_lines, is_antialiased, parse_ply, write_ply

COMPRESSED = {".compressed.ply": "compressed.ply", ".ksplat": "ksplat"}
"""GaussForge's name of each format, by file suffix."""

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
    read_content(path, kind)  # a missing file is a clearer error here
    antialiased = False
    if kind == "compressed.ply":
        with open(path, "rb") as file:
            antialiased = is_antialiased(header_lines(file, path))
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        _convert(path, kind, plain, "ply", subject=path)
        try:
            found = parse_ply(plain)
        except FileFormatError as error:  # its text concerns the temporary file, not the user's
            raise FileFormatError(path, expected=f"a {kind} file", found="damaged content") from error
    if kind == "ksplat":
        values = found.shN.transpose(1, 2).flatten(1)
        found = replace(found, shN=values[:, _places_in_ksplat(found.sh_degree)].reshape_as(found.shN))
    return replace(found, antialiased=antialiased)


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


def _convert(source: Path, kind: str, target: Path, wanted: str, subject: Path) -> None:
    """Convert a file with GaussForge in another process.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If it refuses the file or ends by a signal.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise BackendError(
            subject,
            expected="the library gaussforge",
            found="not installed",
            remedy='pip install "lexsplat[formats]"',
        )
    command = [sys.executable, "-c", _CONVERT, str(source), kind, str(target), wanted]
    run = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if run.returncode:
        last = (run.stderr.strip().splitlines() or ["damaged content"])[-1][:200]
        raise FileFormatError(subject, expected=f"a {kind if wanted == 'ply' else wanted} file", found=last)
