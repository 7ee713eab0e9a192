"""Reading splat files of other programs, in any supported format."""

from __future__ import annotations

from pathlib import Path

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import refuse_pickle
from lexsplat.scenes.formats.compressed import COMPRESSED, read_compressed
from lexsplat.scenes.formats.ply import read_ply
from lexsplat.scenes.formats.splat import read_splat


def read_splats(path: Path) -> Gaussians:
    """Read ``.ply``, ``.splat``, ``.spz``, ``.compressed.ply`` or ``.ksplat``, chosen by suffix.

    Raises:
        FileFormatError: If the suffix is unknown or the content does not match it.
        BackendError: If the format requires a library that is not installed.
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
    """Whether a PLY has SuperSplat's compressed layout, which has a chunk element before the vertices."""
    try:
        with open(path, "rb") as file:
            return b"element chunk" in file.read(4096).split(b"end_header")[0]
    except OSError:
        return False  # the reader reports the error
