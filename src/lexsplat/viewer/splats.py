"""What the browser receives: Gaussians within a budget, in blocks of spatial neighbors, only changed blocks again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import covariances

BYTES_PER_SPLAT = 32
"""Wire size of a Gaussian. Any change of it sends position, covariance, color and opacity."""

_LARGEST_VARIANCE = 1e4
_HALF_MAX = 6e4
_MAX_GROWTH = 1.5


@dataclass(frozen=True)
class Block:
    """Spatially neighboring Gaussians that are sent together.

    Args:
        index: Their indices in the scene ``[M]``.
        centers: Their centers ``[M, 3]``, in drawing units (world units times `SplatBlocks.unit`).
        covariances: ``[M, 3, 3]``, in drawing units squared.
        opacities: ``[M, 1]`` in 0..1.
    """

    index: NDArray[np.int64]
    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    opacities: NDArray[np.float32]


class SplatBlocks:
    """The Gaussians of a scene, divided into blocks for the browser.

    A scene larger than the budget is reduced by `level_of_detail`. Answers are always computed on all Gaussians.

    Args:
        gaussians: The scene.
        budget: Maximum number of Gaussians that are drawn.
        block_size: Maximum number of Gaussians in a block.

    Raises:
        ValueError: If the budget or the block size is not positive.
    """

    def __init__(self, gaussians: Gaussians, budget: int = 1_000_000, block_size: int = 32_768) -> None:
        if budget < 1 or block_size < 1:
            raise ValueError(f"budget and block_size must be positive, got {budget} and {block_size}")
        drawn, growth = level_of_detail(gaussians, budget)
        self.total, self.growth = len(gaussians), growth
        chosen = gaussians.select(torch.from_numpy(drawn).to(gaussians.device)).to("cpu")
        means = chosen.means.numpy()
        order = morton_order(means)
        # The browser stores covariances as half floats; this unit keeps small ones within their range.
        largest = float(np.quantile(chosen.scales.amax(1).numpy(), 0.999)) if len(drawn) else 1.0
        self.unit = float(np.sqrt(_LARGEST_VARIANCE) / max(largest * growth, 1e-12))
        self.blocks = [
            self._block(chosen, drawn, part)
            for part in np.array_split(order, max(1, -(-len(order) // block_size)))
        ]
        self._sent: list[NDArray[np.uint8] | None] = [None] * len(self.blocks)

    @property
    def drawn(self) -> int:
        """Number of Gaussians that are drawn."""
        return sum(len(block.index) for block in self.blocks)

    def changes(self, colors: NDArray[np.uint8]) -> list[tuple[int, NDArray[np.uint8]]]:
        """The blocks whose colors changed since the last call.

        Args:
            colors: Color of every Gaussian of the scene ``[N, 3]``.

        Returns:
            ``(block number, colors [M, 3])`` of each changed block.
        """
        changed = []
        for number, block in enumerate(self.blocks):
            own = colors[block.index]
            before = self._sent[number]
            if before is None or not np.array_equal(before, own):
                self._sent[number] = own
                changed.append((number, own))
        return changed

    def _block(self, chosen: Gaussians, drawn: NDArray[np.int64], part: NDArray[np.int64]) -> Block:
        own = chosen.select(torch.from_numpy(part))
        scaled = covariances(own.quats, own.scales).numpy() * (self.unit * self.growth) ** 2
        return Block(
            index=drawn[part],
            centers=(own.means * self.unit).numpy(),
            covariances=np.clip(scaled, -_HALF_MAX, _HALF_MAX),
            opacities=own.opacities.numpy()[:, None],
        )


def level_of_detail(gaussians: Gaussians, budget: int) -> tuple[NDArray[np.int64], float]:
    """Keep the Gaussians that cover most (opacity times area), and enlarge them to keep surfaces closed.

    Args:
        gaussians: The scene.
        budget: Maximum number of Gaussians to keep.

    Returns:
        Their indices in ascending order, and the factor for their scales. The factor compensates for the area of
        the dropped Gaussians and is at most 1.5.
    """
    if len(gaussians) <= budget:
        return np.arange(len(gaussians)), 1.0
    scales = gaussians.scales.sort(1).values
    coverage = (gaussians.opacities * scales[:, 1] * scales[:, 2]).cpu().numpy()
    # Clipped, so that a few huge background Gaussians do not dominate the total coverage.
    coverage = np.minimum(coverage, np.quantile(coverage, 0.99))
    kept = np.sort(np.argpartition(-coverage, budget - 1)[:budget])
    growth = float(np.sqrt(coverage.sum() / max(coverage[kept].sum(), 1e-30)))
    return kept, min(max(growth, 1.0), _MAX_GROWTH)


def morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Sort points ``[N, 3]`` along the Z curve (2^10 cells per axis), which keeps spatial neighbors close."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    cells = np.clip((points - low) / np.maximum(high - low, 1e-12) * 1023, 0, 1023).astype(np.uint64)
    key = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        value = cells[:, axis]
        for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
            value = (value | (value << np.uint64(shift))) & np.uint64(mask)
        key |= value << np.uint64(axis)
    return np.argsort(key, kind="stable")
