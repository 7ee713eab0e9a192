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

    Opacity bytes 0 and 255 are read as 0.25 and 254.75, because the logits of opacities 0 and 1 are infinite.

    Raises:
        FileFormatError: If the file size is not a multiple of 32 bytes, a position or size is NaN or infinite, or a
            size is negative.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, expected="a readable .splat file", found=str(error.strerror)) from error
    if not content or len(content) % _LAYOUT.itemsize:
        raise FileFormatError(
            path, expected=f"a multiple of {_LAYOUT.itemsize} bytes", found=f"{len(content)} bytes"
        )
    table = np.frombuffer(content, dtype=_LAYOUT)
    means, scales = (torch.from_numpy(table[name].astype(np.float32)) for name in ("mean", "scale"))
    if not (torch.isfinite(means).all() and torch.isfinite(scales).all() and (scales >= 0).all()):
        raise FileFormatError(
            path, expected="finite positions and sizes", found="other values: not a .splat file"
        )
    rgba = torch.from_numpy(table["rgba"].astype(np.float32)) / 255
    quats = (torch.from_numpy(table["quat"].astype(np.float32)) - 128) / 128
    quats[quats.norm(dim=1) < 1e-3] = torch.tensor([1.0, 0, 0, 0])
    gaussians = Gaussians(
        means=means,
        quats=quats,
        log_scales=scales.clamp_min(1e-12).log(),
        opacity_logits=rgba[:, 3].clamp(0.25 / 255, 1 - 0.25 / 255).logit(),
        sh0=((rgba[:, :3] - 0.5) / SH_C0)[:, None, :],
        shN=torch.zeros(len(table), 0, 3),
    )
    damage = gaussians.find_invalid()
    if damage:
        raise FileFormatError(path, expected="valid Gaussians", found=damage)
    return gaussians
