"""SPZ, Niantic's compressed splats (github.com/nianticlabs/spz): versions 2 to 4 are read, 3 and 4 written.

A file holds streams of bytes, one a property: positions as 24-bit fixed-point numbers, logarithms of scales in steps
of 1/16, opacities and colors in 8 bits, rotations by their smallest three components, spherical harmonics in 8 bits.
Versions 2 and 3 are one gzip stream, version 4 has a zstd stream for each. GaussForge and its copy of Niantic's code
are not used: damaged headers of version 4 make it take gigabytes, and it drops the antialiasing flag.

The axes are y up and z backward; those of a PLY are y down and z forward. The two differ by half a turn about x.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import (
    AGAIN,
    Damage,
    as_tensor,
    check_count,
    logits_of_bytes,
    parsing,
    read_content,
    warn,
    with_the_largest,
    without_the_largest,
)
from lexsplat.scenes.transforms import transformed

logger = logging.getLogger("lexsplat")

HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Rotation between the axes of SPZ and those of a PLY."""

_AXES_EXTENSION = 0xADBE0003
"""Adobe's extension that names the axes: a number, 0 for those of SPZ, else 1 plus an index of `_AXES`."""
_AXES = (
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU",
)  # fmt: skip
_DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "D": (0, 1, 0),
    "U": (0, -1, 0),
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}
"""Right, left, down, up, forward and backward in the axes of a PLY."""

_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, streams
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # the same, and where the table of contents begins
_MAGIC = b"NGSP"
_ANTIALIASED, _EXTENSIONS = 1, 2
_COLOR_SCALE = 0.15
_MOST_FRACTIONAL_BITS = 30
_MOST_DEGREE = 4
_MOST_EXTENSIONS = 1 << 20
_FIXED_LIMIT = (1 << 23) - 1
_COARSE = 0.25
"""Largest step of centers, as a share of the standard deviation of a Gaussian."""
_ROUGH_BITS = {1: 5, 2: 4, 3: 4, 4: 4}
"""Bits kept of the spherical harmonics of each degree, as Niantic's writer does: the rest compresses away."""


def _layout(version: int, degree: int) -> dict[str, int]:
    """Bytes a Gaussian of every stream, in the order of the file."""
    sizes = {"positions": 9, "alphas": 1, "colors": 3, "scales": 3, "rotations": 3 if version == 2 else 4}
    return sizes | ({"sh": 3 * ((degree + 1) ** 2 - 1)} if degree else {})


