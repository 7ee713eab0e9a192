"""Completes an image of a surface where a part of it is missing, by continuing its pattern.

A pattern repeats, so an image of it resembles shifted copies of itself. Masked correlation finds these shifts. Each
missing pixel is copied from where one of them leads, which is chosen in rounds (`_copied`):

1. At first a pixel takes the weighted median of the pixels to which the shifts lead. The weight of a shift is how
   well it predicts the rim of the hole near the pixel.
2. Then it takes the shift that predicts best what is around the pixel: the rim, and the hole as the last round left
   it. The neighborhood shrinks from round to round, so neighbors agree, and edges between two patterns go on. K. He
   and J. Sun ("Statistics of Patch Offsets for Image Completion", ECCV 2012) choose shifts by graph cuts instead.

Shifts are found in the image divided by its local brightness, in which shadows weigh less. `light` is what the image
lacks beside the hole in the shadow of the thing that stood there.

The median of step 1 is also made for the rim, where the image is known. Its error there decides how far the
prediction in the hole is trusted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, minimum_filter

from lexsplat.queries.colors import LUMINANCE

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

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
_ROUNDS = ((0.3, 0.3), (0.2, 0.6), (0.15, 1.0), (0.1, 1.0))
"""Width of the neighborhood of a pixel in radii of the hole, and weight of the hole in it, in each round: from what
the rim knows to what neighbors must agree on."""
_BRIGHT = 0.7
"""Share of the pixels to which the shifts lead that are darker than the surface without a shadow. Others lie in
shadows, too, so the median is too dark."""
_SHADOW, _FADE, _SOFTNESS, _MOST = 1.5, 0.5, 0.1, 2.0
"""How far a shadow reaches, how its end is softened and itself smoothed, in radii of the hole, and the largest factor
by which it is lit. Chosen on the second scene."""
_WHITE = 0.9
"""Share of the pixels that are darker than the brightest color that light makes: a red in the sun is not pure red."""
_SOFT = 1.0
"""Excess of a shift's error over the least error, as a share of the latter, that reduces its weight to 1/e."""


class _Repeats(NamedTuple):
    """How an image repeats itself around a hole.

    Args:
        pattern: The image divided by its local brightness ``[H, W, 3]``.
        variance: Its variance around the hole.
        shifts: Those of highest self-similarity, best first.
        radius: That of a disk as large as the hole, pixels.
        away: Distance from the hole in such radii ``[H, W]``.
    """

    pattern: FloatArray
    variance: float
    shifts: list[tuple[int, int]]
    radius: float
    away: FloatArray


def _repeats(image: FloatArray, hole: Mask, trust: FloatArray) -> _Repeats | None:
    """How an image repeats itself around a hole; None if it does not."""
    radius = max(float(np.sqrt(hole.sum() / np.pi)), 2.0)
    away = np.asarray(distance_transform_edt(~hole)) / radius
    brightness = mean_around(image @ LUMINANCE, trust, _BRIGHTNESS * radius)
    pattern = (image / np.maximum(brightness, 0.02)[..., None]).clip(0, 3)
    rim = trust * np.exp(-((away / _RIM) ** 2))
    mean = (rim[..., None] * pattern).sum((0, 1)) / rim.sum()
    variance = float((rim[..., None] * (pattern - mean) ** 2).sum() / rim.sum())
    shifts = self_similar_shifts(pattern, rim, trust)
    return _Repeats(pattern, variance, shifts, radius, away) if shifts and variance >= 1e-8 else None


def completed(image: FloatArray, hole: Mask, trust: FloatArray) -> FloatArray:
    """Colors ``[F, 3]`` in 0..1 for the F pixels of a hole.

    Where no shift explains the rim, they are the colors around (`painted`).

    Args:
        image: RGB ``[H, W, 3]``.
        hole: Pixels to paint ``[H, W]``, at least one.
        trust: Weight of the color of each pixel ``[H, W]``, 0 where it is unknown and in the hole.
    """
    image = image.clip(0, 1)
    smooth, repeats = painted(image, hole, trust), _repeats(image, hole, trust)
    if repeats is None:
        return smooth
    near = trust * np.exp(-((repeats.away / _NEAR) ** 2))
    asked = hole | ((trust > 0) & (repeats.away <= _NEAR))
    window = _window(asked)
    values, trusts = _candidates(image, trust, repeats, window)
    first = _first(repeats, values, trusts, near, asked)
    voted = np.zeros((*hole.shape, 3))
    voted[asked] = first[asked[window], 3:]
    certain = _predictable(repeats.pattern, voted, trust * asked, _SHARE * repeats.radius)[hole][:, None]
    share = ((certain - _CHANCE) / (_CERTAIN - _CHANCE)).clip(0, 1)
    inside = hole[window]
    known = trusts[:, inside].any(0)
    colors = _copied(repeats, values, trusts, near[window], inside, first)
    colors[~known] = smooth[~known]
    return np.asarray((share * colors + (1 - share) * smooth).clip(0, 1))


