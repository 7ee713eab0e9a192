"""Compressed splat files: SPZ, the compressed PLY of SuperSplat, and ``.ksplat``, through the library GaussForge.

GaussForge (Apache-2.0) includes Niantic's own SPZ code. It is an optional dependency:
``pip install "lexsplat[formats]"``.

SPZ uses y up and z backward; PLY uses y down and z forward. The two differ by a rotation of 180 degrees about x.
GaussForge 0.6 omits this rotation, so it is applied here. splat-transform agrees with the result
(tools/check_exports.py).
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
"""GaussForge's name of each format, by file suffix."""


def write_compressed(gaussians: Gaussians, path: Path, kind: str) -> None:
    """Write a file of one of the formats in `COMPRESSED`; the order of the Gaussians may change.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If GaussForge cannot convert the Gaussians.
    """
    library = _library(path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        write_ply(transformed(gaussians, rotation=_HALF_TURN) if kind == "spz" else gaussians, plain)
        answer = library.convert(plain.read_bytes(), "ply", kind)
    if "data" not in answer:
        raise FileFormatError(path, expected=f"a {kind} file", found=str(answer.get("error")))
    path.write_bytes(answer["data"])


def read_compressed(path: Path, kind: str) -> Gaussians:
    """Read a file of one of the formats in `COMPRESSED`.

    Raises:
        BackendError: If GaussForge is not installed.
        FileFormatError: If the file is damaged or has another format.
    """
    library = _library(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, expected=f"a readable {kind} file", found=str(error.strerror)) from error
    try:
        answer = library.convert(content, kind, "ply")
    except Exception as error:  # GaussForge documents no exception types; the cause is always the file
        raise FileFormatError(path, expected=f"a {kind} file", found=str(error)) from error
    if "data" not in answer:
        raise FileFormatError(path, expected=f"a {kind} file", found=str(answer.get("error")))
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        plain.write_bytes(answer["data"])
        try:
            gaussians = read_ply(plain, certain_opacities=True)
        except FileFormatError as error:  # its text concerns the temporary file, not the user's
            raise FileFormatError(path, expected=f"a {kind} file", found="damaged content") from error
    return transformed(gaussians, rotation=_HALF_TURN) if kind == "spz" else gaussians


def _library(path: Path) -> Any:
    try:
        import gaussforge
    except ImportError as error:
        raise BackendError(
            path,
            expected="the library gaussforge",
            found="not installed",
            remedy='pip install "lexsplat[formats]"',
        ) from error
    return gaussforge.GaussForge()
