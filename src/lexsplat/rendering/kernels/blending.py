"""Front-to-back blending of one tile after another, and its gradient.

The Gaussian is the outer loop and a contiguous run of pixels the inner one, so the inner loop uses the whole
vector unit. Literals are float32: one float64 literal would double the width of everything it touches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels.binning import (
    CENTRE_X,
    CENTRE_Y,
    CONIC_B,
    HALF_A,
    HALF_C,
    OPACITY,
    ROW_FIRST,
    ROW_LAST,
    TILE,
)
from lexsplat.rendering.kernels.jit import fast_kernel, kernel

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

PIXELS = TILE * TILE
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
ALPHA_THRESHOLD = np.float32(1.0 / 255.0)
ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)
"""A pixel is finished before the Gaussian that would take its transmittance to this value or below."""
CHECK_EVERY = 16
"""Gaussians between two looks at whether the whole tile is finished."""
GEOMETRY_FIELDS = 6

# exp(-s) = P(-s / 8)^8 for 0 <= s <= 6, relative error 1e-6. Beyond s = ln 255 = 5.54 alpha is below its threshold.
FARTHEST = np.float32(6)
EIGHTH = np.float32(-0.125)
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
def start_tile(tile: int, tiles_x: int, width: int, height: int, x: F32, y: F32, live: F32) -> None:
    """Pixel centres, and transmittance 1 inside the image, 0 outside."""
    left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    for j in range(TILE):
        for i in range(TILE):
            x[j * TILE + i] = np.float32(left + i) + HALF
            y[j * TILE + i] = np.float32(top + j) + HALF
            live[j * TILE + i] = ONE if left + i < width and top + j < height else ZERO


@fast_kernel
def blend_weights(x: F32, y: F32, e: F32, live: F32, final: F32, weights: F32) -> np.float32:
    """Weight alpha T of one Gaussian at each pixel; updates the transmittance. Returns the sum of weights.

    ``live`` is the transmittance, or 0 once a pixel is finished; ``final`` keeps its last value.
    """
    mx, my, a, b, c, opacity = e[CENTRE_X], e[CENTRE_Y], e[HALF_A], e[CONIC_B], e[HALF_C], e[OPACITY]
    total = ZERO
    for i in range(x.shape[0]):
        dx = x[i] - mx
        dy = y[i] - my
        s = min(max((a * dx + b * dy) * dx + c * dy * dy, ZERO), FARTHEST) * EIGHTH
        p = E0 + s * (E1 + s * (E2 + s * (E3 + s * (E4 + s * E5))))
        p = p * p
        p = p * p
        alpha = min(ALPHA_MAX, p * p * opacity)
        alpha = alpha if alpha >= ALPHA_THRESHOLD else ZERO
        before = live[i]
        after = before * (ONE - alpha)
        going = after > TRANSMITTANCE_MIN
        weight = alpha * before if going else ZERO
        weights[i] = weight
        final[i] = after if going else final[i]
        live[i] = after if going else ZERO
        total += weight
    return total


@fast_kernel
def _add_scaled(factor: np.float32, values: F32, target: F32) -> None:
    for i in range(values.shape[0]):
        target[i] += factor * values[i]


@fast_kernel
def sum_of(values: F32) -> np.float32:
    total = ZERO
    for i in range(values.shape[0]):
        total += values[i]
    return total


@kernel
def blend(
    start: int,
    stop: int,
    ellipses: F32,
    boxes: I32,
    tile_offsets: I64,
    members: I32,
    values: F32,
    background: F32,
    tiles_x: int,
    image: F32,
    alpha: F32,
) -> None:
    """Render tiles ``start`` to ``stop``: ``image [H, W, C]`` and ``alpha [H, W]``.

    Args:
        values: Channels of each Gaussian in depth order ``[V, C]``.
        background: Added behind the first channels ``[B]``, B <= C; the others composite over zero.
    """
    height, width, channels = image.shape
    work = np.empty((5, PIXELS), np.float32)
    x, y, live, final, weights = work[0], work[1], work[2], work[3], work[4]
    sums = np.empty((channels, PIXELS), np.float32)
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        start_tile(tile, tiles_x, width, height, x, y, live)
        final[:] = live
        sums[:] = ZERO
        countdown = CHECK_EVERY
        for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
            k = members[slot]
            first = max(boxes[k, ROW_FIRST] - top, 0) * TILE
            last = min(boxes[k, ROW_LAST] - top, TILE) * TILE
            total = blend_weights(
                x[first:last],
                y[first:last],
                ellipses[k],
                live[first:last],
                final[first:last],
                weights[first:last],
            )
            if total > ZERO:
                for c in range(channels):
                    _add_scaled(values[k, c], weights[first:last], sums[c, first:last])
            countdown -= 1
            if countdown == 0:
                countdown = CHECK_EVERY
                if sum_of(live) == ZERO:
                    break
        for j in range(min(TILE, height - top)):
            for i in range(min(TILE, width - left)):
                transmittance = final[j * TILE + i]
                alpha[top + j, left + i] = ONE - transmittance
                for c in range(background.shape[0]):
                    image[top + j, left + i, c] = sums[c, j * TILE + i] + transmittance * background[c]
                for c in range(background.shape[0], channels):
                    image[top + j, left + i, c] = sums[c, j * TILE + i]


@fast_kernel
def _blend_weights_again(
    x: F32, y: F32, e: F32, live: F32, weights: F32, alphas: F32, before: F32, dots: F32
) -> np.float32:
    """As `blend_weights`, keeping what the gradient needs; clears ``dots``."""
    mx, my, a, b, c, opacity = e[CENTRE_X], e[CENTRE_Y], e[HALF_A], e[CONIC_B], e[HALF_C], e[OPACITY]
    total = ZERO
    for i in range(x.shape[0]):
        dx = x[i] - mx
        dy = y[i] - my
        s = min(max((a * dx + b * dy) * dx + c * dy * dy, ZERO), FARTHEST) * EIGHTH
        p = E0 + s * (E1 + s * (E2 + s * (E3 + s * (E4 + s * E5))))
        p = p * p
        p = p * p
        alpha = min(ALPHA_MAX, p * p * opacity)
        alpha = alpha if alpha >= ALPHA_THRESHOLD else ZERO
        here = live[i]
        after = here * (ONE - alpha)
        going = after > TRANSMITTANCE_MIN
        alpha = alpha if going else ZERO
        alphas[i] = alpha
        before[i] = here
        weights[i] = alpha * here
        dots[i] = ZERO
        live[i] = after if going else ZERO
        total += alpha
    return total


@fast_kernel
def _geometry_channel(value: np.float32, upstream: F32, weights: F32, dots: F32) -> np.float32:
    """Gradient of one channel value; adds value * upstream to what the weight is worth."""
    total = ZERO
    for i in range(weights.shape[0]):
        dots[i] += value * upstream[i]
        total += weights[i] * upstream[i]
    return total


@fast_kernel
def _dot(left: F32, right: F32) -> np.float32:
    total = ZERO
    for i in range(left.shape[0]):
        total += left[i] * right[i]
    return total


@fast_kernel
def _geometry_moments(
    x: F32, y: F32, e: F32, alphas: F32, before: F32, weights: F32, dots: F32, behind: F32, row: F32
) -> None:
    """Gradient by the exponent s, summed over the pixels times 1, dx, dy, dx^2, dx dy, dy^2.

    d loss / d alpha = T dots - behind / (1 - alpha), where ``behind`` is what everything after this Gaussian
    contributes to the loss; front to back it is the total less what has been passed.
    """
    mx, my = e[CENTRE_X], e[CENTRE_Y]
    m0 = m1 = m2 = m3 = m4 = m5 = ZERO
    for i in range(x.shape[0]):
        dx = x[i] - mx
        dy = y[i] - my
        rest = behind[i] - weights[i] * dots[i]
        behind[i] = rest
        alpha = alphas[i]
        grad = -alpha * (before[i] * dots[i] - rest / (ONE - alpha))
        grad = grad if alpha < ALPHA_MAX else ZERO
        gx = grad * dx
        gy = grad * dy
        m0 += grad
        m1 += gx
        m2 += gy
        m3 += gx * dx
        m4 += gx * dy
        m5 += gy * dy
    row[0] = m0
    row[1] = m1
    row[2] = m2
    row[3] = m3
    row[4] = m4
    row[5] = m5


@kernel
def blend_backward(
    start: int,
    stop: int,
    ellipses: F32,
    boxes: I32,
    tile_offsets: I64,
    members: I32,
    pairs: I32,
    values: F32,
    tiles_x: int,
    geometry_channels: int,
    geometry: bool,
    image: F32,
    alpha: F32,
    grad_image: F32,
    grad_alpha: F32,
    rows: F32,
) -> None:
    """Gradients of every pair in tiles ``start`` to ``stop``, written to ``rows [M, 6 + C]``.

    Only the first ``geometry_channels`` and alpha have a say in the geometry; the other channels give gradients
    to their values alone. Without ``geometry`` the six geometry columns are left as they are.
    """
    height, width, channels = image.shape
    work = np.empty((8, PIXELS), np.float32)
    x, y, live, behind, weights, alphas, before, dots = (
        work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7]
    )  # fmt: skip
    upstream = np.zeros((channels, PIXELS), np.float32)
    for tile in range(start, stop):
        if tile_offsets[tile] == tile_offsets[tile + 1]:
            continue
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        start_tile(tile, tiles_x, width, height, x, y, live)
        upstream[:] = ZERO
        behind[:] = ZERO
        for j in range(min(TILE, height - top)):
            for i in range(min(TILE, width - left)):
                total = -(ONE - alpha[top + j, left + i]) * grad_alpha[top + j, left + i]
                for c in range(channels):
                    upstream[c, j * TILE + i] = grad_image[top + j, left + i, c]
                for c in range(geometry_channels):
                    total += grad_image[top + j, left + i, c] * image[top + j, left + i, c]
                behind[j * TILE + i] = total
        countdown = CHECK_EVERY
        finished = False
        for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
            row = rows[pairs[slot]]
            if finished:
                row[:] = ZERO
                continue
            k = members[slot]
            first = max(boxes[k, ROW_FIRST] - top, 0) * TILE
            last = min(boxes[k, ROW_LAST] - top, TILE) * TILE
            total = _blend_weights_again(
                x[first:last], y[first:last], ellipses[k], live[first:last], weights[first:last],
                alphas[first:last], before[first:last], dots[first:last],
            )  # fmt: skip
            if total > ZERO:
                for c in range(geometry_channels):
                    row[GEOMETRY_FIELDS + c] = _geometry_channel(
                        values[k, c], upstream[c, first:last], weights[first:last], dots[first:last]
                    )
                for c in range(geometry_channels, channels):
                    row[GEOMETRY_FIELDS + c] = _dot(upstream[c, first:last], weights[first:last])
                if geometry:
                    _geometry_moments(
                        x[first:last], y[first:last], ellipses[k], alphas[first:last], before[first:last],
                        weights[first:last], dots[first:last], behind[first:last], row,
                    )  # fmt: skip
            else:
                row[:] = ZERO
            countdown -= 1
            if countdown == 0:
                countdown = CHECK_EVERY
                finished = sum_of(live) == ZERO


@kernel
def sum_pairs(
    start: int,
    stop: int,
    order: I32,
    ellipses: F32,
    pair_offsets: I64,
    rows: F32,
    geometry: bool,
    color_channels: int,
    grad_means2d: F32,
    grad_conics: F32,
    grad_opacities: F32,
    grad_colors: F32,
    grad_features: F32,
) -> None:
    """Sum the rows of each Gaussian in a fixed order and turn moments into gradients."""
    channels = rows.shape[1] - GEOMETRY_FIELDS
    sums = np.empty(rows.shape[1], np.float32)
    two = np.float32(2)
    for k in range(start, stop):
        n = order[k]
        sums[:] = ZERO
        for pair in range(pair_offsets[k], pair_offsets[k + 1]):
            for c in range(GEOMETRY_FIELDS if not geometry else 0, rows.shape[1]):
                sums[c] += rows[pair, c]
        for c in range(color_channels):
            grad_colors[n, c] = sums[GEOMETRY_FIELDS + c]
        for c in range(color_channels, channels):
            grad_features[n, c - color_channels] = sums[GEOMETRY_FIELDS + c]
        if geometry:
            a, b, c2 = two * ellipses[k, HALF_A], ellipses[k, CONIC_B], two * ellipses[k, HALF_C]
            grad_means2d[n, 0] = -(a * sums[1] + b * sums[2])
            grad_means2d[n, 1] = -(b * sums[1] + c2 * sums[2])
            grad_conics[n, 0] = HALF * sums[3]
            grad_conics[n, 1] = sums[4]
            grad_conics[n, 2] = HALF * sums[5]
            grad_opacities[n] = -sums[0] / ellipses[k, OPACITY]


@kernel
def gather(start: int, stop: int, order: I32, source: F32, column: int, values: F32) -> None:
    """Rows of ``source`` in depth order into columns ``column`` and on of ``values``."""
    for k in range(start, stop):
        n = order[k]
        for c in range(source.shape[1]):
            values[k, column + c] = source[n, c]
