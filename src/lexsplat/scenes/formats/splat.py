"""The ``.splat`` format of the web viewers: 32 bytes per Gaussian, no header, no spherical harmonics.

Positions and standard deviations are float32, color and opacity are bytes, and the rotation (wxyz) is stored as bytes
with offset 128. gsplat's writer is not used because it reorders the Gaussians, which invalidates labels by index, and
rounds colors down. The tests check that both agree in everything else.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import as_tensor, damaged, logits_of_bytes, read_content

WITHOUT_MIP_FLAG = (".splat", ".ksplat")
"""Endings of the formats that cannot say whether Gaussians need the mip filter."""

_LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(gaussians: Gaussians, path: Path) -> None:
    """Write a ``.splat`` file; the order of the Gaussians is preserved.

    Raises:
        ValueError: If a value is NaN or infinite.
    """
    g = gaussians.detach().to("cpu")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in g.tensors().values()):
        raise ValueError("the Gaussians contain NaN or infinity")
    colors = torch.cat([g.sh0[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], dim=1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    table = np.zeros(len(g), dtype=_LAYOUT)
    table["mean"], table["scale"] = g.means.numpy(), g.scales.numpy()
    table["rgba"] = (colors * 255).round().clamp(0, 255).numpy()
    table["quat"] = (quats * 128 + 128).round().clamp(0, 255).numpy()
    path.write_bytes(table.tobytes())


def read_splat(path: Path) -> Gaussians:
    """Read a ``.splat`` file.

    Raises:
        FileFormatError: If the file size is not a multiple of 32 bytes or a size is negative.
    """
    content = read_content(path, ".splat")
    if not content or len(content) % _LAYOUT.itemsize:
        raise damaged(path, f"a multiple of {_LAYOUT.itemsize} bytes", f"{len(content)} bytes")
    table = np.frombuffer(content, dtype=_LAYOUT)
    if (table["scale"] < 0).any():
        raise FileFormatError(
            path,
            expected="sizes of 0 or more",
            found="negative ones: not a .splat file",
            remedy="give the file the ending of its format",
        )
    with np.errstate(divide="ignore"):  # the logarithm of 0 is minus infinity
        log_scales = np.log(table["scale"])
    rgba = as_tensor(table["rgba"][:, :3]) / 255
    return Gaussians(
        means=as_tensor(table["mean"]),
        quats=(as_tensor(table["quat"]) - 128) / 128,
        log_scales=as_tensor(log_scales),
        opacity_logits=logits_of_bytes(table["rgba"][:, 3]),
        sh0=((rgba - 0.5) / SH_C0)[:, None, :],
        shN=torch.zeros(len(table), 0, 3),
    )
