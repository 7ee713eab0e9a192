"""Compressed splat files, by the library GaussForge: SPZ, the compressed PLY of SuperSplat, ``.ksplat``.

GaussForge (Apache-2.0) carries Niantic's own SPZ code. It is an extra: ``pip install "lexsplat[formats]"``.

SPZ has y up and z backwards where PLY has y down and z forwards, half a turn about x. GaussForge 0.6 copies the
numbers without that turn, so we make it here; splat-transform then agrees (tools/check_exports.py).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats.ply import read_ply, write_ply
from lexsplat.scenes.transforms import transformed

_HALF_TURN = np.diag([1.0, -1.0, -1.0])

COMPRESSED = {".spz": "spz", ".compressed.ply": "compressed.ply", ".ksplat": "ksplat"}
"""Endings of file names and what GaussForge calls the formats."""


def write_compressed(gaussians: Gaussians, path: Path, kind: str) -> None:
    """Write one of `COMPRESSED`; the order of the Gaussians may change.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If it cannot write the file.
    """
    path.write_bytes(_converted(gaussians, path, kind))


def read_compressed(path: Path, kind: str) -> Gaussians:
    """Read one of `COMPRESSED`.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If the file is damaged or of another format.
    """
    library = _library(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, expected=f"a readable {kind} file", found=str(error.strerror)) from error
    try:
        answer = library.convert(content, kind, "ply")
    except Exception as error:  # whatever the C++ side throws, the file is at fault
        raise FileFormatError(path, expected=f"a {kind} file", found=str(error)) from error
    if "data" not in answer:
        raise FileFormatError(path, expected=f"a {kind} file", found=str(answer.get("error")))
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        plain.write_bytes(answer["data"])
        try:
            gaussians = read_ply(plain, certain_opacities=True)
        except FileFormatError as error:  # what it says of the file in between is of no use to anybody
            raise FileFormatError(path, expected=f"a {kind} file", found="damaged content") from error
    return transformed(gaussians, rotation=_HALF_TURN) if kind == "spz" else gaussians


def _converted(gaussians: Gaussians, path: Path, kind: str) -> bytes:
    library = _library(path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        write_ply(transformed(gaussians, rotation=_HALF_TURN) if kind == "spz" else gaussians, plain)
        answer = library.convert(plain.read_bytes(), "ply", kind)
    if "data" not in answer:
        raise FileFormatError(path, expected=f"a {kind} file", found=str(answer.get("error")))
    return bytes(answer["data"])


def _library(path: Path) -> Any:
    try:
        import gaussforge
    except ImportError as error:
        raise BackendError(
            path,
            expected="the library gaussforge",
            found="it is not installed",
            remedy='pip install "lexsplat[formats]"',
        ) from error
    return gaussforge.GaussForge()
