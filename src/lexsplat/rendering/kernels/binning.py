"""Lists the Gaussians that overlap each tile, nearest first.

A pair is one Gaussian in one tile. Pairs are listed twice: by tile (for blending) and by Gaussian (for the sum of
gradients); ``pairs`` maps the first list to the second.

Where an ellipse reaches is rounded to integers once, in `find_boxes` and `find_spans`, and both counting and filling
use these integers. Two separate floating-point computations could differ by one pixel and write outside the list.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels.arrays import F32, I32, I64, U8
from lexsplat.rendering.kernels.jit import kernel

TILE = 16
"""Width and height of a tile in pixels."""
SLACK = 1e-3
"""Margin of a box in pixels on each side, so that rounding never removes a contribution."""
RADIX_BITS = 11
ROUND_MIN = 1e-4
"""Spans of thinner ellipses, by 1 - correlation^2, are those of their box: float32 loses their shape."""

# Columns of the table of ellipses: center, half conic, opacity (padded to 32 bytes).
CENTER_X, CENTER_Y, HALF_A, CONIC_B, HALF_C, OPACITY, ELLIPSE_FIELDS = 0, 1, 2, 3, 4, 5, 8
# Columns of the table of boxes: tile columns [first, last), pixel rows [first, last).
TILE_FIRST, TILE_LAST, ROW_FIRST, ROW_LAST, BOX_FIELDS = 0, 1, 2, 3, 4


@kernel
def sort_visible(keys: NDArray[np.uint32], radii: I32, order: I32, scratch: I32) -> int:
    """Sort the indices of the visible Gaussians by depth, ties by index (stable radix sort); returns their number.

    ``keys`` are the bit patterns of the depths: positive floats sort like their bits. ``order`` and ``scratch`` have
    one element for each Gaussian.
    """
    size = 1 << RADIX_BITS
    count = 0
    for n in range(radii.shape[0]):
        if radii[n] > 0:
            order[count] = n
            count += 1
    histogram = np.zeros((3, size), np.int64)
    for i in range(count):
        key = keys[order[i]]
        for digit in range(3):
            histogram[digit, (key >> np.uint32(RADIX_BITS * digit)) & np.uint32(size - 1)] += 1
    source, target = order, scratch
    for digit in range(3):
        total = 0
        for j in range(size):
            here = histogram[digit, j]
            histogram[digit, j] = total
            total += here
        for i in range(count):
            n = source[i]
            slot = (keys[n] >> np.uint32(RADIX_BITS * digit)) & np.uint32(size - 1)
            target[histogram[digit, slot]] = n
            histogram[digit, slot] += 1
        source, target = target, source
    # After three passes, an odd number, the result is in scratch.
    order[:count] = scratch[:count]
    return count


@kernel
def find_boxes(
    start: int,
    stop: int,
    order: I32,
    means2d: F32,
    conics: F32,
    opacities: F32,
    extents: F32,
    width: int,
    height: int,
    ellipses: F32,
    boxes: I32,
    counts: I64,
) -> None:
    """Gather the ellipses in depth order and round their boxes; ``counts`` receives their tile columns."""
    half = np.float32(0.5)
    for k in range(start, stop):
        n = order[k]
        x, y = np.float64(means2d[n, 0]), np.float64(means2d[n, 1])
        ellipses[k, CENTER_X] = means2d[n, 0]
        ellipses[k, CENTER_Y] = means2d[n, 1]
        ellipses[k, HALF_A] = half * conics[n, 0]
        ellipses[k, CONIC_B] = conics[n, 1]
        ellipses[k, HALF_C] = half * conics[n, 2]
        ellipses[k, OPACITY] = opacities[n]
        reach_x, reach_y = extents[n, 0] + SLACK, extents[n, 1] + SLACK
        # First and last pixel whose center (index + 0.5) is inside; clamped before the cast to avoid overflow.
        left = math.ceil(min(max(x - reach_x - 0.5, 0.0), float(width)))
        right = math.floor(min(max(x + reach_x - 0.5, -1.0), float(width - 1)))
        top = math.ceil(min(max(y - reach_y - 0.5, 0.0), float(height)))
        bottom = math.floor(min(max(y + reach_y - 0.5, -1.0), float(height - 1)))
        if right < left or bottom < top:
            boxes[k, TILE_FIRST] = boxes[k, TILE_LAST] = boxes[k, ROW_FIRST] = boxes[k, ROW_LAST] = 0
            counts[k] = 0
            continue
        boxes[k, TILE_FIRST] = left // TILE
        boxes[k, TILE_LAST] = right // TILE + 1
        boxes[k, ROW_FIRST] = top
        boxes[k, ROW_LAST] = bottom + 1
        counts[k] = right // TILE + 1 - left // TILE


@kernel
def find_spans(
    start: int, stop: int, ellipses: F32, boxes: I32, column_offsets: I64, spans: I32, counts: I64
) -> None:
    """Find the pixel rows ``[first, last)`` of each tile column that an ellipse reaches, and count its tiles.

    Alpha is below its threshold outside the ellipse A dx^2 + B dx dy + C dy^2 = ln(255 opacity). Its upper boundary
    is a concave function of dx, so its highest point in a column is the one nearest to the top of the ellipse.

    Args:
        column_offsets: First entry of each ellipse in ``spans [V + 1]``.
        spans: Receives first and last row of each tile column of each box ``[S, 2]``; equal if there is none.
        counts: Receives the number of tiles of each ellipse ``[V]``.
    """
    for k in range(start, stop):
        counts[k] = 0
        a, b, c = (
            np.float64(ellipses[k, HALF_A]),
            np.float64(ellipses[k, CONIC_B]),
            np.float64(ellipses[k, HALF_C]),
        )
        roundness = 1.0 - b * b / (4.0 * a * c)
        # The margin covers the rounding of the exponent in float32, which grows as the ellipse gets thinner.
        reach = math.log(255.0 * np.float64(ellipses[k, OPACITY])) * (1.0001 + 4e-6 / roundness) + 1e-4
        top = -b / (2.0 * a) * math.sqrt(max(reach / (c * roundness), 0.0))
        for tile_x in range(boxes[k, TILE_FIRST], boxes[k, TILE_LAST]):
            span = column_offsets[k] + tile_x - boxes[k, TILE_FIRST]
            first, last = boxes[k, ROW_FIRST], boxes[k, ROW_LAST]
            if roundness > ROUND_MIN:
                left = tile_x * TILE + 0.5 - ellipses[k, CENTER_X] - SLACK
                right = left + (TILE - 1) + 2 * SLACK
                above, below = min(max(top, left), right), min(max(-top, left), right)
                root_above = b * b * above * above - 4.0 * c * (a * above * above - reach)
                root_below = b * b * below * below - 4.0 * c * (a * below * below - reach)
                if root_above < 0.0 or root_below < 0.0:
                    last = first
                else:
                    center = ellipses[k, CENTER_Y] - 0.5
                    lowest = center - SLACK - (b * below + math.sqrt(root_below)) / (2.0 * c)
                    highest = center + SLACK + (math.sqrt(root_above) - b * above) / (2.0 * c)
                    first = max(first, math.ceil(max(lowest, 0.0)))
                    last = max(first, min(last, math.floor(min(highest, 1e9)) + 1))
            spans[span, 0], spans[span, 1] = first, last
            if last > first:
                counts[k] += (last - 1) // TILE - first // TILE + 1


@kernel
def offsets_of(histogram: I64, tile_offsets: I64) -> None:
    """Replace the counts by the index of the first pair of each tile and, within it, of each strip."""
    strips, tiles = histogram.shape
    total = 0
    for tile in range(tiles):
        tile_offsets[tile] = total
        for strip in range(strips):
            here = histogram[strip, tile]
            histogram[strip, tile] = total
            total += here
    tile_offsets[tiles] = total


@kernel
def list_pairs(
    start: int,
    stop: int,
    counts_only: bool,
    boxes: I32,
    column_offsets: I64,
    spans: I32,
    tiles_x: int,
    histogram: I64,
    pair_offsets: I64,
    members: I32,
    pairs: I32,
    rows: U8,
) -> None:
    """Count the pairs of every tile, separately for each strip of Gaussians; after `offsets_of`, list them by tile.

    Strips are consecutive within a tile, which preserves depth order.
    """
    total, strips = boxes.shape[0], histogram.shape[0]
    for strip in range(start, stop):
        for k in range(strip * total // strips, (strip + 1) * total // strips):
            if boxes[k, ROW_LAST] == 0:
                continue
            pair = pair_offsets[k]
            for tile_y in range(boxes[k, ROW_FIRST] // TILE, (boxes[k, ROW_LAST] - 1) // TILE + 1):
                for tile_x in range(boxes[k, TILE_FIRST], boxes[k, TILE_LAST]):
                    span = column_offsets[k] + tile_x - boxes[k, TILE_FIRST]
                    first = max(spans[span, 0] - tile_y * TILE, 0)
                    last = min(spans[span, 1] - tile_y * TILE, TILE)
                    if last <= first:
                        continue
                    tile = tile_y * tiles_x + tile_x
                    slot = histogram[strip, tile]
                    histogram[strip, tile] = slot + 1
                    if not counts_only:
                        members[slot] = k
                        pairs[slot] = pair
                        rows[slot, 0], rows[slot, 1] = first, last
                        pair += 1
