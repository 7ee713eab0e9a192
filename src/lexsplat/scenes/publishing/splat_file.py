"""The splats of a page: SPZ where the library for it is installed, else PLY."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats.compressed import read_compressed, write_compressed
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
    try:
        write_compressed(gaussians, path, "spz")
        if _in_order(gaussians, read_compressed(path, "spz")):
            return path, _HALF_TURN
    except (BackendError, FileFormatError):
        pass
    path.unlink(missing_ok=True)
    path = folder / "scene.ply"
    write_ply(gaussians, path)
    return path, IDENTITY


def _in_order(written: Gaussians, found: Gaussians) -> bool:
    """Whether a file holds the same Gaussians at the same places, within a thousandth of the scene's extent."""
    if len(found) != len(written):
        return False
    means = written.means.detach().cpu()
    return float((found.means - means).abs().max()) <= 1e-3 * _extent(means)


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