def brightening(image: FloatArray, hole: Mask, trust: FloatArray) -> FloatArray:
    """The factor ``[H, W]`` by which a hole's surroundings would be brighter without the shadow on them; at least 1.

    It compares the brightness of each pixel near the hole with that of the pixels to which the shifts lead. Further
    away, and where the image does not repeat itself, the factor is 1.

    Args:
        image: RGB ``[H, W, 3]``.
        hole: Unknown pixels ``[H, W]``, at least one.
        trust: Weight of the color of each pixel ``[H, W]``, 0 where it is unknown and in the hole.
    """
    image = image.clip(0, 1)
    repeats = _repeats(image, hole, trust)
    if repeats is None:
        return np.ones(hole.shape)
    asked = (trust > 0) & (repeats.away <= _SHADOW + _FADE)
    if not asked.any():
        return np.ones(hole.shape)
    window = _window(asked)
    values, trusts = _candidates(image, trust, repeats, window)
    found = _first(repeats, values, trusts, trust, asked, _BRIGHT)
    there = np.zeros(hole.shape)
    there[asked] = found[asked[window], :3] @ LUMINANCE
    expected, actual = (
        mean_around(each, trust * asked, _SOFTNESS * repeats.radius) for each in (there, image @ LUMINANCE)
    )
    brightest = np.quantile(image[trust > 0].max(-1), _WHITE)
    limit = (brightest / np.maximum(image.max(-1), 0.02)).clip(1, _MOST)
    factor = (expected / np.maximum(actual, 0.02)).clip(1, limit)
    near = ((_SHADOW - repeats.away) / _FADE).clip(0, 1)
    return np.asarray(1 + (factor - 1) * near)


def _window(mask: Mask) -> tuple[slice, slice]:
    """The rows and columns with pixels of a mask."""
    places = np.argwhere(mask)
    (top, left), (bottom, right) = places.min(0), places.max(0) + 1
    return slice(top, bottom), slice(left, right)


def _candidates(
    image: FloatArray, trust: FloatArray, repeats: _Repeats, window: tuple[slice, slice]
) -> tuple[FloatArray, FloatArray]:
    """Where K shifts lead from a window: RGB and pattern ``[K, h, w, 6]``, and the trust in them ``[K, h, w]``."""
    both = np.concatenate([image, repeats.pattern], -1)
    values, trusts = zip(*((_moved(both, s)[window], _moved(trust, s)[window]) for s in repeats.shifts))
    return np.stack(values), np.stack(trusts)


def _first(
    repeats: _Repeats,
    values: FloatArray,
    trusts: FloatArray,
    weights: FloatArray,
    asked: Mask,
    share: float = 0.5,
) -> FloatArray:
    """The weighted median, or another share, of the candidates of the pixels of a window ``[h, w, 6]``.

    Args:
        repeats: The pattern and its shifts.
        values: The candidates ``[K, h, w, 6]``.
        trusts: The trust in them ``[K, h, w]``.
        weights: Weight of each pixel of the image, where shifts are compared ``[H, W]``.
        asked: The pixels ``[H, W]``; others of the window get 0.
        share: See `_voted`.
    """
    window = _window(asked)
    here, errors = asked[window], []
    for shift, there in zip(repeats.shifts, trusts):
        error = (
            ((repeats.pattern - _moved(repeats.pattern, shift)) ** 2).sum(-1).clip(0, 4 * repeats.variance)
        )
        trusted = np.zeros_like(weights)
        trusted[window] = there
        local = mean_around(error, weights * trusted, _LOCAL * repeats.radius, window=window)
        errors.append(local[here])
    found = np.zeros((*here.shape, 6))
    found[here] = _voted(np.moveaxis(values[:, here], 0, 1), np.stack(errors, 1), trusts[:, here].T, share)
    return found


def _copied(
    repeats: _Repeats,
    values: FloatArray,
    trusts: FloatArray,
    near: FloatArray,
    inside: Mask,
    first: FloatArray,
) -> FloatArray:
    """Colors ``[F, 3]`` of the pixels of a hole in a window, each copied from where one shift leads.

    Args:
        repeats: The pattern and its shifts.
        values: Where the shifts lead, RGB and pattern ``[K, h, w, 6]``.
        trusts: The trust in it ``[K, h, w]``; nothing is copied from where it is 0.
        near: Weight of the known pixels ``[h, w]``.
        inside: The hole ``[h, w]``.
        first: RGB and pattern of the hole to begin with ``[h, w, 6]``.
    """
    shown = inside & (trusts > 0).any(0)
    pixels = np.arange(int(inside.sum()))
    found = first[inside]
    for width, share in _ROUNDS:
        current, errors = first[..., 3:].copy(), []
        current[inside] = found[:, 3:]
        weights = near + share * shown
        for value, there in zip(values, trusts):
            error = ((current - value[..., 3:]) ** 2).sum(-1).clip(0, 4 * repeats.variance)
            local = mean_around(error, weights * there, width * repeats.radius, 3.0)
            errors.append(np.where(there > 0, local, np.inf)[inside])
        found = values[:, inside][np.argmin(errors, 0), pixels]
    return np.asarray(found[:, :3])


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


def _voted(values: FloatArray, errors: FloatArray, trusts: FloatArray, share: float = 0.5) -> FloatArray:
    """The values ``[F, C]`` of median brightness among ``[F, K, C]``, weighted; the first three are RGB.

    Args:
        values: The pixels to which each of K shifts leads.
        errors: Their errors ``[F, K]``.
        trusts: Weights of the values ``[F, K]``; values of weight 0 are left out.
        share: Share of the weight that is darker than what is taken; .5 is the median.
    """
    least = np.where(trusts > 0, errors, np.inf).min(1)
    least = np.where(np.isfinite(least), least, 0.0)[:, None]
    weights = trusts * np.exp(-(errors - least) / (_SOFT * least + 1e-9))
    order = (values[..., :3] @ LUMINANCE).argsort(1)
    sums = np.take_along_axis(weights, order, 1).cumsum(1)
    middle = (sums >= share * sums[:, -1:]).argmax(1)
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
