"""Completes an image of a surface where a part of it is missing, by continuing its pattern.

A pattern repeats, so an image of it resembles shifted copies of itself. Masked correlation finds these shifts. A
missing pixel takes the weighted median of the pixels to which the shifts lead (after K. He and J. Sun, "Statistics of
Patch Offsets for Image Completion", ECCV 2012, who choose one shift for each pixel by graph cuts). The weight of a
shift is how well it predicts the rim of the hole near the pixel. Edges between two patterns are therefore continued
as well.

Shifts are found in the image divided by its local brightness, in which shadows weigh less. Colors are taken from the
image itself; the median rejects those of a shadow near the hole. The same prediction is made for the rim, where the
image is known. Its error there decides how far the prediction in the hole is trusted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, minimum_filter

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_SHIFTS = 40
_LEAST = 5
"""Shortest shift in pixels: neighboring pixels are similar without any pattern."""
_OVERLAP = 0.15
"""Share of the rim that a shift must map into the known image."""
_BRIGHTNESS, _RIM, _NEAR, _LOCAL = 0.7, 1.5, 1.0, 0.45
"""Widths in radii of the hole: of the brightness, of the rim that the shifts must predict, of the rim on which they
are compared, and of the neighborhood of a pixel in that comparison."""
_SHARE = 0.3
"""Width of the neighborhood in which predictions are checked, in radii of the hole."""
_CHANCE, _CERTAIN = 0.1, 0.7
"""Right shares of a prediction around a pixel: below the first it is ignored, from the second it is taken whole."""
_SOFT = 1.0
"""Excess of a shift's error over the least error, as a share of the latter, that reduces its weight to 1/e."""


def completed(image: FloatArray, hole: Mask, trust: FloatArray) -> FloatArray:
    """Colors ``[F, 3]`` in 0..1 for the F pixels of a hole.

    Where no shift explains the rim, they are the colors around (`painted`).

    Args:
        image: RGB ``[H, W, 3]``.
        hole: Pixels to paint ``[H, W]``, at least one.
        trust: Weight of the color of each pixel ``[H, W]``, 0 where it is unknown and in the hole.
    """
    image = image.clip(0, 1)
    radius = max(float(np.sqrt(hole.sum() / np.pi)), 2.0)
    away = np.asarray(distance_transform_edt(~hole)) / radius
    brightness = mean_around(image @ _LUMINANCE, trust, _BRIGHTNESS * radius)
    pattern = (image / np.maximum(brightness, 0.02)[..., None]).clip(0, 3)
    rim = trust * np.exp(-((away / _RIM) ** 2))
    mean = (rim[..., None] * pattern).sum((0, 1)) / rim.sum()
    variance = float((rim[..., None] * (pattern - mean) ** 2).sum() / rim.sum())
    smooth = painted(image, hole, trust)
    shifts = self_similar_shifts(pattern, rim, trust)
    if not shifts or variance < 1e-8:
        return smooth
    near = np.exp(-((away / _NEAR) ** 2))
    asked = hole | ((trust > 0) & (away <= _NEAR))
    places = np.argwhere(asked)
    (top, left), (bottom, right) = places.min(0), places.max(0) + 1
    window = slice(top, bottom), slice(left, right)
    values, errors, trusts = [], [], []
    for shift in shifts:
        there, moved = _moved(trust, shift), _moved(pattern, shift)
        error = ((pattern - moved) ** 2).sum(-1).clip(0, 4 * variance)
        local = mean_around(error, trust * there * near, _LOCAL * radius, window=window)
        errors.append(local[asked[window]])
        values.append(np.concatenate([_moved(image, shift)[asked], moved[asked]], 1))
        trusts.append(there[asked])
    found = np.zeros((*hole.shape, 6))
    found[asked] = _voted(np.stack(values, 1), np.stack(errors, 1), np.stack(trusts, 1))
    certain = _predictable(pattern, found[..., 3:], trust * asked, _SHARE * radius)[hole][:, None]
    share = ((certain - _CHANCE) / (_CERTAIN - _CHANCE)).clip(0, 1)
    return np.asarray((share * found[hole][:, :3] + (1 - share) * smooth).clip(0, 1))


def _predictable(image: FloatArray, found: FloatArray, weights: FloatArray, width: float) -> FloatArray:
    """The share of a prediction, beyond the local mean, that is right nearby ``[H, W]``: a local regression."""
    mean = mean_around(image, weights, width)
    right = mean_around(((image - mean) * (found - mean)).sum(-1), weights, width)
    added = mean_around(((found - mean) ** 2).sum(-1), weights, width)
    return np.asarray((right / np.maximum(added, 1e-9)).clip(0, 1))


