"""Blending weight of each Gaussian at the pixels of each code: one scatter per pixel and Gaussian.

A tile usually holds a handful of codes. Each pair stores one number per code of its tile, so only the result is as
large as Gaussians x codes, and no two threads write the same number.
"""

from __future__ import annotations

import numpy as np

from lexsplat.rendering.kernels.arrays import F32, I32, I64
from lexsplat.rendering.kernels.binning import TILE
from lexsplat.rendering.kernels.blending import (
    CHECK_EVERY,
    PIXELS,
    alpha_of,
    column_numbers,
    pass_row,
    rows_in_tile,
    seen_from_tile,
    start_tile,
    tile_finished,
)
from lexsplat.rendering.kernels.jit import kernel
from lexsplat.rendering.kernels.lanes import any_positive, store


@kernel
def list_codes(
    start: int, stop: int, codes: I32, num_codes: int, tiles_x: int, local: I32, listed: I32, counts: I64
) -> None:
    """The different codes of each tile, and each pixel's index in its tile's list.

    Args:
        start: First tile.
        stop: One past the last tile.
        codes: Code of each pixel ``[H, W]``; negative pixels are left out.
        num_codes: Codes are below this.
        tiles_x: Tiles in a row.
        local: Written: index in the tile's list, or -1 ``[H, W]``.
        listed: Written: codes of each tile ``[T, min(256, K)]``.
        counts: Written: how many ``[T]``.
    """
    height, width = codes.shape
    place = np.full(num_codes, -1, np.int32)
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        count = 0
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                code = codes[y, x]
                if code < 0:
                    local[y, x] = -1
                    continue
                if place[code] < 0:
                    place[code] = count
                    listed[tile, count] = code
                    count += 1
                local[y, x] = place[code]
        counts[tile] = count
        for i in range(count):
            place[listed[tile, i]] = -1


@kernel
def weigh_codes(
    start: int,
    stop: int,
    first_tile: int,
    ellipses: F32,
    boxes: I32,
    tile_offsets: I64,
    members: I32,
    tiles_x: int,
    local: I32,
    counts: I64,
    entry_offsets: I64,
    entries: F32,
) -> None:
    """Weight of each pair at each code of its tile, for tiles ``first_tile + start`` to ``first_tile + stop``.

    ``entries`` (zeroed) holds a block ``[pairs, codes]`` for each tile of the batch at ``entry_offsets``.
    """
    height, width = local.shape
    live, weights = np.empty(PIXELS, np.float32), np.empty(TILE, np.float32)
    index = np.empty(PIXELS, np.int32)
    columns = column_numbers()
    for batch_tile in range(start, stop):
        tile = first_tile + batch_tile
        if counts[tile] == 0:
            continue
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        start_tile(tile, tiles_x, width, height, live)
        index[:] = -1
        for j in range(min(TILE, height - top)):
            for i in range(min(TILE, width - left)):
                index[j * TILE + i] = local[top + j, left + i]
        countdown = CHECK_EVERY
        entry = entry_offsets[batch_tile]
        for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
            k = members[slot]
            _, across, slope, down, dy0, opacity = seen_from_tile(ellipses, k, left, top, columns)
            first, last = rows_in_tile(boxes, k, top)
            for j in range(first, last):
                dy = np.float32(j) + dy0
                alpha = alpha_of(across + down * dy * dy, slope, dy, opacity)
                weight = pass_row(live, j, alpha)
                if any_positive(weight):
                    store(weights, 0, weight)
                    for i in range(TILE):
                        if index[j * TILE + i] >= 0:
                            entries[entry + index[j * TILE + i]] += weights[i]
            entry += counts[tile]
            countdown -= 1
            if countdown == 0:
                countdown = CHECK_EVERY
                if tile_finished(live):
                    break


@kernel
def scatter_codes(
    start: int,
    stop: int,
    parts: int,
    first_tile: int,
    last_tile: int,
    order: I32,
    tile_offsets: I64,
    members: I32,
    listed: I32,
    counts: I64,
    entries: F32,
    totals: F32,
) -> None:
    """Add the entries to ``totals [N, K]``. A part owns a range of Gaussians, so parts never meet."""
    visible = order.shape[0]
    for part in range(start, stop):
        begin, end = part * visible // parts, (part + 1) * visible // parts
        entry = 0
        for tile in range(first_tile, last_tile):
            count = counts[tile]
            for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
                k = members[slot]
                if begin <= k < end:
                    n = order[k]
                    for i in range(count):
                        totals[n, listed[tile, i]] += entries[entry + i]
                entry += count
