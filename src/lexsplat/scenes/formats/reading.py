"""Splats made by other programs, whatever their format."""

from __future__ import annotations

from pathlib import Path

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import refuse_pickle
from lexsplat.scenes.formats.compressed import COMPRESSED, read_compressed
from lexsplat.scenes.formats.ply import read_ply
from lexsplat.scenes.formats.splat import read_splat


def read_splats(path: Path) -> Gaussians:
    """Read ``.ply``, ``.splat``, ``.spz``, ``.compressed.ply`` or ``.ksplat``, by the ending of the name.

    Raises:
        FileFormatError: If the ending is none of these or the content is not what it promises.
        BackendError: If the format needs a library that is not installed.
    """
    refuse_pickle(path)
    name = path.name.lower()
    for ending, kind in COMPRESSED.items():
        if name.endswith(ending):
            return read_compressed(path, kind)
    if name.endswith(".ply"):
        if _is_compressed(path):
            return read_compressed(path, "compressed.ply")
        return read_ply(path, certain_opacities=True)
    if name.endswith(".splat"):
        return read_splat(path)
    raise FileFormatError(
        path,
        expected="a name that ends in .ply, .splat, .spz, .compressed.ply or .ksplat",
        found=repr(path.suffix),
    )


def _is_compressed(path: Path) -> bool:
    """Whether a PLY is SuperSplat's compressed kind, whatever its name: it has chunks before its vertices."""
    try:
        with open(path, "rb") as file:
            return b"element chunk" in file.read(4096).split(b"end_header")[0]
    except OSError:
        return False  # the reader says what is wrong