def read_spz(path: Path) -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4, in the axes of a PLY.

    Raises:
        FileFormatError: If the file is damaged or has another version.
    """
    content = read_content(path, ".spz")
    with parsing(path, "an SPZ file", zstandard.ZstdError):
        head = zlib.decompressobj(31).decompress(content, 16) if content[:2] == b"\x1f\x8b" else content[:32]
        if len(head) < _HEADER.size:
            raise Damage(f"a header of {len(head)} bytes")
        magic, version, count, degree, bits, flags, _ = _HEADER.unpack_from(head)
        _check_supported(magic, version, content[:2] == b"\x1f\x8b", degree, bits, path)
        check_count(path, count, len(content))
        layout = _layout(version, degree)
        sizes = {name: size * count for name, size in layout.items()}
        if version == 4:
            streams = _inflated_4(content, sizes)
            extensions = content[_HEADER_4.size : _HEADER_4.unpack_from(content)[-1]]
        else:
            streams, extensions = _inflated(content, sizes, bool(flags & _EXTENSIONS))
    rotation = _rotation(extensions, path) if flags & _EXTENSIONS else HALF_TURN
    arrays = {
        name: np.frombuffer(data, np.uint8).reshape(count, layout[name]) for name, data in streams.items()
    }
    gaussians = _unpacked(arrays, version, bits, bool(flags & _ANTIALIASED))
    return transformed(gaussians, rotation=rotation)


def _rotation(extensions: bytes, path: Path) -> NDArray[np.float64]:
    """Rotation from the axes of the file, which an extension may name, to those of a PLY ``[3, 3]``.

    Left-handed axes are refused: the splats would have to be mirrored.
    """
    rotation, place = HALF_TURN, 0
    while place + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, place)
        value = extensions[place + 8 : place + 8 + length]
        place += 8 + length
        if kind != _AXES_EXTENSION:
            warn("%s: its extensions are ignored, except for axes", path)
            continue
        number = int.from_bytes(value, "little")
        axes = _AXES[number - 1] if 0 < number <= len(_AXES) else "RUB"
        rotation = np.array([_DIRECTIONS[letter] for letter in axes], np.float64).T
        if number > len(_AXES) or np.linalg.det(rotation) < 0:
            raise FileFormatError(
                path,
                expected="right-handed axes, such as RUB",
                found=f"axes number {number}" if number > len(_AXES) else f"{axes}, which are left-handed",
                remedy="export it with other axes, or as .ply",
            )
    return rotation


def _check_supported(magic: bytes, version: int, packed: bool, degree: int, bits: int, path: Path) -> None:
    """Refuse files of another program or version, and headers that are invalid in every version."""
    remedy = "export it as SPZ of one of these versions, or as .ply"
    if magic != _MAGIC or version not in ((2, 3) if packed else (4,)):
        expected, found = "SPZ of version 2 or 3 in gzip, or 4", f"version {version}"
        if magic != _MAGIC:
            found = "another file"
        elif version in (2, 3, 4):
            found += " in gzip" if packed else " without gzip"
    elif degree > _MOST_DEGREE:
        expected, found = f"spherical harmonics of degree 0 to {_MOST_DEGREE}", f"degree {degree}"
        remedy = AGAIN
    elif bits > _MOST_FRACTIONAL_BITS:
        expected, found = f"centers with 0 to {_MOST_FRACTIONAL_BITS} bits behind the point", f"{bits}"
        remedy = AGAIN
    else:
        return
    raise FileFormatError(path, expected=expected, found=found, remedy=remedy)


def _inflated(content: bytes, sizes: dict[str, int], extended: bool) -> tuple[dict[str, bytes], bytes]:
    """The streams of versions 2 and 3, and what follows them: only extensions, if the header has their flag.

    More data than the count allows is refused: the streams would be read at wrong places.
    """
    stream, size = zlib.decompressobj(31), _HEADER.size + sum(sizes.values())
    data = stream.decompress(content, size)
    rest = stream.decompress(stream.unconsumed_tail, _MOST_EXTENSIONS)
    if len(data) < size or (not stream.eof and len(rest) < _MOST_EXTENSIONS):
        raise Damage("the file is cut")
    if not (stream.eof and _are_extensions(rest) if extended else not rest):
        more = f"{len(rest):,}{'' if stream.eof else ' or more'}"
        raise Damage(f"{more} bytes after the {sizes['alphas']:,} Gaussians of its count")
    if stream.unused_data:
        raise Damage(f"{len(stream.unused_data):,} bytes after its end")
    streams, start = {}, _HEADER.size
    for name, size in sizes.items():
        streams[name] = data[start : start + size]
        start += size
    return streams, rest


def _are_extensions(data: bytes) -> bool:
    """Whether data is a list of extensions: number, length and content of each."""
    place = 0
    while place + 8 <= len(data):
        place += 8 + int.from_bytes(data[place + 4 : place + 8], "little")
    return place == len(data)


def _inflated_4(content: bytes, sizes: dict[str, int]) -> dict[str, bytes]:
    """The streams of version 4."""
    *_, number, contents = _HEADER_4.unpack_from(content)
    start, count = contents + 16 * number, sizes["alphas"]
    if contents < _HEADER_4.size:
        raise Damage(f"a table of contents at byte {contents}, within the header")
    if number != len(sizes):
        raise Damage(f"{number} streams instead of {len(sizes)}")
    streams = {}
    for index, (name, size) in enumerate(sizes.items()):
        packed, unpacked = struct.unpack_from("<QQ", content, contents + 16 * index)
        if unpacked != size:
            raise Damage(
                f"{unpacked:,} bytes of {name} instead of {size:,} for the {count:,} Gaussians of its count"
            )
        if start + packed > len(content):
            raise Damage("the file is cut")
        with zstandard.ZstdDecompressor().stream_reader(content[start : start + packed]) as reader:
            streams[name] = reader.read(size + 1) if size else b""
        if len(streams[name]) != size:
            raise Damage(f"other {name} than those of {count:,} Gaussians")
        start += packed
    if start != len(content):
        raise Damage(f"{len(content) - start:,} bytes after its end")
    return streams


def _unpacked(arrays: dict[str, NDArray[np.uint8]], version: int, bits: int, antialiased: bool) -> Gaussians:
    """The Gaussians of the streams ``[N, bytes]``, in the axes of SPZ."""
    count = len(arrays["alphas"])
    padded = np.zeros((count, 3, 4), np.uint8)
    padded[..., 1:] = arrays["positions"].reshape(count, 3, 3)
    fixed = padded.view("<i4")[..., 0] >> 8
    sh = arrays.get("sh", np.zeros((count, 0), np.uint8))
    return Gaussians(
        means=as_tensor(np.ldexp(fixed.astype(np.float64), -bits)),
        quats=as_tensor(_quats_2(arrays["rotations"]) if version == 2 else _quats(arrays["rotations"])),
        log_scales=as_tensor(arrays["scales"] / 16 - 10),
        opacity_logits=logits_of_bytes(arrays["alphas"][:, 0]),
        sh0=as_tensor((arrays["colors"] / 255 - 0.5) / _COLOR_SCALE)[:, None],
        shN=as_tensor((sh.reshape(count, sh.shape[1] // 3, 3).astype(np.float32) - 128) / 128),
        antialiased=antialiased,
    )


def _quats_2(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions wxyz of version 2: x, y and z in 8 bits each; w is positive."""
    xyz = packed / 127.5 - 1
    return np.column_stack([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1))), xyz])


