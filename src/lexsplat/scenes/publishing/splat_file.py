"""The splats of a page."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.progress import Listener, silent
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.sog_writing import write_sog
from lexsplat.scenes.formats.spz import is_coarse, write_spz

NAME = "scene"
"""Name of the file in the page's folder, without its ending."""
SMALL_BYTES = 250_000
"""Scenes whose numbers take at most this are written exactly, as PLY."""
LARGE_BYTES = 16_000_000
"""For SPZ files above this, SOG is tried: its palette shrinks spherical harmonics, and takes minutes to find."""

Rotation = tuple[float, float, float, float]
_NONE: Rotation = (0.0, 0.0, 0.0, 1.0)
_HALF_TURN: Rotation = (1.0, 0.0, 0.0, 0.0)
"""Rotation xyzw from the axes of SPZ (y up, z backward) to those of the scene."""


def write_splats(
    gaussians: Gaussians, folder: Path, shrink: bool = False, listener: Listener = silent
) -> tuple[Path, Rotation]:
    """Write the splats into a folder, in the order given.

    Small scenes become a PLY, others an SPZ 3 (the page's renderer reads no newer version), or a SOG where a far
    Gaussian makes SPZ too coarse for the others.

    Args:
        gaussians: The splats.
        folder: An existing folder.
        shrink: Write a large scene as SOG where that is smaller.
        listener: Receives events of stage "palette" while a SOG is written.

    Returns:
        The file, and the rotation xyzw from its axes to those of the scene.
    """
    if sum(tensor.nbytes for tensor in gaussians.tensors().values()) <= SMALL_BYTES:
        path = folder / f"{NAME}.ply"
        write_ply(gaussians, path)
        return path, _NONE
    if is_coarse(gaussians):
        path = folder / f"{NAME}.sog"
        write_sog(gaussians, path, listener)
        return path, _NONE
    path = folder / f"{NAME}.spz"
    write_spz(gaussians, path, version=3)
    if shrink and path.stat().st_size > LARGE_BYTES:
        other = folder / f"{NAME}.sog"
        write_sog(gaussians, other, listener)
        if other.stat().st_size < path.stat().st_size:
            path.unlink()
            return other, _NONE
        other.unlink()
    return path, _HALF_TURN


def most_visible(gaussians: Gaussians, count: int) -> Tensor:
    """Indices ``[count]``, ascending, of the Gaussians that cover most: opacity times area."""
    if len(gaussians) <= count:
        return torch.arange(len(gaussians))
    scales = gaussians.scales.detach().cpu().sort(1).values
    coverage = gaussians.opacities.detach().cpu() * scales[:, 1] * scales[:, 2]
    return coverage.topk(count).indices.sort().values
