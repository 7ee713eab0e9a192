"""The gradient of blending: one row of values per pair, then a sum over the pairs of each Gaussian.

Blending is undone from back to front, starting from the transmittance and the last pair of each pixel that the
forward pass keeps. The contribution of everything behind a Gaussian is then a sum, not a difference of two large
numbers: gradients behind a nearly opaque Gaussian are as exact as those in front of it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from lexsplat.rendering.kernels.arrays import F32, I32, I64, U8
from lexsplat.rendering.kernels.binning import CONIC_B, HALF_A, HALF_C, OPACITY, TILE
from lexsplat.rendering.kernels.blending import (
    ALPHA_MAX,
    HALF,
    ONE,
    PIXELS,
    ZERO,
    alpha_of,
    column_numbers,
    seen_from_tile,
)
from lexsplat.rendering.kernels.jit import kernel
from lexsplat.rendering.kernels.lanes import (
    any_positive,
    load,
    select_greater,
    splat,
    store,
    store_totals,
    total,
)

GEOMETRY_FIELDS = 6
"""Columns of a row before the channels: gradient w.r.t. the exponent times 1, dx, dy, dx^2, dx dy, dy^2."""


@kernel
def row_width(channels: int) -> int:
    """Values per pair: the moments and the channels, at least eight so that two vectors of four fit."""
    return max(GEOMETRY_FIELDS + channels, 8)


@kernel
def _load_tile(
    tile: int,
    tiles_x: int,
    colors: int,
    background: F32,
    passed: F32,
    grad_image: F32,
    grad_alpha: F32,
    upstream: F32,
    live: F32,
    behind: F32,
) -> None:
    """Load the transmittance and the gradients of the tile's pixels, and what the background adds to the loss."""
    height, width, channels = grad_image.shape
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    if left + TILE > width or top + TILE > height:
        upstream[:] = ZERO
        behind[:] = ZERO
    for j in range(TILE):
        store(live, j * TILE, load(passed, (tile * TILE + j) * TILE))
    for j in range(min(TILE, height - top)):
        for i in range(min(TILE, width - left)):
            loss = -grad_alpha[top + j, left + i]
            for channel in range(channels):
                gradient = grad_image[top + j, left + i, channel]
                upstream[(j * channels + channel) * TILE + i] = gradient
                if channel < colors and channel < background.shape[0]:
                    loss += gradient * background[channel]
            behind[j * TILE + i] = loss * live[j * TILE + i]


@kernel
def _last_of_tile(last: F32, tile: int) -> int:
    """Number of pairs of the tile up to the last one that a pixel shows."""
    most = ZERO
    for i in range(tile * PIXELS, (tile + 1) * PIXELS):
        most = max(most, last[i])
    return int(most)


@kernel
def _feature_gradients(
    first: int, last: int, colors: int, channels: int, weights: F32, upstream: F32, row: int, rows: F32
) -> None:
    """Sum of weight times upstream gradient for the channels after the colors, four at a time.

    The last group of four overlaps the previous one; fewer than four channels are processed one by one.
    """
    channel = colors
    while channel < channels:
        if channels - colors >= 4:
            channel = min(channel, channels - 4)
            s0, s1, s2, s3 = splat(ZERO), splat(ZERO), splat(ZERO), splat(ZERO)
            for j in range(first, last):
                weight = load(weights, j * TILE)
                place = (j * channels + channel) * TILE
                s0 += weight * load(upstream, place)
                s1 += weight * load(upstream, place + TILE)
                s2 += weight * load(upstream, place + 2 * TILE)
                s3 += weight * load(upstream, place + 3 * TILE)
            store_totals(rows, row + GEOMETRY_FIELDS + channel, s0, s1, s2, s3)
            channel += 4
        else:
            s0 = splat(ZERO)
            for j in range(first, last):
                s0 += load(weights, j * TILE) * load(upstream, (j * channels + channel) * TILE)
            rows[row + GEOMETRY_FIELDS + channel] = total(s0)
            channel += 1


@partial(kernel, inlined=True)
def _pair_gradients(
    k: int,
    tile: int,
    number: np.float32,
    left: int,
    top: int,
    ellipses: F32,
    first: int,
    last: int,
    values: F32,
    columns: Any,
    colors: int,
    channels: int,
    geometry: bool,
    last_pairs: F32,
    live: F32,
    behind: F32,
    upstream: F32,
    weights: F32,
    row: int,
    rows: F32,
) -> None:
    """Gradients of ellipse ``k`` in the tile at pixel (left, top), written from ``rows[row]``, which is zero, on.

    ``number`` of the tile's pairs lie in front of it. Takes it off ``live`` and adds it to ``behind``; ``weights`` is
    scratch.
    """
    dx, across, slope, down, dy0, opacity = seen_from_tile(ellipses, k, left, top, columns)
    red, green, blue = ZERO, ZERO, ZERO
    if colors == 3:
        red, green, blue = values[k, 0], values[k, 1], values[k, 2]
    zeros = splat(ZERO)
    g0, g1, g2, r0, r1, r2 = zeros, zeros, zeros, zeros, zeros, zeros
    touched = False
    for j in range(first, last):
        dy = np.float32(j) + dy0
        row_alpha = alpha_of(across + down * dy * dy, slope, dy, opacity)
        row_alpha = select_greater(load(last_pairs, (tile * TILE + j) * TILE), number, row_alpha, ZERO)
        if not any_positive(row_alpha):
            if channels > colors:
                store(weights, j * TILE, zeros)
            continue
        touched = True
        inverse = ONE / (ONE - row_alpha)
        before = load(live, j * TILE) * inverse
        store(live, j * TILE, before)
        weight = row_alpha * before
        if channels > colors:
            store(weights, j * TILE, weight)
        dots = zeros
        if colors == 3:
            place = j * channels * TILE
            u0, u1 = load(upstream, place), load(upstream, place + TILE)
            u2 = load(upstream, place + 2 * TILE)
            r0 += weight * u0
            r1 += weight * u1
            r2 += weight * u2
            dots = u0 * red + u1 * green + u2 * blue
        if not geometry:
            continue
        # d loss / d alpha = T dots - behind / (1 - alpha), and d alpha / d exponent = -alpha.
        share = weight * dots
        rest = load(behind, j * TILE)
        store(behind, j * TILE, rest + share)
        gradient = rest * row_alpha * inverse - share
        gradient = select_greater(ALPHA_MAX, row_alpha, gradient, ZERO)
        g0 += gradient
        g1 += gradient * dy
        g2 += gradient * (dy * dy)
    if touched:
        # Without colors, the two sums after the moments are zero and are overwritten by the features.
        store_totals(rows, row, g0, g0 * dx, g1, g0 * dx * dx)
        store_totals(rows, row + 4, g1 * dx, g2, r0, r1)
        if colors == 3:
            rows[row + GEOMETRY_FIELDS + 2] = total(r2)
        _feature_gradients(first, last, colors, channels, weights, upstream, row, rows)


