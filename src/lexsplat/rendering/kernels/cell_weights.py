"""The blending weights of Gaussians in the cells of a map, and their product with the values of the cells.

An entry is one Gaussian in one cell: the sum of alpha T over the cell's pixels in one tile. Only pairs that any light
reaches have entries. Their order within a Gaussian is fixed: by tile, then by row and column of the cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lexsplat.rendering.kernels.arrays import F32, I32, I64, U8
from lexsplat.rendering.kernels.binning import TILE
from lexsplat.rendering.kernels.blending import (
    CHECK_EVERY,
    PIXELS,
    ZERO,
    alpha_of,
    column_numbers,
    pass_row,
    seen_from_tile,
    start_tile,
    tile_finished,
)
from lexsplat.rendering.kernels.jit import kernel
from lexsplat.rendering.kernels.lanes import LANES, any_positive, load, splat, store

CHANNEL_BLOCK = 4 * LANES
"""The rows of values are padded to a multiple of this."""
_FIRST_ENTRIES = 1 << 14


@kernel
def _load_counts(tile: int, tiles_x: int, counts: F32, tile_counts: F32) -> None:
    """Copy the counts of the tile's pixels, 0 outside of the image."""
    height, width = counts.shape
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    tile_counts[:] = ZERO
    for j in range(min(TILE, height - top)):
        for i in range(min(TILE, width - left)):
            tile_counts[j * TILE + i] = counts[top + j, left + i]


@kernel
def _sum_columns(ends: Any, row: F32) -> None:
    """Sum the pixels of each cell into its last pixel, where ``ends`` is true; 0 in the others."""
    total = ZERO
    for i in range(LANES):
        total += row[i]
        row[i] = total if ends[i] else ZERO
        total = ZERO if ends[i] else total


@kernel
def _longer(array: Any, used: int) -> Any:
    """A copy of twice the length with the first ``used`` elements."""
    longer = np.empty(2 * len(array), array.dtype)
    longer[:used] = array[:used]
    return longer


@kernel
def weigh_cells(
    start: int,
    stop: int,
    ellipses: F32,
    tile_offsets: I64,
    members: I32,
    pairs: I32,
    rows: U8,
    tiles_x: int,
    cell_rows: I64,
    cell_columns: I64,
    cells_x: int,
    counts: F32,
    first_entries: I64,
    entry_counts: I32,
) -> Any:
    """The entries of tiles ``start`` to ``stop``.

    Args:
        cell_rows: Row of cells of each pixel row ``[H]``, ascending.
        cell_columns: Column of cells of each pixel column ``[W]``, ascending.
        cells_x: Number of columns of cells.
        counts: Weight of each pixel ``[H, W]``, not negative.
        first_entries: Receives the first entry of each pair, in the list by Gaussian, within the result ``[M]``.
        entry_counts: Receives the number of entries of each pair ``[M]``; 0 on input.

    Returns:
        Cells ``[E]`` int32 and weights ``[E]`` float32.
    """
    height, width = counts.shape
    cells, weights = np.empty(_FIRST_ENTRIES, np.int32), np.empty(_FIRST_ENTRIES, np.float32)
    used = 0
    live, tile_counts = np.empty(PIXELS, np.float32), np.empty(PIXELS, np.float32)
    row_sums = np.empty(LANES, np.float32)
    tile_columns, ends = np.zeros(TILE, np.int64), np.zeros(TILE, np.bool_)
    columns = column_numbers()
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        across_tile = min(TILE, width - left)
        for i in range(across_tile):
            tile_columns[i] = cell_columns[left + i]
            ends[i] = i + 1 == across_tile or cell_columns[left + i + 1] != cell_columns[left + i]
        each = ends[:across_tile].all()
        start_tile(tile, tiles_x, width, height, live)
        _load_counts(tile, tiles_x, counts, tile_counts)
        countdown = CHECK_EVERY
        for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
            k, pair = members[slot], pairs[slot]
            _, across, slope, down, dy0, opacity = seen_from_tile(ellipses, k, left, top, columns)
            first, last = np.int64(rows[slot, 0]), np.int64(rows[slot, 1])
            if used + PIXELS >= len(cells):
                cells, weights = _longer(cells, used), _longer(weights, used)
            first_entries[pair] = used
            sums = splat(ZERO)
            for j in range(first, last):
                dy = np.float32(j) + dy0
                row_alpha = alpha_of(across + down * dy * dy, slope, dy, opacity)
                sums += pass_row(live, j, row_alpha) * load(tile_counts, j * TILE)
                if j + 1 < last and cell_rows[top + j + 1] == cell_rows[top + j]:
                    continue
                if any_positive(sums):
                    store(row_sums, 0, sums)
                    if not each:
                        _sum_columns(ends, row_sums)
                    place = cell_rows[top + j] * cells_x
                    for i in range(across_tile):
                        # A weight of 0 is written, too, and then overwritten: faster than a branch.
                        cells[used], weights[used] = place + tile_columns[i], row_sums[i]
                        used += 1 if row_sums[i] > ZERO else 0
                sums = splat(ZERO)
            entry_counts[pair] = used - first_entries[pair]
            countdown -= 1
            if countdown == 0:
                countdown = CHECK_EVERY
                if tile_finished(live):
                    break
    return cells[:used].copy(), weights[:used].copy()


