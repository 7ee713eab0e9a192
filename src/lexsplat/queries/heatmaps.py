"""Relevancy in color: a perceptually uniform scale, and overlays on images.

The scale is a path through the Oklab space whose lightness rises in equal steps from near black over violet and
orange to pale yellow, as saturated as sRGB allows. Equal differences in relevancy look about equally large, and the
order survives grayscale printing and color blindness.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lexsplat.queries.colors import LUMINANCE

_LIGHTNESS = (0.16, 0.96)
_HUES = (285.0, 465.0)
_SATURATION = 0.92

_OKLAB_TO_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_LMS_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)
"""Oklab to linear sRGB, constants of its definition (Ottosson 2020)."""


@lru_cache(maxsize=1)
def color_scale() -> NDArray[np.uint8]:
    """The scale ``[256, 3]`` as sRGB bytes, from the lowest to the highest value."""
    steps = np.linspace(0, 1, 256)
    lightness = _LIGHTNESS[0] + (_LIGHTNESS[1] - _LIGHTNESS[0]) * steps
    hue = np.radians(_HUES[0] + (_HUES[1] - _HUES[0]) * steps)
    direction = np.stack([np.cos(hue), np.sin(hue)], axis=1)
    # The largest chroma inside the sRGB gamut, by bisection, then smoothed to remove kinks.
    low, high = np.zeros(256), np.full(256, 0.4)
    for _ in range(30):
        middle = (low + high) / 2
        linear = _linear_rgb(lightness, direction * middle[:, None])
        inside = ((linear >= 0) & (linear <= 1)).all(axis=1)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    kernel = np.hanning(51) / np.hanning(51).sum()
    smooth = np.convolve(np.pad(low, 25, mode="edge"), kernel, mode="valid")
    chroma = np.minimum(low, smooth * _SATURATION)
    linear = np.clip(_linear_rgb(lightness, direction * chroma[:, None]), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255).round().astype(np.uint8)


def colorize(values: ArrayLike, low: float = 0.0, high: float = 1.0) -> NDArray[np.uint8]:
    """Numbers ``[...]`` as colors ``[..., 3]``; ``low`` and below is darkest, ``high`` and above brightest.

    Raises:
        ValueError: If ``low`` is not below ``high``.
    """
    return color_scale()[(_unit(values, low, high) * 255).round().astype(np.uint8)]


def overlay_heatmap(image: ArrayLike, relevancy: ArrayLike) -> NDArray[np.uint8]:
    """An image faded to gray, with relevancy drawn over it in color.

    The peak of the map has the full color, but at least `PEAK_FLOOR`: a map without relevant pixels stays dark.

    Args:
        image: ``[H, W, 3]``, bytes or floats in 0..1.
        relevancy: ``[H, W]`` in 0..1.

    Returns:
        ``[H, W, 3]`` bytes.

    Raises:
        ValueError: If the sizes disagree.
    """
    pixels, values = np.asarray(image), np.asarray(relevancy, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.shape[:2] != values.shape:
        raise ValueError(f"image {list(pixels.shape)} and relevancy {list(values.shape)} differ in size")
    scale = 1 / 255 if pixels.dtype == np.uint8 else 1.0
    colors = np.clip(pixels.astype(np.float32) * scale, 0, 1)
    amount = _unit(values, 0.0, max(float(values.max()), PEAK_FLOOR))
    gray = colors @ LUMINANCE.astype(np.float32)
    backdrop = 0.55 * (0.65 * gray[..., None] + 0.35 * colors) + 0.06
    weight = (0.85 * amount**0.8)[..., None]
    blended = (1 - weight) * backdrop + weight * (colorize(amount).astype(np.float32) / 255)
    return (np.clip(blended, 0, 1) * 255).round().astype(np.uint8)


PEAK_FLOOR = 0.1
"""Smallest range of relevancy that an overlay maps to its colors."""


def overlay_mask(
    image: ArrayLike, mask: ArrayLike, color: tuple[int, int, int] = (255, 176, 32)
) -> NDArray[np.uint8]:
    """An image with a mask tinted and outlined, and the rest dimmed: ``[H, W, 3]`` bytes."""
    pixels, inside = np.asarray(image), np.asarray(mask, dtype=bool)
    if pixels.shape[:2] != inside.shape:
        raise ValueError(f"image {list(pixels.shape)} and mask {list(inside.shape)} differ in size")
    colors = pixels.astype(np.float32) * (1.0 if pixels.dtype == np.uint8 else 255.0)
    tint = np.array(color, dtype=np.float32)
    result = np.where(inside[..., None], 0.55 * colors + 0.45 * tint, 0.45 * colors)
    padded = np.pad(inside, 1, mode="edge")
    eroded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    result[inside & ~eroded] = tint
    return np.clip(result, 0, 255).round().astype(np.uint8)


def _unit(values: ArrayLike, low: float, high: float) -> NDArray[np.float32]:
    if not low < high:
        raise ValueError(f"low must be below high, got {low}, {high}")
    numbers = np.nan_to_num(np.asarray(values, dtype=np.float32), nan=low)
    return np.clip((numbers - low) / (high - low), 0, 1)


def _linear_rgb(lightness: NDArray, ab: NDArray) -> NDArray:
    lab = np.concatenate([lightness[:, None], ab], axis=1)
    return (lab @ _OKLAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T
