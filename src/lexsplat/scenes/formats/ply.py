"""The PLY of 3D Gaussian Splatting, one property per value.

`write_ply` writes binary little endian and float32, in the order of the original 3DGS. Readers take ASCII and big
endian as well, and find columns by name: their order does not matter, and unknown columns are ignored.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ENCODINGS = {
    "format ascii 1.0": "",
    "format binary_little_endian 1.0": "<",
    "format binary_big_endian 1.0": ">",
}
_MAX_HEADER_BYTES = 1 << 16
MIP = "comment SplatRenderMode: mip"
"""The line of Gaussians trained with the mip filter, as Brush, SuperSplat and splat-transform write and read it."""
_MODES = {MIP: True, "comment SplatRenderMode: default": False, "comment SplatRenderMode: 2dgs": False}
_MODES |= {"comment antialiased 1": True, "comment antialiased 0": False}  # Postshot, and lexsplat before
_REQUIRED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def _properties(num_rest: int) -> list[str]:
    """Names of the columns in the order of the original 3DGS writer; ``num_rest`` is the number of ``f_rest_*``."""
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(num_rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def write_ply(gaussians: Gaussians, path: Path, *, further: Mapping[str, torch.Tensor] | None = None) -> None:
    """Write the standard 3DGS PLY, readable by every splat viewer.

    The file holds log scales and opacity logits. ``f_rest`` is channel-major as in the original files: all red
    coefficients, then green, then blue.

    Args:
        gaussians: Gaussians to write, on any device.
        path: The file; overwritten, and not atomically (see `lexsplat.runtime.files.atomic_path`).
        further: Additional properties by name, ``[N]`` each, uint8 or float, written after the standard ones. Other
            readers ignore them.

    Raises:
        ValueError: If a value is NaN or infinite.
    """
    g = gaussians.detach().to("cpu")
    rest = g.shN.transpose(1, 2).flatten(1)
    columns = [
        g.means, torch.zeros(len(g), 3), g.sh0[:, 0], rest,
        g.opacity_logits[:, None], g.log_scales, g.quats,
    ]  # fmt: skip
    table = torch.cat(columns, dim=1).numpy().astype("<f4")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise ValueError(f"{int(bad.sum())} of {len(g)} Gaussians contain NaN or infinity")
    names = _properties(rest.shape[1])
    header = ["ply", "format binary_little_endian 1.0"]
    if g.antialiased:
        header.append(MIP)
    header += [f"element vertex {len(g)}", *(f"property float {name}" for name in names)]
    rows: np.ndarray = table
    if further:
        layout: list[tuple] = [("standard", "<f4", table.shape[1])]
        layout += [(name, "u1" if t.dtype == torch.uint8 else "<f4") for name, t in further.items()]
        rows = np.zeros(len(g), dtype=layout)
        rows["standard"] = table
        for name, values in further.items():
            rows[name] = values.cpu().numpy()
        header += [
            f"property {'uchar' if t.dtype == torch.uint8 else 'float'} {name}" for name, t in further.items()
        ]
    with open(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY; every number must be finite.

    Raises:
        FileFormatError: If the file is not a PLY of 3D Gaussians, is truncated, or contains NaN or infinity.
    """
    gaussians = parse_ply(path)
    damage = gaussians.find_invalid()
    if damage:
        raise FileFormatError(path, expected="finite numbers", found=damage, remedy="regenerate the file")
    return gaussians


