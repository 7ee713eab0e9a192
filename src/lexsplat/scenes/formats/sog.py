"""SOG, PlayCanvas's splats in WebP images: ``meta.json`` with images beside it, or all in one zip archive.

Pixel i of each image belongs to Gaussian i. Positions are 16-bit steps between bounds of sign(x) ln(1 + |x|), low
and high bytes in two images. Scales and colors are indices into tables of up to 256 numbers. Rotations are the
smallest three components, and alpha states which one is left out. Spherical harmonics are indices into a palette,
itself an image. Version 2 is read and written. Version 1, which has even steps between two bounds in place of
tables, and opacities as logits, is read. GaussForge is not used: damaged files crash its reader, and its writer mixes
up the components of rotations.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import (
    Damage,
    as_tensor,
    check_count,
    damaged,
    logits_of_bytes,
    parsing,
    read_content,
    with_the_largest,
)

META = "meta.json"
"""The part that names the others; alone in a folder with images, the name of the file."""

PALETTE_WIDTH = 64
"""Entries in a row of the palette's image."""

COEFFICIENTS = (0, 3, 8, 15)
"""Coefficients of the spherical harmonics for each number of bands."""

FIRST_TAG = 252
"""Alpha of a rotation whose w is left out; x, y and z follow."""

_BANDS = {PALETTE_WIDTH * width: bands for bands, width in enumerate(COEFFICIENTS)}
_LARGEST_META = 16 << 20
_BYTES_A_PIXEL = 8
_FURTHER_BYTES = 16 << 20
_FURTHER_PIXELS = 1 << 20  # a palette of 65,536 entries with 15 coefficients

_Part = Callable[[str], IO[bytes]]
"""Opens a part by its name."""


def read_sog(path: Path) -> Gaussians:
    """Read a ``.sog`` archive, or an unbundled SOG by its ``meta.json``, in the axes of a PLY.

    Raises:
        FileFormatError: If a part is missing or damaged, larger than its count allows, or of another version.
    """
    with parsing(path, "a SOG of version 1 or 2"):
        try:
            if path.name == META:
                size = sum(file.stat().st_size for file in path.parent.iterdir() if file.suffix == ".webp")
                return _read(path, lambda name: open(path.with_name(name), "rb"), size)
            with zipfile.ZipFile(io.BytesIO(read_content(path, ".sog"))) as archive:
                return _read(path, lambda name: _in_archive(archive, name), path.stat().st_size)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
            raise damaged(path, "a SOG archive", "no whole zip archive") from error


