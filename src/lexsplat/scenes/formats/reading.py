"""Reading splat files of other programs, in any supported format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import refuse_pickle
from lexsplat.scenes.formats.compressed import COMPRESSED, read_compressed
from lexsplat.scenes.formats.foreign import renderable
from lexsplat.scenes.formats.gltf_reading import read_gltf
from lexsplat.scenes.formats.ply import parse_ply
from lexsplat.scenes.formats.sog import META, read_sog
from lexsplat.scenes.formats.sog_streamed import LOD_META, read_streamed_sog
from lexsplat.scenes.formats.splat import read_splat
from lexsplat.scenes.formats.spz import read_spz

READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": lambda path: read_compressed(path, "compressed.ply") if _is_compressed(path) else parse_ply(path),
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    LOD_META: read_streamed_sog,
    META: read_sog,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".ksplat": lambda path: read_compressed(path, COMPRESSED[".ksplat"]),
}
"""How files are read, by the end of their name."""


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians of any program; the name's ending chooses the format, one of `READERS`.

    Axes are those of the 3DGS PLY, y down and z forward, where a format defines others. Gaussians that cannot be
    rendered are dropped with a warning.

    Args:
        path: The file; of an unbundled or streamed SOG, its ``meta.json`` or ``lod-meta.json``, or the folder.

    Raises:
        FileFormatError: If the ending is unknown, the content does not match it, or more than a tenth of the
            Gaussians cannot be rendered.
        BackendError: If the format requires a library that is not installed.
    """
    refuse_pickle(path)
    path = splat_file(path)
    if _is_gzip(path):
        raise FileFormatError(path, expected="splats", found="gzip", remedy="unpack it first: gunzip FILE.gz")
    return renderable(reader_of(path)(path), path)


def reader_of(path: Path) -> Callable[[Path], Gaussians]:
    """The reader for the ending of a name.

    Raises:
        FileFormatError: If the ending is none of `READERS`.
    """
    for ending, read in READERS.items():
        if path.name.lower().endswith(ending):
            return read
    raise FileFormatError(
        path,
        expected="a name that ends in " + ", ".join(READERS),
        found=repr(path.suffix),
        remedy="export the splats in one of these formats",
    )


def is_splats(path: Path) -> bool:
    """Whether a path is a file with the name of splats."""
    return path.is_file() and path.name.lower().endswith(tuple(READERS))


def splat_file(path: Path) -> Path:
    """The path, or of a folder with a SOG the file that names its parts."""
    return next((path / name for name in (LOD_META, META) if (path / name).is_file()), path)


def _is_gzip(path: Path) -> bool:
    """Whether a file is packed as a whole. SPZ is gzip itself; ``.splat``, ``.ksplat`` may begin with any bytes."""
    if path.name.lower().endswith((".spz", "splat")):
        return False
    try:
        with open(path, "rb") as file:
            return file.read(3) == b"\x1f\x8b\x08"
    except OSError:
        return False  # the reader reports the error


def _is_compressed(path: Path) -> bool:
    """Whether a PLY has SuperSplat's compressed layout, which has a chunk element before the vertices."""
    try:
        with open(path, "rb") as file:
            return b"element chunk" in file.read(4096).split(b"end_header")[0]
    except OSError:
        return False  # the reader reports the error
