"""The splats of a page: SPZ where the library for it is installed, else PLY."""

from __future__ import annotations

import contextlib
import gzip
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats.compressed import write_compressed
from lexsplat.scenes.formats.ply import write_ply

IDENTITY = (0.0, 0.0, 0.0, 1.0)
_HALF_TURN = (1.0, 0.0, 0.0, 0.0)
"""Rotation xyzw from the axes of SPZ (y up, z backward) to those of the scene."""


def write_splats(gaussians: Gaussians, folder: Path) -> tuple[Path, tuple[float, float, float, float]]:
    """Write the splats into a folder, in the order given.

    SPZ is taken if GaussForge is installed, has kept the order, and its centers are near the true ones; else PLY.

    Returns:
        The file, and the rotation xyzw from its axes to those of the scene.
    """
    path = folder / "scene.spz"
    with contextlib.suppress(BackendError, FileFormatError):
        write_compressed(gaussians, path, "spz")
        if _in_order(gaussians.means.detach().cpu(), path.read_bytes()):
            return path, _HALF_TURN
    path.unlink(missing_ok=True)
    path = folder / "scene.ply"
    write_ply(gaussians, path)
    return path, IDENTITY


def _in_order(means: Tensor, content: bytes) -> bool:
    """Whether an SPZ file holds these centers ``[N, 3]``, in this order, within a thousandth of the scene's extent.

    SPZ (github.com/nianticlabs/spz): gzip; a header of magic, version, count, degree, fractional bits, flags; then
    the centers as 24-bit fixed-point numbers.
    """
    raw = gzip.decompress(content)
    magic, version, count, _, fraction = struct.unpack_from("<4sIIBB", raw)
    if magic != b"NGSP" or version not in (2, 3) or count != len(means):
        return False
    parts = np.frombuffer(raw, np.uint8, 9 * count, 16).reshape(-1, 3, 3).astype(np.int32)
    fixed = parts @ np.array([1, 1 << 8, 1 << 16], np.int32)
    centers = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / (1 << fraction) * [1, -1, -1]
    return float(np.abs(centers - means.numpy()).max()) <= 1e-3 * _extent(means)


def _extent(means: Tensor) -> float:
    """Largest side of the box that holds most of the centers."""
    sample = means[:: max(1, len(means) // 100_000)]
    low, high = torch.quantile(sample, torch.tensor([0.02, 0.98]), dim=0)
    return max(float((high - low).max()), 1e-6)


def most_visible(gaussians: Gaussians, count: int) -> Tensor:
    """Indices ``[count]``, ascending, of the Gaussians that cover most: opacity times area."""
    if len(gaussians) <= count:
        return torch.arange(len(gaussians))
    scales = gaussians.scales.detach().cpu().sort(1).values
    coverage = gaussians.opacities.detach().cpu() * scales[:, 1] * scales[:, 2]
    return coverage.topk(count).indices.sort().values