def _in_archive(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    if name not in archive.namelist():
        raise Damage(f"no {name} in the archive")
    return archive.open(name)


def _content(part_of: _Part, name: str, limit: int) -> bytes:
    with part_of(name) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise Damage(f"{name} has more than {limit:,} bytes")
    return content


def _read(path: Path, part_of: _Part, size: int) -> Gaussians:
    meta = json.loads(_content(part_of, META, _LARGEST_META))
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise FileFormatError(
            path,
            expected="SOG of version 1 or 2",
            found=f"version {version!r:.40}",
            remedy="export it as SOG of version 2, or as .ply",
        )
    count = meta["means"]["shape"][0] if version == 1 else meta["count"]
    if type(count) is not int or count < 0:
        raise Damage(f"a count of {count!r:.40}")
    check_count(path, count, size)

    def pixels(part: str, index: int = 0) -> NDArray[np.uint8]:
        return _pixels(part_of, meta[part]["files"][index], count).reshape(-1, 4)

    def picture(part: str, index: int = 0) -> NDArray[np.uint8]:
        return pixels(part, index)[:count]

    turns, low, high = pixels("quats"), pixels("means", 0), pixels("means", 1)
    held = _held(turns, (low, high), count)
    if held != count:
        raise FileFormatError(
            path,
            expected=f"the {count:,} Gaussians of its count",
            found=f"{held:,} in its images",
            remedy="the count is wrong: export the file again",
        )
    table = _table if version == 2 else _even_steps
    sh0, colors = picture("sh0"), table(meta["sh0"])
    logits = logits_of_bytes(sh0[:, 3]) if version == 2 else as_tensor(_looked_up(colors, sh0)[:, 3])
    return Gaussians(
        means=as_tensor(_positions(low[:count], high[:count], meta["means"])),
        quats=as_tensor(_quats(turns[:count])),
        log_scales=as_tensor(_looked_up(table(meta["scales"]), picture("scales")[:, :3])),
        opacity_logits=logits,
        sh0=as_tensor(_looked_up(colors, sh0[:, :3]))[:, None],
        shN=as_tensor(_harmonics(part_of, meta["shN"], picture("shN", 1), table(meta["shN"])))
        if meta.get("shN")
        else torch.zeros(count, 0, 3),
        antialiased=meta.get("model") == "antialiased",
    )


def _pixels(part_of: _Part, name: str, count: int) -> NDArray[np.uint8]:
    """An image ``[H, W, 4]`` of at least ``count`` pixels, and not of many more."""
    if not isinstance(name, str) or Path(name).name != name or "\\" in name:
        raise Damage(f"a part named {str(name)[:80]!r}")
    content = _content(part_of, name, _BYTES_A_PIXEL * count + _FURTHER_BYTES)
    try:
        picture = Image.open(io.BytesIO(content), formats=["WEBP"])
        if not count <= picture.width * picture.height <= 4 * count + _FURTHER_PIXELS:
            raise Damage(f"{name} of {picture.width} x {picture.height} pixels for {count:,}")
        return np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise Damage(f"{name} is no whole WebP image") from error


def _table(part: dict[str, Any]) -> NDArray[np.float32]:
    """The 256 numbers that an image's bytes are indices of ``[256, 1]``; a shorter table ends in NaN."""
    numbers = list(part["codebook"])
    if len(numbers) == 256 and numbers[0] is None:  # early versions of SuperSplat: the steps are nearly equal
        numbers[0] = numbers[1] + (numbers[1] - numbers[255]) / 255
    if not 0 < len(numbers) <= 256:
        raise Damage(f"a codebook of {len(numbers)} numbers")
    table = np.append(np.array(numbers, np.float64), np.full(256 - len(numbers), np.nan))
    return table.astype(np.float32)[:, None]


def _even_steps(part: dict[str, Any]) -> NDArray[np.float32]:
    """The same in version 1 ``[256, 1 | 3 | 4]``, for each channel or for all."""
    first, last = (np.array(part[name], np.float64).reshape(1, -1) for name in ("mins", "maxs"))
    return (first + np.linspace(0, 1, 256)[:, None] * (last - first)).astype(np.float32)


def _looked_up(table: NDArray[np.float32], pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Numbers of the bytes of pixels ``[..., C]``, from a table ``[256, 1]`` or one for each channel."""
    channels = pixels.shape[-1]
    if table.shape[1] not in (1, channels, 4):
        raise Damage(f"bounds of {table.shape[1]} channels for {channels}")
    return table[pixels, np.arange(channels) if table.shape[1] > 1 else 0]


def _positions(low: NDArray[np.uint8], high: NDArray[np.uint8], part: dict[str, Any]) -> NDArray[np.float64]:
    first, last = (np.array(part[name], np.float64).reshape(3) for name in ("mins", "maxs"))
    steps = low[:, :3] + 256.0 * high[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # infinity and NaN are refused later
        values = first + steps / 65535 * (last - first)
        return np.sign(values) * np.expm1(np.abs(values))


def _held(turns: NDArray[np.uint8], places: Sequence[NDArray[np.uint8]], count: int) -> int:
    """Number of Gaussians whose rotations are in an image ``[P, 4]``: no rotation is four zeros.

    What fills up the last rows is not among them: zeros, opaque black, copies of the last Gaussian, which are at the
    same place in the images of positions, and any other constant.
    """
    used, last = np.asarray(turns.any(1)), max(count - 1, 0)
    copies = (turns[count:] == turns[last]).all(1)
    rests = [turns[count:]]
    for picture in places:
        rest = np.zeros_like(turns[count:])
        rest[: max(len(picture) - count, 0)] = picture[count : len(turns)]
        copies &= (rest == picture[last]).all(1)
        rests.append(rest)
    used[count:] = (turns[count:, 3] >= FIRST_TAG) & turns[count:, :3].any(1) & ~copies
    used[len(turns) - _filled(rests) :] = False
    return int(used.nonzero()[0][-1]) + 1 if used.any() else 0


def _filled(pictures: Sequence[NDArray[np.uint8]]) -> int:
    """Length of the constant end of images ``[P, 4]``: of rotations, and of the bytes of positions.

    Where its position is not gray, with other bytes in x, y and z, the first pixel is a Gaussian, copied to the end.
    """
    if not len(pictures[0]):
        return 0
    same = np.asarray(np.concatenate([picture == picture[-1] for picture in pictures], axis=1).all(1))
    length = int(np.append(same[::-1], False).argmin())
    gray = all((picture[-1, :3] == picture[-1, 0]).all() for picture in pictures[1:])
    return length if gray else length - 1


def _quats(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions wxyz, zero where the tag is none of the four."""
    small = (pixels[:, :3] / 255 * 2 - 1) / math.sqrt(2)
    return with_the_largest(small, pixels[:, 3].astype(int) - FIRST_TAG)


def _harmonics(
    part_of: _Part, part: dict[str, Any], labels: NDArray[np.uint8], table: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Coefficients ``[N, 3 | 8 | 15, 3]`` of the palette's entries."""
    picture = _pixels(part_of, part["files"][0], COEFFICIENTS[3])
    bands = part.get("bands", _BANDS.get(picture.shape[1]))  # version 1 has the width of the image alone
    width, entries = COEFFICIENTS[bands] if bands in (1, 2, 3) else 0, part.get("count", 1 << 16)
    if not width or type(entries) is not int or not 0 < entries <= 1 << 16:
        raise Damage(f"a palette of {entries!r:.40} entries with {bands!r:.40} bands")
    if picture.shape[1] != PALETTE_WIDTH * width:
        raise Damage(f"a palette {picture.shape[1]} pixels wide")
    palette = _looked_up(table, picture[..., :3]).reshape(-1, width, 3)
    index = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
    if len(index) and index.max() >= len(palette):
        raise Damage(f"palette entry {index.max()} of {len(palette)}")
    return palette[index]