@kernel
def sum_weights(
    start: int,
    stop: int,
    order: I32,
    pair_offsets: I64,
    first_entries: I64,
    entry_counts: I32,
    weights: F32,
    totals: F32,
) -> None:
    """Sum of the weights of each visible Gaussian, into ``totals [N]``."""
    for k in range(start, stop):
        total = ZERO
        for pair in range(pair_offsets[k], pair_offsets[k + 1]):
            entry = first_entries[pair]
            for e in range(entry, entry + entry_counts[pair]):
                total += weights[e]
        totals[order[k]] = total


@kernel
def add_cells(
    start: int,
    stop: int,
    order: I32,
    tile_offsets: I64,
    members: I32,
    pairs: I32,
    pair_offsets: I64,
    first_entries: I64,
    entry_counts: I32,
    cells: I32,
    weights: F32,
    values: F32,
    sums: F32,
) -> None:
    """Add the sum of weight times value to every Gaussian whose first tile is one of ``start`` to ``stop``.

    Gaussians are taken by their first tile, so that neighbors read the same values.

    Args:
        values: Rows of the cells ``[cells, C']``, C' a multiple of `CHANNEL_BLOCK`.
        sums: Rows of the Gaussians ``[N, C]``, C <= C'.
    """
    width, channels = values.shape[1], sums.shape[1]
    flat_values, flat_sums = values.reshape(-1), sums.reshape(-1)
    row = np.empty(width, np.float32)
    for slot in range(tile_offsets[start], tile_offsets[stop]):
        k = members[slot]
        first, last = pair_offsets[k], pair_offsets[k + 1]
        if pairs[slot] != first:
            continue
        found = 0
        for pair in range(first, last):
            found += entry_counts[pair]
        if found == 0:
            continue
        for block in range(0, width, CHANNEL_BLOCK):
            s0, s1, s2, s3 = splat(ZERO), splat(ZERO), splat(ZERO), splat(ZERO)
            for pair in range(first, last):
                entry = first_entries[pair]
                for e in range(entry, entry + entry_counts[pair]):
                    weight, place = weights[e], cells[e] * width + block
                    s0 += load(flat_values, place) * weight
                    s1 += load(flat_values, place + LANES) * weight
                    s2 += load(flat_values, place + 2 * LANES) * weight
                    s3 += load(flat_values, place + 3 * LANES) * weight
            store(row, block, s0)
            store(row, block + LANES, s1)
            store(row, block + 2 * LANES, s2)
            store(row, block + 3 * LANES, s3)
        place = order[k] * channels
        channel = 0
        while channel + LANES <= channels:
            store(flat_sums, place + channel, load(flat_sums, place + channel) + load(row, channel))
            channel += LANES
        while channel < channels:
            flat_sums[place + channel] += row[channel]
            channel += 1
