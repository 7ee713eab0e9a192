"""Processes large images in bands of rows: as floats they take 12 bytes per pixel, several times over.

A source has a width, a height, and rows on demand. Operations on it (filling masked pixels, undistortion) are sources
again; `resized` and `whole` turn a source into an image. A small image is one band. Whether an image is large depends
on its size alone, so results do not depend on the available memory.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LARGE_PIXELS = 2_000_000
"""Images with more pixels are processed in bands."""

BAND_PIXELS = 1 << 19
"""Pixels per band of a large image, of the source or the result, whichever is more."""


class Rows(Protocol):
    """An image whose rows are computed on demand."""

    width: int
    height: int

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """Rows ``first`` to ``last`` (exclusive), ``[last - first, width, C]``."""


class ArrayRows:
    """An image ``[H, W, C]`` in memory."""

    def __init__(self, image: NDArray[np.float32]) -> None:
        self._image = image
        self.height, self.width = image.shape[:2]

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """A view of the rows."""
        return self._image[first:last]


class FilledRows:
    """A source whose invalid pixels are replaced by the mean of the valid ones ``[H, W]``."""

    def __init__(self, source: Rows, valid: NDArray[np.bool_]) -> None:
        self._source, self._valid = source, valid
        self.width, self.height = source.width, source.height
        total, count = np.zeros(1), 0
        for first, last in band_ranges(self.height, self.width):
            kept = source.rows(first, last)[valid[first:last]]
            total, count = total + kept.sum(0, dtype=np.float64), count + len(kept)
        self._mean = (total / max(count, 1)).astype(np.float32)

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """The rows, filled."""
        return np.where(self._valid[first:last, :, None], self._source.rows(first, last), self._mean)


class MaskRows:
    """A mask ``[H, W]``, dilated by ``reach`` pixels, as an image of one channel in 0..1."""

    def __init__(self, mask: NDArray[np.bool_], reach: int = 0) -> None:
        self._mask, self._reach = mask, reach
        self.height, self.width = mask.shape

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """The rows, dilated."""
        top = max(0, first - self._reach)
        part = self._mask[top : last + self._reach]
        if self._reach:
            from scipy.ndimage import binary_dilation

            side = 2 * self._reach + 1
            part = binary_dilation(part, np.ones((side, side), bool))
        return part[first - top : last - top, :, None].astype(np.float32)


def band_ranges(height: int, width: int, step: float = 1.0) -> list[tuple[int, int]]:
    """First and last row of every band, if each row is computed from ``step`` rows of ``width`` pixels."""
    pixels = max(1, width) * max(1.0, step)
    count = max(1, int(BAND_PIXELS / pixels)) if height * pixels > LARGE_PIXELS else max(1, height)
    return [(first, min(first + count, height)) for first in range(0, height, count)]


def whole(source: Rows) -> NDArray[np.float32]:
    """All rows ``[H, W, C]``."""
    return resized(source, (source.width, source.height))


def resized(source: Rows, size: tuple[int, int]) -> NDArray[np.float32]:
    """A source at another ``(width, height)``, ``[H, W, C]``.

    Shrinking takes the mean over the area of each new pixel; enlarging is bilinear.
    """
    shrinks = size[0] <= source.width and size[1] <= source.height
    if not shrinks:
        return _scaled(whole(source), size, Image.Resampling.BILINEAR)
    step = source.height / size[1]
    bands = band_ranges(size[1], source.width, step)
    found = np.empty(0, np.float32)
    for top, bottom in bands:
        first, last = int(top * step), min(source.height, math.ceil(bottom * step))
        part = source.rows(first, last)
        box = (0.0, top * step - first, float(source.width), min(bottom * step - first, float(last - first)))
        part = _scaled(part, (size[0], bottom - top), Image.Resampling.BOX, box)
        if len(bands) == 1:
            return part
        if not len(found):
            found = np.empty((size[1], size[0], part.shape[2]), np.float32)
        found[top:bottom] = part
    return found


def _scaled(
    image: NDArray[np.float32],
    size: tuple[int, int],
    resample: Image.Resampling,
    box: tuple[float, float, float, float] | None = None,
) -> NDArray[np.float32]:
    if (image.shape[1], image.shape[0]) == size:
        return image
    planes = (Image.fromarray(np.ascontiguousarray(plane)) for plane in np.moveaxis(image, 2, 0))
    return np.stack([np.asarray(plane.resize(size, resample, box=box)) for plane in planes], axis=-1)
