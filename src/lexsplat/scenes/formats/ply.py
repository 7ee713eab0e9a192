"""The PLY of 3D Gaussian Splatting, one property per value.

`write_ply` writes binary little endian and float32, in the order of the original 3DGS. Readers take ASCII and big
endian as well, and find columns by name: their order does not matter, and unknown columns are ignored.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import EXPORT_AGAIN, as_tensor, damaged, reading, rounded_centers, warn
from lexsplat.scenes.formats.ply_elements import (
    SPLATS,
    Element,
    byte_order,
    data_left,
    header_lines,
    parse_elements,
    uneven_line,
    warn_of_ignored,
)

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
        raise damaged(path, "finite numbers", damage, EXPORT_AGAIN)
    return gaussians


def parse_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY with whatever numbers it has, NaN and infinity included.

    Raises:
        FileFormatError: If the file is not a PLY of 3D Gaussians, is truncated, or has more data than it declares.
    """
    with reading(path, "PLY"), open(path, "rb") as file:
        lines = header_lines(file, path)
        order, elements = byte_order(lines, path), parse_elements(lines, path)
        vertices = _vertices(elements, path)
        available = os.path.getsize(path) - file.tell()
        least = vertices.count * vertices.row_size(order) * (1 if order else 2)  # a digit and a space
        if available < least:
            raise damaged(
                path,
                f"{vertices.count} Gaussians in {least} bytes",
                f"{available} bytes of data",
                "the file is truncated: copy it again or export it again",
            )
        table, left = (_binary_rows if order else _text_rows)(file, elements, order, path)
        _check_left(left, vertices, order, path)
        warn_of_ignored(elements[1:], vertices.count, path)
        return _gaussians_from_table(table, is_antialiased(lines), path)


def _check_left(left: int, vertices: Element, order: str, path: Path) -> None:
    """Refuse data that no element declares, or that an element lacks: counts and data disagree.

    Less than a row cannot be a Gaussian, and is a warning.
    """
    if left < 0 or left >= vertices.row_size(order):
        kind = "bytes" if order else "numbers"
        more = f"{left:,} {kind} after the last one" if left > 0 else f"fewer {kind} in its other elements"
        raise FileFormatError(
            path,
            expected=f"the {vertices.count:,} Gaussians that the header declares",
            found=more,
            remedy="the count or the data is wrong: export the file again",
        )
    if left:
        warn("%s: %d %s after the last Gaussian are ignored", path, left, "bytes" if order else "numbers")


def is_antialiased(lines: Sequence[str]) -> bool:
    """Whether the last comment on it in a header states that the Gaussians were trained with the mip filter."""
    modes = [_MODES[line] for line in lines if line in _MODES]
    return bool(modes) and modes[-1]


def _binary_rows(
    file: BinaryIO, elements: Sequence[Element], order: str, path: Path
) -> tuple[np.ndarray, int]:
    """The Gaussians, and how many bytes are left after all elements."""
    vertices = elements[0]
    dtype = np.dtype([(name, order + kind) for name, kind, _ in vertices.columns])
    table = np.frombuffer(file.read(vertices.count * dtype.itemsize), dtype=dtype)
    available = os.path.getsize(path) - file.tell()
    return table, data_left(elements[1:], order, available, file.read)


def _text_rows(file: BinaryIO, elements: Sequence[Element], order: str, path: Path) -> tuple[np.ndarray, int]:
    """The Gaussians, and how many numbers are left after all elements."""
    vertices = elements[0]
    wanted = vertices.count * len(vertices.columns)
    text = file.read()
    with warnings.catch_warnings():  # numpy before 2.3 warns of text that is no number, and stops there
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers, found = np.fromstring(text, np.float64, sep=" "), ""
        except (ValueError, DeprecationWarning):
            numbers, found = np.zeros(0), "text that is no number"
    if found or len(numbers) < wanted:
        raise FileFormatError(
            path,
            expected=f"{wanted} numbers",
            found=found or f"{len(numbers)}",
            remedy="the file is truncated or damaged: copy it again or export it again",
        )
    rows = numbers[:wanted].reshape(vertices.count, len(vertices.columns))
    table = np.zeros(
        vertices.count, [(name, "<f8" if name in "xyz" else "<f4") for name, _, _ in vertices.columns]
    )
    with np.errstate(over="ignore"):  # infinity is looked for later
        for index, (name, _, _) in enumerate(vertices.columns):
            table[name] = rows[:, index]
    rest = numbers[wanted:]
    left = data_left(elements[1:], order, len(rest), lambda: rest)
    if 0 <= left < len(vertices.columns):  # otherwise, `_check_left` states what is wrong
        _check_lines(text, vertices, path)
    return table, left


def _check_lines(text: bytes, vertices: Element, path: Path) -> None:
    """Refuse rows that do not have a line each, whose numbers would be read shifted."""
    if uneven := uneven_line(text, vertices.count, len(vertices.columns)):
        header = path.read_bytes()[: -len(text)].count(b"\n")
        raise FileFormatError(
            path,
            expected=f"the {len(vertices.columns)} numbers of a Gaussian in each line",
            found=f"{uneven[1]:,} numbers in line {header + uneven[0] + 1:,}",
            remedy="the file is damaged: copy it again or export it again",
        )
    if vertices.count and not text[-1:].isspace():
        warn("%s: no line end after the last number, which may lack digits", path)


def _vertices(elements: Sequence[Element], path: Path) -> Element:
    """The Gaussians among the elements, which come first."""
    if not elements or elements[0].name != "vertex" or elements[0].has_lists:
        found = f"'element {elements[0].name}'"[:80] if elements else "none"
        raise FileFormatError(
            path, expected="'element vertex COUNT' first, without lists", found=found, remedy=SPLATS
        )
    names = [name for name, _, _ in elements[0].columns]
    missing = [name for name in (*_REQUIRED, "f_dc_0", "f_dc_1", "f_dc_2") if name not in names]
    if missing or len(set(names)) != len(names):
        found = f"no {', '.join(missing)}" if missing else "a duplicate property"
        raise FileFormatError(path, expected="the properties of 3D Gaussians", found=found, remedy=SPLATS)
    return elements[0]


def _gaussians_from_table(table: np.ndarray, antialiased: bool, path: Path) -> Gaussians:
    def columns(*names: str) -> torch.Tensor:
        with np.errstate(over="ignore"):  # infinity is looked for later
            stacked = [table[name].astype(np.float32) for name in names]
        return torch.from_numpy(
            np.stack(stacked, axis=1) if len(table) else np.zeros((0, len(names)), np.float32)
        )

    num_rest = sum(1 for name in table.dtype.names or () if name.startswith("f_rest_"))
    complete = all(f"f_rest_{i}" in (table.dtype.names or ()) for i in range(num_rest))
    if num_rest not in (0, 9, 24, 45, 72) or not complete:
        found = str(num_rest) if complete else "gaps in their numbering"
        raise damaged(path, "0, 9, 24, 45 or 72 f_rest properties", found, EXPORT_AGAIN)
    rest = columns(*(f"f_rest_{i}" for i in range(num_rest))) if num_rest else torch.zeros(len(table), 0)
    log_scales = columns("scale_0", "scale_1", "scale_2")
    places = np.stack([table[name] for name in "xyz"], axis=1)
    return Gaussians(
        means=as_tensor(places) if places.dtype == "f4" else rounded_centers(places, log_scales, path),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=log_scales,
        opacity_logits=columns("opacity")[:, 0],
        sh0=columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :],
        shN=rest.reshape(len(table), 3, num_rest // 3).transpose(1, 2).contiguous(),
        antialiased=antialiased,
    )