def _quats(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Quaternions wxyz of versions 3 and 4: which of xyzw is largest (2 bits), the others in 10 bits each."""
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = words >> 30
    fields = np.stack([words >> 20, words >> 10, words], 1) & 1023
    small = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * math.sqrt(0.5)
    return with_the_largest(small, largest)[:, [3, 0, 1, 2]]


def write_spz(gaussians: Gaussians, path: Path, *, version: int = 4) -> None:
    """Write an SPZ file; the order of the Gaussians is preserved.

    Args:
        gaussians: Gaussians in the axes of a PLY.
        path: The file.
        version: 4, or 3 for programs that read no newer one.

    All centers have the precision that the farthest one leaves. A warning follows if it is too coarse for the others.

    Raises:
        ValueError: If a value is NaN or infinite, a center is farther than 8,388,607 units from the origin, or the
            version is neither 3 nor 4.
    """
    if version not in (3, 4):
        raise ValueError(f"version must be 3 or 4, got {version}")
    g = transformed(gaussians.detach().to("cpu"), rotation=HALF_TURN)
    if not all(bool(torch.isfinite(tensor).all()) for tensor in g.tensors().values()):
        raise ValueError("the Gaussians contain NaN or infinity")
    farthest = _farthest(g)
    if farthest > _FIXED_LIMIT:
        raise ValueError(
            f"SPZ holds centers up to {_FIXED_LIMIT:,} units from the origin, got {farthest:,.0f}"
        )
    bits = _fractional_bits(farthest)
    if is_coarse(g):
        logger.warning(
            "%s: centers are rounded to %.3g units, which is coarse for these Gaussians, because one is %.3g units "
            "away; write .ply or .sog, or delete what is far away",
            path, math.ldexp(1, -bits), farthest,
        )  # fmt: skip
    streams = {name: array.tobytes() for name, array in _packed(g, bits).items()}
    fields = (_MAGIC, version, len(g), g.sh_degree, bits, _ANTIALIASED if g.antialiased else 0)
    if version == 3:
        content = _HEADER.pack(*fields, 0) + b"".join(streams.values())
        path.write_bytes(gzip.compress(content, mtime=0))
        return
    # Without a checksum, nearly any changed byte would be read as other values. Other readers of zstd know it.
    packed = {
        name: zstandard.ZstdCompressor(level=12, write_checksum=True).compress(data)
        for name, data in streams.items()
    }
    table = b"".join(struct.pack("<QQ", len(packed[name]), len(data)) for name, data in streams.items())
    header = _HEADER_4.pack(*fields, len(streams), _HEADER_4.size)
    path.write_bytes(header + table + b"".join(packed.values()))


def is_coarse(gaussians: Gaussians) -> bool:
    """Whether SPZ rounds centers by more than a quarter of the size of half of the Gaussians, or cannot hold them."""
    if len(gaussians) == 0:
        return False
    farthest = _farthest(gaussians)
    size = float(gaussians.scales.median(1).values.median())
    return farthest > _FIXED_LIMIT or math.ldexp(1, -_fractional_bits(farthest)) > _COARSE * size


def _farthest(gaussians: Gaussians) -> float:
    """Largest coordinate of a center."""
    return max(float(gaussians.means.abs().max()) if len(gaussians) else 0.0, 1e-6)


def _fractional_bits(farthest: float) -> int:
    """Bits behind the point with which 24 bits hold the farthest coordinate."""
    return min(math.floor(math.log2(_FIXED_LIMIT / farthest)), 23)


def _packed(g: Gaussians, bits: int) -> dict[str, NDArray]:
    """The streams of versions 3 and 4, in the order of the file."""
    fixed = np.round(np.ldexp(g.means.double().numpy(), bits)).clip(-_FIXED_LIMIT, _FIXED_LIMIT)
    arrays = {
        "positions": fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3],
        "alphas": _bytes(g.opacities * 255),
        "colors": _bytes((g.sh0[:, 0] * _COLOR_SCALE + 0.5) * 255),
        "scales": _bytes((g.log_scales + 10) * 16),
        "rotations": _packed_quats(torch.nn.functional.normalize(g.quats.double(), dim=1).numpy()),
    }
    if g.sh_degree:
        degrees = np.repeat(np.arange(1, g.sh_degree + 1), 2 * np.arange(1, g.sh_degree + 1) + 1)
        steps = np.array([1 << (8 - _ROUGH_BITS[int(degree)]) for degree in degrees])[:, None]
        values = np.round(g.shN.double().numpy() * 128) + 128
        arrays["sh"] = (np.floor((values + steps // 2) / steps) * steps).clip(0, 255).astype(np.uint8)
    return arrays


def _bytes(values: Tensor) -> NDArray[np.uint8]:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def _packed_quats(quats: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Quaternions wxyz of unit length in 32 bits each; see `_quats`."""
    small, largest = without_the_largest(quats[:, [1, 2, 3, 0]])
    fields = np.round(np.abs(small) * math.sqrt(2) * 511).clip(0, 511).astype(np.uint32)
    fields |= np.where(small < 0, 512, 0).astype(np.uint32)
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words.astype("<u4")
