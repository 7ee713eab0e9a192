"""The transpose of rendering: values on pixels, added up on the Gaussians by their blending weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import backends
from lexsplat.rendering.compositing import check_prepared, prepare, render
from lexsplat.rendering.results import PreparedView

Indices = TypeVar("Indices", Tensor, NDArray[np.int64])

BACK_PROJECTED_CHANNELS = 64
"""Channels that `back_project` processes at a time."""


def back_project(
    gaussians: Gaussians, camera: Camera, values: Tensor, prepared: PreparedView | None = None
) -> Tensor:
    """Back-project a map: the sum of alpha T values over the pixels, for each Gaussian.

    Rendering is linear in the features, so this is its gradient, computed `BACK_PROJECTED_CHANNELS` at a time.

    Args:
        gaussians: The scene.
        camera: The view of the map, with its size.
        values: ``[H, W, C]``, on the device of the Gaussians.
        prepared: From `prepare` for the same Gaussians and camera; None prepares the view here.

    Returns:
        ``[N, C]``.
    """
    if prepared is None:
        prepared = prepare(gaussians, camera)
    parts = []
    with torch.enable_grad():
        for part in values.split(BACK_PROJECTED_CHANNELS, dim=-1):
            carried = torch.zeros(len(gaussians), part.shape[-1], device=gaussians.device, requires_grad=True)
            image = render(gaussians, camera, features=carried, color=False, prepared=prepared).features
            (gradient,) = torch.autograd.grad(image, carried, part.contiguous())
            parts.append(gradient)
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def accumulate_weights(
    gaussians: Gaussians, camera: Camera, *, prepared: PreparedView | None = None
) -> Tensor:
    """Blending weight of each Gaussian over the whole view ``[N]``, in pixels."""
    everywhere = torch.ones(camera.height, camera.width, 1, device=gaussians.device)
    return back_project(gaussians, camera, everywhere, prepared)[:, 0]


def measure_weights(gaussians: Gaussians, camera: Camera, *, prepared: PreparedView | None = None) -> Tensor:
    """`accumulate_weights` up to rounding ``[N]``; on a CPU it blends the view once instead of forth and back."""
    if not hasattr(backends.backend_for(gaussians), "weigh_cells"):
        return accumulate_weights(gaussians, camera, prepared=prepared)
    everywhere = torch.ones(camera.height, camera.width)
    if prepared is None:
        prepared = prepare(gaussians, camera)
    return weigh_cells(gaussians, camera, (1, 1), everywhere, prepared).totals()


class CellWeights(Protocol):
    """Blending weights of one view in the cells of a map."""

    def totals(self) -> Tensor:
        """Sum of the weights of each Gaussian ``[N]``."""

    def add_to(self, sums: Tensor, values: Tensor) -> None:
        """Add the sum of weight times value over the cells ``[cells, C]`` to the rows of ``sums [N, C]``."""


def cell_of(pixels: Indices, size: int, cells: int) -> Indices:
    """Cells that hold the centers of pixels, along one side of ``size`` pixels and ``cells`` cells."""
    # (p + 1/2) cells / size in integers: rounding cannot move a pixel to the neighboring cell.
    return (2 * pixels + 1) * cells // (2 * size)


def weigh_cells(
    gaussians: Gaussians, camera: Camera, cells: tuple[int, int], counts: Tensor, prepared: PreparedView
) -> CellWeights:
    """The weights with which the cells of a map reach the Gaussians: alpha T, summed over the pixels of each cell.

    On a CPU the view is blended here, once, and the weights are kept as a sparse matrix; its products cost as many
    operations as there are (Gaussian, cell) pairs and channels, whatever the number of pixels. On CUDA every product
    is a back-projection.

    Args:
        gaussians: The scene.
        camera: The view.
        cells: Rows and columns of the map.
        counts: Factor of each pixel ``[H, W]`` float32, not negative; 0 leaves it out.
        prepared: From `prepare` for the same Gaussians and camera.
    """
    module = backends.backend_for(gaussians)
    check_prepared(prepared, module, gaussians, camera)
    rows = cell_of(np.arange(camera.height), camera.height, cells[0])
    columns = cell_of(np.arange(camera.width), camera.width, cells[1])
    if hasattr(module, "weigh_cells"):
        return module.weigh_cells(prepared.pairs, rows, columns, cells[1], counts)  # type: ignore[no-any-return]
    at = torch.from_numpy(rows[:, None] * cells[1] + columns)
    return DenseCellWeights(gaussians, camera, at, counts, prepared)


@dataclass(frozen=True)
class DenseCellWeights:
    """The same by back-projecting the values at every pixel.

    Args:
        gaussians: The scene.
        camera: The view.
        cells: Cell of each pixel ``[H, W]``.
        counts: Factor of each pixel ``[H, W]``.
        prepared: The prepared view.
    """

    gaussians: Gaussians
    camera: Camera
    cells: Tensor
    counts: Tensor
    prepared: PreparedView

    def totals(self) -> Tensor:
        """Sum of the weights of each Gaussian ``[N]``."""
        counts = self.counts[..., None].to(self.gaussians.device)
        return back_project(self.gaussians, self.camera, counts, self.prepared)[:, 0]

    def add_to(self, sums: Tensor, values: Tensor) -> None:
        """Add the sum of weight times value over the cells ``[cells, C]`` to the rows of ``sums [N, C]``."""
        for start in range(0, values.shape[1], BACK_PROJECTED_CHANNELS):
            columns = slice(start, start + BACK_PROJECTED_CHANNELS)
            carried = (values[self.cells, columns].float() * self.counts[..., None]).to(sums.device)
            sums[:, columns] += back_project(self.gaussians, self.camera, carried, self.prepared)