@kernel
def blend_backward(
    start: int,
    stop: int,
    ellipses: F32,
    tile_offsets: I64,
    members: I32,
    pairs: I32,
    reached: U8,
    values: F32,
    background: F32,
    tiles_x: int,
    colors: int,
    geometry: bool,
    passed: F32,
    last_pairs: F32,
    grad_image: F32,
    grad_alpha: F32,
    rows: F32,
) -> None:
    """Gradients of every pair in tiles ``start`` to ``stop``, written to ``rows [M * row_width(C)]``.

    Args:
        reached: Rows of the tile that each pair reaches ``[M, 2]``.
        background: As in `blend`.
        colors: 3 or 0. Only these first channels and alpha contribute to the gradients of the geometry; the other
            channels contribute to the gradients of their own values only.
        geometry: Whether gradients of the geometry are required.
        passed: From `blend`.
        last_pairs: From `blend`.
    """
    channels = grad_image.shape[2]
    live, weights = np.empty(PIXELS, np.float32), np.empty(PIXELS, np.float32)
    behind, upstream = np.empty(PIXELS, np.float32), np.empty(PIXELS * channels, np.float32)
    fields = row_width(channels)
    columns = column_numbers()
    for tile in range(start, stop):
        first, end = tile_offsets[tile], tile_offsets[tile + 1]
        if first == end:
            continue
        for slot in range(first, end):
            row = np.int64(pairs[slot]) * fields
            for field in range(row, row + fields):
                rows[field] = ZERO
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        _load_tile(tile, tiles_x, colors, background, passed, grad_image, grad_alpha, upstream, live, behind)
        for number in range(min(_last_of_tile(last_pairs, tile), end - first) - 1, -1, -1):
            slot = first + number
            _pair_gradients(
                members[slot], tile, np.float32(number), left, top, ellipses, np.int64(reached[slot, 0]),
                np.int64(reached[slot, 1]), values, columns, colors, channels, geometry, last_pairs, live, behind,
                upstream, weights, np.int64(pairs[slot]) * fields, rows,
            )  # fmt: skip


@kernel
def sum_pairs(
    start: int,
    stop: int,
    order: I32,
    ellipses: F32,
    pair_offsets: I64,
    rows: F32,
    geometry: bool,
    colors: int,
    grad_means2d: F32,
    grad_conics: F32,
    grad_opacities: F32,
    grad_colors: F32,
    grad_features: F32,
) -> None:
    """Sum the rows of each Gaussian in a fixed order and convert the moments to gradients."""
    fields = row_width(colors + grad_features.shape[1])
    sums = np.empty(fields, np.float32)
    two = np.float32(2)
    for k in range(start, stop):
        n = order[k]
        sums[:] = ZERO
        for pair in range(pair_offsets[k], pair_offsets[k + 1]):
            for field in range(fields):
                sums[field] += rows[pair * fields + field]
        for channel in range(colors):
            grad_colors[n, channel] = sums[GEOMETRY_FIELDS + channel]
        for channel in range(grad_features.shape[1]):
            grad_features[n, channel] = sums[GEOMETRY_FIELDS + colors + channel]
        if geometry:
            a, b, c = two * ellipses[k, HALF_A], ellipses[k, CONIC_B], two * ellipses[k, HALF_C]
            grad_means2d[n, 0] = -(a * sums[1] + b * sums[2])
            grad_means2d[n, 1] = -(b * sums[1] + c * sums[2])
            grad_conics[n, 0] = HALF * sums[3]
            grad_conics[n, 1] = sums[4]
            grad_conics[n, 2] = HALF * sums[5]
            grad_opacities[n] = -sums[0] / ellipses[k, OPACITY]


@kernel
def gather(start: int, stop: int, order: I32, source: F32, column: int, values: F32) -> None:
    """Copy the rows of ``source`` in depth order to the columns of ``values`` from ``column`` on."""
    for k in range(start, stop):
        n = order[k]
        for channel in range(source.shape[1]):
            values[k, column + channel] = source[n, channel]
