"""The photometric loss and its gradient in three sweeps over the rows of an image (Numba, CPU).

Images are ``[H, W3]`` with ``W3 = 3 W``: the colors are interleaved, so a horizontal tap is a shift by 3 and every
inner loop runs over contiguous memory. This module is separate from `image_losses` so that Numba is imported only
when a loss is computed on a CPU.
"""

from __future__ import annotations

import math

import numpy as np

from lexsplat.rendering.kernels.jit import kernel, parallel

TAPS = 11
RADIUS = 5
C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)
PIVOT = np.float32(0.5)
"""Subtracted from the photo in products, which halves rounding errors and does not change covariances."""
PIXELS_PER_PIECE = 16_384
"""Pixels per work item of a thread: about half a millisecond."""


def photometric(
    image: np.ndarray,
    target: np.ndarray,
    mean: np.ndarray,
    variance: np.ndarray,
    taps: tuple[np.ndarray, ...],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[float, float, np.ndarray]:
    """Sums of absolute differences and of SSIM over all pixels and colors, and the gradient of the loss.

    Args:
        image: ``[H, W3]`` float32, as is every array here.
        target: ``[H, W3]``.
        mean: Local mean of the target ``[H, W3]``.
        variance: Local variance of the target ``[H, W3]``.
        taps: Vertical ``[H, 11]``, horizontal ``[11, W3]``, and the same of the transposed blur.
        l1_weight: Factor of ``sum |image - target|`` in the loss.
        ssim_weight: Factor of ``-sum SSIM`` in the loss.

    Returns:
        ``(sum |image - target|, sum SSIM, gradient [H, W3])``; the sums do not depend on the number of
        threads.
    """
    height, width3 = image.shape
    vertical, horizontal, vertical_t, horizontal_t = taps
    products = np.empty((3, height, width3), np.float32)
    by_blurred = np.empty((3, height, width3), np.float32)
    gradient = np.empty((height, width3), np.float32)
    # NumPy sums at the end, because a sum inside the kernel's loop would prevent its vectorization.
    scores = np.empty((height, width3), np.float32)
    differences = np.empty((height, width3), np.float32)
    weights = np.float32(l1_weight), np.float32(ssim_weight)
    grain = max(1, 3 * PIXELS_PER_PIECE // width3)
    parallel(_multiply, height, grain, image, target, products)
    parallel(_compare, height, grain, products, mean, variance, vertical, horizontal, by_blurred, scores)
    parallel(
        *(_backward, height, grain, by_blurred, image, target),
        *(vertical_t, horizontal_t, *weights, gradient, differences),
    )
    return float(differences.sum(dtype=np.float64)), float(scores.sum(dtype=np.float64)), gradient


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local mean and variance of a photo under the window of SSIM, its borders reflected.

    Sums are in float64, because rounding of the squares would swamp the variance of bright, flat areas.

    Args:
        image: ``[H, W3]`` float32.

    Returns:
        Two arrays ``[H, W3]`` float32.
    """
    mean, variance = np.empty_like(image), np.empty_like(image)
    grain = max(1, PIXELS_PER_PIECE // image.shape[1])
    parallel(_moments, len(image), grain, image, _weights(), mean, variance)
    return mean, variance


def _weights() -> np.ndarray:
    weights = np.array([math.exp(-((k - RADIUS) ** 2) / (2 * 1.5**2)) for k in range(TAPS)])
    return weights / weights.sum()


def reflected_taps(length: int) -> tuple[np.ndarray, np.ndarray]:
    """Taps of a Gaussian blur (sigma 1.5) of a line that is reflected at its ends, and of its transpose.

    Args:
        length: Number of samples, at least 6.

    Returns:
        Two ``[length, 11]`` float32 arrays: entry ``(i, k)`` weighs sample ``i + k - 5`` in the result at
        ``i``; samples outside weigh nothing.
    """
    weights = _weights()
    forward = np.zeros((length, TAPS))
    transposed = np.zeros((length, TAPS))
    for i in range(length):
        for k in range(TAPS):
            source = abs(i + k - RADIUS)
            if source >= length:
                source = 2 * (length - 1) - source
            forward[i, source - i + RADIUS] += weights[k]
            transposed[source, i - source + RADIUS] += weights[k]
    return forward.astype(np.float32), transposed.astype(np.float32)


@kernel
def _moments(
    start: int, stop: int, image: np.ndarray, weights: np.ndarray, mean: np.ndarray, variance: np.ndarray
) -> None:
    height, width3 = image.shape
    pad = 3 * RADIUS
    sums = np.empty(width3 + 2 * pad, np.float64)
    squares = np.empty(width3 + 2 * pad, np.float64)
    for y in range(start, stop):
        sums[:] = 0.0
        squares[:] = 0.0
        for k in range(TAPS):
            source = abs(y + k - RADIUS)
            if source >= height:
                source = 2 * (height - 1) - source
            weight = weights[k]
            for i in range(width3):
                value = np.float64(image[source, i])
                sums[i + pad] += weight * value
                squares[i + pad] += weight * value * value
        for j in range(1, RADIUS + 1):
            for c in range(3):
                low, high = pad + c, pad + width3 - 3 + c
                sums[low - 3 * j], squares[low - 3 * j] = sums[low + 3 * j], squares[low + 3 * j]
                sums[high + 3 * j], squares[high + 3 * j] = sums[high - 3 * j], squares[high - 3 * j]
        for i in range(width3):
            total, square = 0.0, 0.0
            for k in range(TAPS):
                total += weights[k] * sums[i + 3 * k]
                square += weights[k] * squares[i + 3 * k]
            mean[y, i] = total
            variance[y, i] = max(square - total * total, 0.0)


@kernel
def _multiply(start: int, stop: int, image: np.ndarray, target: np.ndarray, products: np.ndarray) -> None:
    """The three maps whose blurs SSIM needs: d, d^2 and d (t - 1/2), with d = x - t."""
    for y in range(start, stop):
        for i in range(image.shape[1]):
            d = image[y, i] - target[y, i]
            products[0, y, i] = d
            products[1, y, i] = d * d
            products[2, y, i] = d * (target[y, i] - PIVOT)


@kernel
def _blur_row(
    maps: np.ndarray,
    y: int,
    vertical: np.ndarray,
    horizontal: np.ndarray,
    padded: np.ndarray,
    blurred: np.ndarray,
) -> None:
    """Row ``y`` of three maps ``[3, H, W3]``, blurred, into ``blurred`` ``[3, W3]``.

    Taps depend on the position, which is how borders are reflected. ``padded`` ``[3, W3 + 30]`` is scratch
    whose two ends are zero.
    """
    height, width3 = maps.shape[1], maps.shape[2]
    for c in range(3):
        # Constant trip counts over the taps: the compiler unrolls them and keeps the sums in registers.
        if RADIUS <= y < height - RADIUS:
            for i in range(width3):
                total = np.float32(0.0)
                for k in range(TAPS):
                    total += vertical[y, k] * maps[c, y - RADIUS + k, i]
                padded[c, i + 3 * RADIUS] = total
        else:
            for i in range(width3):
                total = np.float32(0.0)
                for k in range(max(0, RADIUS - y), min(TAPS, height + RADIUS - y)):
                    total += vertical[y, k] * maps[c, y - RADIUS + k, i]
                padded[c, i + 3 * RADIUS] = total
        for i in range(width3):
            total = np.float32(0.0)
            for k in range(TAPS):
                total += horizontal[k, i] * padded[c, i + 3 * k]
            blurred[c, i] = total


@kernel
def _compare(
    start: int,
    stop: int,
    products: np.ndarray,
    mean: np.ndarray,
    variance: np.ndarray,
    vertical: np.ndarray,
    horizontal: np.ndarray,
    by_blurred: np.ndarray,
    scores: np.ndarray,
) -> None:
    """SSIM of every pixel and its derivative by the three blurred maps.

    It uses differences, because the variances of two nearly equal, bright images are small differences of large
    squares, which float32 would lose. With m, q, p the blurs of d, d^2, d (t - 1/2), and
    a1 = 2 mt (mt + m) + C1, a2 = 2 (vt + p - m (mt - 1/2)) + C2, it is SSIM = a1 / (a1 + m^2) a2 / (a2 + q - m^2).
    """
    width3 = mean.shape[1]
    one, two = np.float32(1.0), np.float32(2.0)
    padded = np.zeros((3, width3 + 6 * RADIUS), np.float32)
    blurred = np.empty((3, width3), np.float32)
    for y in range(start, stop):
        _blur_row(products, y, vertical, horizontal, padded, blurred)
        for i in range(width3):
            m = blurred[0, i]
            mt = mean[y, i]
            square = m * m
            spread = max(blurred[1, i] - square, np.float32(0.0))
            a1 = two * mt * (mt + m) + C1
            a2 = two * (variance[y, i] + blurred[2, i] - m * (mt - PIVOT)) + C2
            over1, over2 = one / (a1 + square), one / (a2 + spread)
            luminance, structure = a1 * over1, a2 * over2
            scores[y, i] = luminance * structure
            # 1 - luminance is m^2 * over1, and 1 - structure is spread * over2.
            by_product = two * luminance * spread * over2 * over2
            by_square = -luminance * structure * over2
            by_mean = two * structure * over1 * (mt * square * over1 - luminance * m)
            by_blurred[0, y, i] = by_mean - two * m * by_square - (mt - PIVOT) * by_product
            by_blurred[1, y, i] = by_square
            by_blurred[2, y, i] = by_product


@kernel
def _backward(
    start: int,
    stop: int,
    by_blurred: np.ndarray,
    image: np.ndarray,
    target: np.ndarray,
    vertical_t: np.ndarray,
    horizontal_t: np.ndarray,
    l1_weight: np.float32,
    ssim_weight: np.float32,
    gradient: np.ndarray,
    differences: np.ndarray,
) -> None:
    """The gradient by the image, from the transposed blur of the derivatives, and absolute differences."""
    width3 = image.shape[1]
    two = np.float32(2.0)
    padded = np.zeros((3, width3 + 6 * RADIUS), np.float32)
    blurred = np.empty((3, width3), np.float32)
    for y in range(start, stop):
        _blur_row(by_blurred, y, vertical_t, horizontal_t, padded, blurred)
        for i in range(width3):
            x = image[y, i]
            t = target[y, i]
            difference = x - t
            by_ssim = blurred[0, i] + two * difference * blurred[1, i] + (t - PIVOT) * blurred[2, i]
            differences[y, i] = abs(difference)
            sign = np.float32(difference > 0) - np.float32(difference < 0)
            gradient[y, i] = l1_weight * sign - ssim_weight * by_ssim
