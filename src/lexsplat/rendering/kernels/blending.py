"""Front-to-back blending by tiles: the forward pass, and functions that its gradient shares.

The outer loop is over Gaussians, and the inner loop processes rows of sixteen pixels (see `lanes`). Per-tile arrays
are flat: row j of the tile starts at 16 j, and row j of channel c of C at 16 (j C + c).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lexsplat.rendering.kernels.arrays import F32, I32, I64, U8
from lexsplat.rendering.kernels.binning import CENTER_X, CENTER_Y, CONIC_B, HALF_A, HALF_C, OPACITY, TILE
from lexsplat.rendering.kernels.jit import kernel
from lexsplat.rendering.kernels.lanes import LANES, any_positive, load, select_greater, store

if TILE != LANES:
    raise RuntimeError(f"a row of a tile must be one vector: TILE {TILE}, LANES {LANES}")
PIXELS = TILE * TILE
# Literals in kernels are float32: a float64 literal would promote every expression it appears in.
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
ALPHA_THRESHOLD = np.float32(1.0 / 255.0)
ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)
"""A pixel is finished when the next Gaussian would reduce its transmittance to this value or below."""
CHECK_EVERY = 16
"""Number of Gaussians between two checks whether all pixels of the tile are finished."""

# exp(-s) = P(-s / 8)^8 for 0 <= s <= 6, relative error 1e-6. Beyond s = ln 255 = 5.54, alpha is below its threshold.
EIGHTH = np.float32(-0.125)
FARTHEST = np.float32(-6.0 / 8.0)
E0, E1, E2, E3, E4, E5 = (
    np.float32(v)
    for v in (
        0.9999998807907104,
        0.9999893307685852,
        0.4998451769351959,
        0.16581964492797852,
        0.03951277211308479,
        0.005693935789167881,
    )
)


@kernel
def start_tile(tile: int, tiles_x: int, width: int, height: int, live: F32) -> None:
    """Initialize the transmittance ``live`` of each pixel: 1 inside the image, 0 outside.

    A finished pixel stores its last transmittance with a minus sign.
    """
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    for j in range(TILE):
        for i in range(TILE):
            live[j * TILE + i] = ONE if left + i < width and top + j < height else ZERO


@kernel
def tile_finished(live: F32) -> bool:
    """Whether all pixels are finished."""
    best = load(live, 0)
    for j in range(1, TILE):
        row = load(live, j * TILE)
        best = select_greater(row, best, row, best)
    return not any_positive(best)


@kernel
def alpha_of(fixed: Any, slope: Any, dy: np.float32, opacity: np.float32) -> Any:
    """Alpha along a row; ``fixed + slope dy`` is -1/8 of the exponent. Values below the threshold become 0."""
    s = fixed + slope * dy
    s = select_greater(s, ZERO, ZERO, s)
    s = select_greater(s, FARTHEST, s, FARTHEST)
    root = E0 + s * (E1 + s * (E2 + s * (E3 + s * (E4 + s * E5))))
    square = root * root
    fourth = square * square
    alpha = fourth * fourth * opacity
    alpha = select_greater(alpha, ALPHA_MAX, ALPHA_MAX, alpha)
    return select_greater(ALPHA_THRESHOLD, alpha, ZERO, alpha)


@kernel
def finish_pixels(before: Any, after: Any) -> Any:
    """New ``live`` values: the transmittance ``after``, or minus ``before`` where the pixel is finished."""
    minus = select_greater(before, ZERO, ZERO - before, before)
    return select_greater(after, TRANSMITTANCE_MIN, after, minus)


@kernel
def pass_row(live: F32, j: int, row_alpha: Any) -> Any:
    """Composite a Gaussian onto row ``j`` of the pixels: updates ``live``, returns its weight in each pixel."""
    before = load(live, j * TILE)
    after = before * (ONE - row_alpha)
    store(live, j * TILE, finish_pixels(before, after))
    return select_greater(after, TRANSMITTANCE_MIN, row_alpha * before, ZERO)


@kernel
def column_numbers() -> Any:
    """The vector 0 to 15."""
    ramp = np.empty(TILE, np.float32)
    for i in range(TILE):
        ramp[i] = i
    return load(ramp, 0)


@kernel
def seen_from_tile(ellipses: F32, k: int, left: int, top: int, columns: Any) -> Any:
    """The terms of ellipse ``k`` for `alpha_of` in the tile whose corner is pixel (left, top).

    Returns:
        dx of the columns; vectors ``across`` and ``slope`` and a scalar ``down`` such that -1/8 of the exponent is
        ``across + slope dy + down dy^2``; dy of row 0; the opacity.
    """
    dx = columns - (ellipses[k, CENTER_X] - np.float32(left) - HALF)
    dy = np.float32(top) + HALF - ellipses[k, CENTER_Y]
    across = dx * dx * (EIGHTH * ellipses[k, HALF_A])
    slope = dx * (EIGHTH * ellipses[k, CONIC_B])
    return dx, across, slope, EIGHTH * ellipses[k, HALF_C], dy, ellipses[k, OPACITY]


@kernel
def blend(
    start: int,
    stop: int,
    ellipses: F32,
    tile_offsets: I64,
    members: I32,
    rows: U8,
    values: F32,
    background: F32,
    tiles_x: int,
    image: F32,
    alpha: F32,
    passed: F32,
    last_pairs: F32,
) -> None:
    """Render tiles ``start`` to ``stop``: ``image [H, W, C]`` and ``alpha [H, W]``.

    Args:
        rows: Rows of the tile that each pair reaches ``[M, 2]``.
        values: Channels of each Gaussian in depth order ``[V, C]``.
        background: Added behind the first channels ``[B]``, B <= C; the others composite over zero.
        passed: Receives the transmittance of each pixel, tile by tile ``[tiles * PIXELS]``; empty keeps nothing.
        last_pairs: Receives the number of the tile's pairs up to the last one that a pixel shows, in the same
            layout; exact up to 2^24 pairs in a tile.
    """
    keep = passed.shape[0] > 0
    height, width, channels = image.shape
    live = np.empty(PIXELS, np.float32)
    sums = np.empty(PIXELS * channels, np.float32)
    columns = column_numbers()
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        start_tile(tile, tiles_x, width, height, live)
        sums[:] = ZERO
        if keep:
            last_pairs[tile * PIXELS : (tile + 1) * PIXELS] = ZERO
        countdown = CHECK_EVERY
        for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
            k = members[slot]
            number = np.float32(slot - tile_offsets[tile] + 1)
            _, across, slope, down, dy0, opacity = seen_from_tile(ellipses, k, left, top, columns)
            for j in range(np.int64(rows[slot, 0]), np.int64(rows[slot, 1])):
                dy = np.float32(j) + dy0
                row_alpha = alpha_of(across + down * dy * dy, slope, dy, opacity)
                weight = pass_row(live, j, row_alpha)
                if any_positive(weight):
                    if keep:
                        here = (tile * TILE + j) * TILE
                        # A sum: a choice becomes a masked store, with which Zen 3 takes 1.6 times as long.
                        kept = load(last_pairs, here)
                        store(last_pairs, here, kept + select_greater(weight, ZERO, number - kept, ZERO))
                    place = j * channels * TILE
                    for channel in range(channels):
                        store(sums, place, load(sums, place) + weight * values[k, channel])
                        place += TILE
            countdown -= 1
            if countdown == 0:
                countdown = CHECK_EVERY
                if tile_finished(live):
                    break
        if keep:
            for i in range(PIXELS):
                passed[tile * PIXELS + i] = abs(live[i])
        for j in range(min(TILE, height - top)):
            for i in range(min(TILE, width - left)):
                transmittance = abs(live[j * TILE + i])
                alpha[top + j, left + i] = ONE - transmittance
                for channel in range(channels):
                    behind = background[channel] if channel < background.shape[0] else ZERO
                    image[top + j, left + i, channel] = (
                        sums[(j * channels + channel) * TILE + i] + transmittance * behind
                    )
