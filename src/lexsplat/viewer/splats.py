"""What the browser is sent: Gaussians within a budget, in blocks of neighbors, and only the blocks that change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import covariances

BYTES_PER_SPLAT = 32
"""What one Gaussian costs on the wire, whatever changed of it (position, covariance, color and opacity)."""

_LARGEST_VARIANCE = 1e4
_HALF_MAX = 6e4
_MAX_GROWTH = 1.5


@dataclass(frozen=True)
class Block:
    """Neighboring Gaussians that are sent together.

    Args:
        index: Which Gaussians of the scene they are ``[M]``.
        centers: Their centers ``[M, 3]``, in drawing units (world units times `SplatBlocks.unit`).
        covariances: ``[M, 3, 3]``, in drawing units squared.
        opacities: ``[M, 1]`` in 0..1.
    """

    index: NDArray[np.int64]
    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    opacities: NDArray[np.float32]


class SplatBlocks:
    """A scene cut into blocks for the browser.

    Level of detail: where there are more Gaussians than the budget, those that cover most (opacity times area) are
    kept and grown a little, so that surfaces stay closed. Answers are always computed on all Gaussians.

    Args:
        gaussians: The scene.
        budget: How many Gaussians are drawn at most.
        block_size: How many Gaussians a block holds at most.

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
        # The browser keeps covariances as half floats; scaled like this, small ones keep their digits.
        largest = float(np.quantile(chosen.scales.amax(1).numpy(), 0.999)) if len(drawn) else 1.0
        self.unit = float(np.sqrt(_LARGEST_VARIANCE) / max(largest * growth, 1e-12))
        self.blocks = [
            self._block(chosen, drawn, part)
            for part in np.array_split(order, max(1, -(-len(order) // block_size)))
        ]
        self._sent: list[NDArray[np.uint8] | None] = [None] * len(self.blocks)

    @property
    def drawn(self) -> int:
        """How many Gaussians are drawn."""
        return sum(len(block.index) for block in self.blocks)

    def changes(self, colors: NDArray[np.uint8]) -> list[tuple[int, NDArray[np.uint8]]]:
        """The blocks whose colors differ from what this returned last: ``(block, colors [M, 3])``."""
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
    """The ``budget`` Gaussians that cover most, in ascending order, and how much longer they are drawn.

    The growth makes up for the covered area of those that were left out, at most 1.5 times.
    """
    if len(gaussians) <= budget:
        return np.arange(len(gaussians)), 1.0
    scales = gaussians.scales.sort(1).values
    coverage = (gaussians.opacities * scales[:, 1] * scales[:, 2]).cpu().numpy()
    coverage = np.minimum(
        coverage, np.quantile(coverage, 0.99)
    )  # one sky does not make up for a thousand leaves
    kept = np.sort(np.argpartition(-coverage, budget - 1)[:budget])
    growth = float(np.sqrt(coverage.sum() / max(coverage[kept].sum(), 1e-30)))
    return kept, min(max(growth, 1.0), _MAX_GROWTH)


def morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """An order of points ``[N, 3]`` in which neighbors in space are near each other (the Z curve, 2^10 cells)."""
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
