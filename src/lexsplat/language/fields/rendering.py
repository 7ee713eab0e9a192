"""Shared by both forms of field: rendering many channels, checking score tables, storing the codebook."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import prepare, render

RENDER_CHANNELS = 32
"""Channels rendered in one pass."""

BLOCK_ROWS = 16_384
"""Pixels or Gaussians decoded at a time."""


def render_chunks(
    gaussians: Gaussians, camera: Camera, count: int, columns_of: Callable[[slice], Tensor]
) -> Tensor:
    """Render ``count`` channels, `RENDER_CHANNELS` at a time: ``[H, W, count]``."""
    prepared = prepare(gaussians, camera)
    image = torch.empty(camera.height, camera.width, count, device=gaussians.device)
    for start in range(0, count, RENDER_CHANNELS):
        columns = slice(start, min(start + RENDER_CHANNELS, count))
        features = columns_of(columns)
        image[..., columns] = render(
            gaussians, camera, features=features, color=False, prepared=prepared
        ).features
    return image


def check_table(table: Tensor, codebook: Codebook) -> None:
    """Refuse a table of scores that is not ``[K, P]``.

    Raises:
        ValueError: If it has another shape.
    """
    if table.ndim != 2 or len(table) != codebook.num_codes:
        raise ValueError(f"table must be [{codebook.num_codes}, P], got {list(table.shape)}")


def codebook_tensors(codebook: Codebook) -> dict[str, Tensor]:
    """Tensors of a codebook under the names they have in a stored field."""
    return {f"codebook.{name}": value.contiguous() for name, value in codebook.tensors().items()}


def stored_codebook(tensors: Mapping[str, Tensor]) -> Codebook:
    """The inverse of `codebook_tensors`.

    Raises:
        ValueError: If a tensor is missing or has the wrong shape.
    """
    prefix = "codebook."
    return Codebook.from_tensors(
        {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
    )


def require(tensors: Mapping[str, Tensor], names: tuple[str, ...]) -> None:
    """Refuse a stored field without the tensors ``names``.

    Raises:
        ValueError: If any is missing.
    """
    missing = [name for name in names if name not in tensors]
    if missing:
        raise ValueError(f"language field lacks {', '.join(missing)}")
