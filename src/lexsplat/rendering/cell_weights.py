"""The sparse matrix of one view that averages a map: the weight alpha T of each (Gaussian, cell) pair; CPU only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.rendering.kernels import cell_weights
from lexsplat.rendering.kernels.jit import parallel
from lexsplat.rendering.pairs import GRAIN, TILE_GRAIN, TilePairs


@dataclass(frozen=True)
class SparseCellWeights:
    """Blending weights summed over the pixels of each cell, for every Gaussian that shows there.

    Args:
        tiles: The pairs of the view.
        cells: Cell of each entry ``[E]``.
        weights: Weight of each entry ``[E]``, positive. A cell that crosses a border of tiles has several entries.
        first_entries: First entry of each pair in the list by Gaussian ``[M]``.
        entry_counts: Number of its entries ``[M]``.
    """

    tiles: TilePairs
    cells: NDArray[np.int32]
    weights: NDArray[np.float32]
    first_entries: NDArray[np.int64]
    entry_counts: NDArray[np.int32]

    def owners(self) -> NDArray[np.int32]:
        """The Gaussian of each entry ``[E]``."""
        t = self.tiles
        of_pair = np.repeat(t.order, np.diff(t.pair_offsets))
        owners = np.empty(len(self.weights), np.int32)
        shown = self.entry_counts > 0
        starts, counts = self.first_entries[shown], self.entry_counts[shown]
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        owners[np.repeat(starts, counts) + within] = np.repeat(of_pair[shown], counts)
        return owners

    def in_cells(self, owners: NDArray[np.int32]) -> NDArray[np.float64]:
        """The weight of each entry's Gaussian in its whole cell ``[E]``, of which other tiles may hold a share."""
        keys = owners.astype(np.int64) * (int(self.cells.max(initial=0)) + 1) + self.cells
        _, places = np.unique(keys, return_inverse=True)
        sums = np.bincount(places, self.weights.astype(np.float64)).astype(np.float64)
        return np.asarray(sums[places])

    def totals(self) -> Tensor:
        """Sum of the weights of each Gaussian ``[N]``."""
        t = self.tiles
        totals = np.zeros(t.count, np.float32)
        parallel(
            cell_weights.sum_weights, len(t.order), GRAIN,
            t.order, t.pair_offsets, self.first_entries, self.entry_counts, self.weights, totals,
        )  # fmt: skip
        return torch.from_numpy(totals)

    def add_to(self, sums: Tensor, values: Tensor) -> None:
        """Add the sum of weight times value over the cells to the row of each Gaussian.

        Args:
            sums: ``[N, C]`` float32, contiguous, changed in place.
            values: ``[cells, C]``.
        """
        block = cell_weights.CHANNEL_BLOCK
        channels = values.shape[1]
        padded = torch.zeros(len(values), -(-channels // block) * block)
        padded[:, :channels] = values
        t = self.tiles
        parallel(
            cell_weights.add_cells, t.tiles, TILE_GRAIN,
            t.order, t.tile_offsets, t.members, t.pairs, t.pair_offsets,
            self.first_entries, self.entry_counts, self.cells, self.weights, padded.numpy(), sums.numpy(),
        )  # fmt: skip


def weigh_cells(
    pairs: TilePairs, rows: NDArray[np.int64], columns: NDArray[np.int64], width: int, counts: Tensor
) -> SparseCellWeights:
    """Blend the view once and keep the weights by cell.

    Args:
        pairs: The pairs of the view.
        rows: Row of cells of each pixel row ``[H]``, ascending.
        columns: Column of cells of each pixel column ``[W]``, ascending.
        width: Number of columns of cells.
        counts: Weight of each pixel ``[H, W]`` float32, not negative.
    """
    total = int(pairs.pair_offsets[-1])
    first_entries, entry_counts = np.zeros(total, np.int64), np.zeros(total, np.int32)
    found: dict[int, tuple[NDArray[np.int32], NDArray[np.float32]]] = {}

    def work(start: int, stop: int) -> None:
        found[start] = cell_weights.weigh_cells(
            start, stop, pairs.ellipses, pairs.tile_offsets, pairs.members, pairs.pairs, pairs.rows,
            pairs.tiles_x, rows, columns, width, counts.contiguous().numpy(), first_entries, entry_counts,
        )  # fmt: skip

    parallel(work, pairs.tiles, TILE_GRAIN)
    starts = sorted(found)
    lengths = [len(found[start][0]) for start in starts]
    for start, stop, before in zip(starts, [*starts[1:], pairs.tiles], np.cumsum([0, *lengths])):
        listed = pairs.pairs[pairs.tile_offsets[start] : pairs.tile_offsets[stop]]
        first_entries[listed] += before
    cells = np.concatenate([found[start][0] for start in starts])
    weights = np.concatenate([found.pop(start)[1] for start in starts])
    return SparseCellWeights(pairs, cells, weights, first_entries, entry_counts)