def parse_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY with whatever numbers it has, NaN and infinity included.

    Raises:
        FileFormatError: If the file is not a PLY of 3D Gaussians or is truncated.
    """
    try:
        with open(path, "rb") as file:
            lines = header_lines(file, path)
            header = _parse_header(lines, path)
            available = os.path.getsize(path) - file.tell()
            if available < header.least_bytes:
                raise FileFormatError(
                    path,
                    expected=f"{header.count} Gaussians in {header.least_bytes} bytes",
                    found=f"{available} bytes of data",
                    remedy="the file is truncated: copy it again or regenerate it",
                )
            read = _binary_rows if header.order else _text_rows
            return _gaussians_from_table(read(file, header, path), is_antialiased(lines), path)
    except OSError as error:
        raise FileFormatError(path, expected="a readable PLY file", found=str(error.strerror)) from error


def is_antialiased(lines: Sequence[str]) -> bool:
    """Whether the last comment on it in a header says that the Gaussians were trained with the mip filter."""
    modes = [_MODES[line] for line in lines if line in _MODES]
    return bool(modes) and modes[-1]


@dataclass(frozen=True)
class _Header:
    """The vertices of a PLY: their number, columns, and byte order ("" for text)."""

    count: int
    columns: Sequence[tuple[str, str]]
    order: str

    @property
    def dtype(self) -> np.dtype:
        return np.dtype([(name, (self.order or "<") + kind) for name, kind in self.columns])

    @property
    def least_bytes(self) -> int:
        return self.count * (self.dtype.itemsize if self.order else 2 * len(self.columns))


def _binary_rows(file: BinaryIO, header: _Header, path: Path) -> np.ndarray:
    return np.frombuffer(file.read(header.count * header.dtype.itemsize), dtype=header.dtype)


def _text_rows(file: BinaryIO, header: _Header, path: Path) -> np.ndarray:
    wanted = header.count * len(header.columns)
    text = file.read()
    with warnings.catch_warnings():  # numpy warns of text that is no number
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            numbers = np.fromstring(text, np.float64, sep=" ")[:wanted]
        except ValueError:
            numbers = np.zeros(0)
    # A number that ends with the file may lack digits.
    if len(numbers) < wanted or (wanted and not text[-1:].isspace()):
        raise FileFormatError(
            path,
            expected=f"{wanted} numbers, each with a space or line break after it",
            found=f"{len(numbers)} whole numbers",
            remedy="the file is truncated or damaged: copy it again or regenerate it",
        )
    with np.errstate(over="ignore"):  # infinity is looked for later
        rows = numbers.astype(np.float32).reshape(header.count, len(header.columns))
    table = np.zeros(header.count, [(name, "<f4") for name, _ in header.columns])
    for index, (name, _) in enumerate(header.columns):
        table[name] = rows[:, index]
    return table


def header_lines(file: BinaryIO, path: Path) -> list[str]:
    """The lines of a PLY header up to ``end_header``, without line ends.

    Raises:
        FileFormatError: If the file does not begin with one.
    """
    lines: list[str] = []
    consumed = 0
    while not lines or lines[-1] != "end_header":
        raw = file.readline(1024)
        consumed += len(raw)
        if not raw.endswith(b"\n") or consumed > _MAX_HEADER_BYTES or (not lines and raw.strip() != b"ply"):
            raise FileFormatError(
                path, expected="a PLY header", found=repr(raw[:20]), remedy="use a .ply of 3D Gaussians"
            )
        lines.append(raw.decode("ascii", "replace").strip())
    return lines


def _parse_header(lines: Sequence[str], path: Path) -> _Header:
    order = next((_ENCODINGS[line] for line in lines if line in _ENCODINGS), None)
    if order is None:
        found = next((line for line in lines if line.startswith("format")), "no format line")
        raise FileFormatError(path, expected=" or ".join(_ENCODINGS), found=found)
    elements = [line.split() for line in lines if line.startswith("element ")]
    if not elements or len(elements[0]) != 3 or elements[0][1] != "vertex" or not elements[0][2].isdecimal():
        raise FileFormatError(
            path, expected="'element vertex COUNT' as the first element", found=str(elements)
        )
    start = next(i for i, line in enumerate(lines) if line.startswith("element "))
    columns = []
    for line in lines[start + 1 :]:
        if line.startswith(("comment", "obj_info")):
            continue
        if not line.startswith("property "):
            break
        parts = line.split()
        if len(parts) != 3 or parts[1] not in _TYPES:
            raise FileFormatError(path, expected="scalar properties", found=repr(line))
        columns.append((parts[2], _TYPES[parts[1]]))
    names = [name for name, _ in columns]
    missing = [name for name in (*_REQUIRED, "f_dc_0", "f_dc_1", "f_dc_2") if name not in names]
    if missing or len(set(names)) != len(names):
        found = f"no {', '.join(missing)}" if missing else "a duplicate property"
        raise FileFormatError(path, expected="the properties of 3D Gaussians", found=found)
    return _Header(int(elements[0][2]), columns, order)


def _gaussians_from_table(table: np.ndarray, antialiased: bool, path: Path) -> Gaussians:
    def columns(*names: str) -> torch.Tensor:
        stacked = [table[name].astype(np.float32) for name in names]
        return torch.from_numpy(
            np.stack(stacked, axis=1) if len(table) else np.zeros((0, len(names)), np.float32)
        )

    num_rest = sum(1 for name in table.dtype.names or () if name.startswith("f_rest_"))
    complete = all(f"f_rest_{i}" in (table.dtype.names or ()) for i in range(num_rest))
    if num_rest not in (0, 9, 24, 45, 72) or not complete:
        found = str(num_rest) if complete else "gaps in their numbering"
        raise FileFormatError(path, expected="0, 9, 24, 45 or 72 f_rest properties", found=found)
    rest = columns(*(f"f_rest_{i}" for i in range(num_rest))) if num_rest else torch.zeros(len(table), 0)
    return Gaussians(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        opacity_logits=columns("opacity")[:, 0],
        sh0=columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :],
        shN=rest.reshape(len(table), 3, num_rest // 3).transpose(1, 2).contiguous(),
        antialiased=antialiased,
    )
