"""The (tile, Gaussian) pairs of one view, input of both passes of the CPU rasterizer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels import binning
from lexsplat.rendering.kernels.jit import parallel
from lexsplat.rendering.results import Projection

STRIPS = 16
"""Number of parts in which Gaussians are counted and listed."""
GRAIN = 2048
"""Gaussians per work item of a thread."""
TILE_GRAIN = 8
"""Tiles per work item of a thread."""


@dataclass(frozen=True)
class TilePairs:
    """Visible Gaussians in depth order and the tiles they overlap.

    Args:
        width: Image width in pixels.
        height: Image height in pixels.
        count: Number of all Gaussians N.
        order: Index of each visible Gaussian, nearest first ``[V]``.
        ellipses: Center, half conic and opacity in that order ``[V, 8]``.
        pair_offsets: First pair of each Gaussian in the list by Gaussian ``[V + 1]``. The last entry is M, or more
            in a `narrowed` view, whose pairs keep their places in that list.
        tile_offsets: First pair of each tile in the list by tile ``[T + 1]``.
        members: Position in ``order`` of each pair, by tile and depth ``[M]``.
        pairs: Place of each pair in the list by Gaussian ``[M]``.
        rows: First row of the tile that the Gaussian reaches, and one past the last ``[M, 2]``.
    """

    width: int
    height: int
    count: int
    order: NDArray[np.int32]
    ellipses: NDArray[np.float32]
    pair_offsets: NDArray[np.int64]
    tile_offsets: NDArray[np.int64]
    members: NDArray[np.int32]
    pairs: NDArray[np.int32]
    rows: NDArray[np.uint8]

    @property
    def tiles_x(self) -> int:
        """Tiles in a row."""
        return -(-self.width // binning.TILE)

    @property
    def tiles(self) -> int:
        """Tiles in all."""
        return self.tiles_x * -(-self.height // binning.TILE)

    @property
    def nbytes(self) -> int:
        """Memory held by the lists."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    @property
    def _tile_of_each(self) -> NDArray[np.int64]:
        """Tile of each pair of the list by tile ``[M]``."""
        return np.repeat(np.arange(self.tiles), np.diff(self.tile_offsets))

    def tiles_of(self, gaussians: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The tiles ``[T]`` that some of the Gaussians ``[N]`` overlap."""
        found = np.zeros(self.tiles, bool)
        found[self._tile_of_each[gaussians[self.order][self.members]]] = True
        return found

    def tiles_at(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """The tiles ``[T]`` with pixels (x, y) ``[P, 2]`` of the image."""
        found = np.zeros(self.tiles, bool)
        columns, rows = pixels.T // binning.TILE
        found[rows * self.tiles_x + columns] = True
        return found

    def narrowed(self, tiles: NDArray[np.bool_], gone: NDArray[np.bool_] | None = None) -> TilePairs:
        """The pairs of some tiles ``[T]``, where some Gaussians ``[N]`` may be gone; the other tiles are empty."""
        kept = tiles[self._tile_of_each]
        if gone is not None:
            kept &= ~gone[self.order][self.members]
        offsets = _offsets(kept)[self.tile_offsets]
        members, pairs, rows = self.members[kept], self.pairs[kept], self.rows[kept]
        return replace(self, tile_offsets=offsets, members=members, pairs=pairs, rows=rows)


def find_pairs(projection: Projection, width: int, height: int) -> TilePairs:
    """Sort by depth, then count and list the pairs of each tile of an image of ``width`` x ``height`` pixels.

    Raises:
        ValueError: If the projection was made by another backend.
    """
    p = projection
    if p.extents is None:
        raise ValueError("the projection was made by another backend")
    means2d, conics, opacities, extents, depths, radii = (
        t.detach().contiguous().numpy()
        for t in (p.means2d, p.conics, p.opacities, p.extents, p.depths, p.radii)
    )
    count = len(depths)
    buffer, scratch = np.empty(count, np.int32), np.empty(count, np.int32)
    visible = binning.sort_visible(depths.view(np.uint32), radii, buffer, scratch)
    order = buffer[:visible].copy()
    ellipses = np.empty((visible, binning.ELLIPSE_FIELDS), np.float32)
    boxes = np.empty((visible, binning.BOX_FIELDS), np.int32)
    counts = np.empty(visible, np.int64)
    parallel(
        binning.find_boxes, visible, GRAIN,
        order, means2d, conics, opacities, extents, width, height, ellipses, boxes, counts,
    )  # fmt: skip
    column_offsets = _offsets(counts)
    spans = np.empty((int(column_offsets[-1]), 2), np.int32)
    parallel(binning.find_spans, visible, GRAIN, ellipses, boxes, column_offsets, spans, counts)
    pair_offsets = _offsets(counts)
    total = int(pair_offsets[-1])
    members, pairs, rows = (
        np.empty(total, np.int32),
        np.empty(total, np.int32),
        np.empty((total, 2), np.uint8),
    )
    tiles_x, tiles_y = -(-width // binning.TILE), -(-height // binning.TILE)
    histogram = np.zeros((STRIPS, tiles_x * tiles_y), np.int64)
    tile_offsets = np.empty(tiles_x * tiles_y + 1, np.int64)
    lists = boxes, column_offsets, spans, tiles_x, histogram, pair_offsets, members, pairs, rows
    parallel(binning.list_pairs, STRIPS, 1, True, *lists)
    binning.offsets_of(histogram, tile_offsets)
    parallel(binning.list_pairs, STRIPS, 1, False, *lists)
    return TilePairs(width, height, count, order, ellipses, pair_offsets, tile_offsets, members, pairs, rows)


def _offsets(counts: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """Sums of all counts before each one, and of all."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])
