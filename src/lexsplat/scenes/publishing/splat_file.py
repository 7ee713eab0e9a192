"""The splats of a page."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.scenes.formats.spz import write_spz

NAME = "scene.spz"
"""Name of the file in the page's folder."""

_HALF_TURN = (1.0, 0.0, 0.0, 0.0)
"""Rotation xyzw from the axes of SPZ (y up, z backward) to those of the scene."""


def write_splats(gaussians: Gaussians, folder: Path) -> tuple[Path, tuple[float, float, float, float]]:
    """Write the splats into a folder, in the order given, as SPZ 3: the page's renderer reads no newer version.

    Returns:
        The file, and the rotation xyzw from its axes to those of the scene.
    """
    path = folder / NAME
    write_spz(gaussians, path, version=3)
    return path, _HALF_TURN


def most_visible(gaussians: Gaussians, count: int) -> Tensor:
    """Indices ``[count]``, ascending, of the Gaussians that cover most: opacity times area."""
    if len(gaussians) <= count:
        return torch.arange(len(gaussians))
    scales = gaussians.scales.detach().cpu().sort(1).values
    coverage = gaussians.opacities.detach().cpu() * scales[:, 1] * scales[:, 2]
    return coverage.topk(count).indices.sort().values
