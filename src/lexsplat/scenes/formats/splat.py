"""The ``.splat`` format of the web viewers: 32 bytes a Gaussian, no header, no spherical harmonics.

Position and standard deviations as float32, color and opacity as bytes, rotation (wxyz) as bytes around 128.
gsplat has a writer too; it changes the order of the Gaussians and rounds colors down, so labels by index would
no longer fit the file. The tests hold that both agree in everything else.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.runtime.errors import FileFormatError

_LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(gaussians: Gaussians, path: Path) -> None:
    """Write a ``.splat`` file; the order of the Gaussians stays.

    Raises:
        ValueError: If a value is not finite.
    """
    g = gaussians.detach().to("cpu")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in g.tensors().values()):
        raise ValueError("a Gaussian has a value that is not finite")
    colors = torch.cat([g.sh0[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], dim=1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    table = np.zeros(len(g), dtype=_LAYOUT)
    table["mean"], table["scale"] = g.means.numpy(), g.scales.numpy()
    table["rgba"] = (colors * 255).round().clamp(0, 255).numpy()
    table["quat"] = (quats * 128 + 128).round().clamp(0, 255).numpy()
    path.write_bytes(table.tobytes())


def read_splat(path: Path) -> Gaussians:
    """Read a ``.splat`` file.

    Opacities of 0 and 255 become those of a quarter of a step inside, as a logit has no end.

    Raises:
        FileFormatError: If its size does not fit, or it holds numbers that are not finite or not positive.
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
        raise FileFormatError(path, expected="finite positions and sizes", found="others: not a .splat file")
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
        raise FileFormatError(path, expected="positions and sizes of a scene", found=damage)
    return gaussians