def self_similar_shifts(pattern: FloatArray, weights: FloatArray, trust: FloatArray) -> list[tuple[int, int]]:
    """The shifts (rows, columns) of highest self-similarity of an image, best first.

    Args:
        pattern: The image ``[H, W, C]``.
        weights: Weight of each pixel ``[H, W]``.
        trust: Weight of each pixel of the shifted image ``[H, W]``.
    """
    overlap = _correlation(weights, trust)
    total = np.zeros_like(overlap)
    for channel in np.moveaxis(pattern, -1, 0):
        total += _correlation(weights * channel**2, trust) + _correlation(weights, trust * channel**2)
        total -= 2 * _correlation(weights * channel, trust * channel)
    height, width = trust.shape
    rows, columns = np.mgrid[-height:height, -width:width]
    enough = (overlap > _OVERLAP * weights.sum()) & (np.hypot(rows, columns) >= _LEAST)
    errors = np.where(enough, total / np.maximum(overlap, 1e-9), np.inf)
    places = np.argwhere(enough & (errors <= minimum_filter(errors, 7)))
    order = np.argsort(errors[tuple(places.T)], kind="stable")[:_SHIFTS]
    return [(int(row) - height, int(column) - width) for row, column in places[order]]


def painted(image: FloatArray, hole: Mask, trust: FloatArray) -> FloatArray:
    """Colors ``[F, 3]`` for the F pixels of a hole: those of its rim, weighted by inverse squared distance."""
    away = np.asarray(distance_transform_edt(~hole))
    limit = max(10.0, float(away[trust > 0].min()) + 1)
    points, places = np.argwhere((trust > 0) & (away <= limit)), np.argwhere(hole)
    points = points[:: 1 + len(points) // 1000]
    weights = trust[tuple(points.T)] / ((places[:, None] - points[None]) ** 2).sum(-1)
    return np.asarray(weights @ image[tuple(points.T)] / weights.sum(1, keepdims=True))


def _voted(values: FloatArray, errors: FloatArray, trusts: FloatArray) -> FloatArray:
    """The values ``[F, C]`` of median brightness among ``[F, K, C]``, weighted; the first three are RGB.

    Args:
        values: The pixels to which each of K shifts leads.
        errors: Their errors ``[F, K]``.
        trusts: Weights of the values ``[F, K]``; values of weight 0 are left out.
    """
    least = np.where(trusts > 0, errors, np.inf).min(1)
    least = np.where(np.isfinite(least), least, 0.0)[:, None]
    weights = trusts * np.exp(-(errors - least) / (_SOFT * least + 1e-9))
    order = (values[..., :3] @ _LUMINANCE).argsort(1)
    sums = np.take_along_axis(weights, order, 1).cumsum(1)
    middle = (sums >= 0.5 * sums[:, -1:]).argmax(1)
    rows = np.arange(len(values))
    return np.asarray(values[rows, order[rows, middle]])


def _correlation(first: FloatArray, second: FloatArray) -> FloatArray:
    """Sum over p of first(p) second(p + s) for every shift s ``[2 H, 2 W]``; s = 0 is at (H, W)."""
    size = (2 * first.shape[0], 2 * first.shape[1])
    product = np.fft.rfft2(first, size).conj() * np.fft.rfft2(second, size)
    return np.fft.fftshift(np.fft.irfft2(product, size))


def _moved(image: NDArray, shift: tuple[int, int]) -> NDArray:
    """The image at p + s for each pixel p; 0 outside."""
    (height, width), (down, right) = image.shape[:2], shift
    moved = np.zeros_like(image)
    if abs(down) < height and abs(right) < width:
        rows, columns = (
            slice(max(0, -down), height - max(0, down)),
            slice(max(0, -right), width - max(0, right)),
        )
        moved[rows, columns] = image[
            max(0, down) : height + min(0, down), max(0, right) : width + min(0, right)
        ]
    return moved


def mean_around(
    values: FloatArray,
    weights: FloatArray,
    width: float,
    truncate: float = 6.0,
    window: tuple[slice, slice] = (slice(None), slice(None)),
) -> FloatArray:
    """Gaussian mean of weighted pixels; far from all it is the mean of all.

    Args:
        values: ``[H, W]`` or ``[H, W, C]``.
        weights: ``[H, W]``.
        width: Standard deviation in pixels.
        truncate: Reach of the filter in standard deviations.
        window: Rows and columns of the result.
    """
    each = weights.reshape(*weights.shape, *[1] * (values.ndim - 2))
    weighted = values * each
    total, summed = (_filtered(image, width, truncate, window) for image in (each, weighted))
    everywhere = weighted.sum((0, 1)) / max(weights.sum(), 1e-12)
    return np.asarray((summed + 1e-6 * everywhere) / (total + 1e-6))


def _filtered(image: FloatArray, width: float, truncate: float, window: tuple[slice, slice]) -> FloatArray:
    """The rows and columns of a window of a Gaussian filter, which reads only what reaches them."""
    reach = int(truncate * width + 0.5)
    for axis, part in enumerate(window):
        start, stop, _ = part.indices(image.shape[axis])
        before = max(start - reach, 0)
        image = np.take(image, range(before, min(stop + reach, image.shape[axis])), axis)
        image = gaussian_filter1d(image, width, axis, mode="constant", truncate=truncate)
        image = np.take(image, range(start - before, stop - before), axis)
    return image
