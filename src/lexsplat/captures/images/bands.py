"""Processes large images in bands of rows: as floats they take 12 bytes per pixel, several times over.

A source has a width, a height, and rows on demand. Operations on it (filling masked pixels, undistortion) are sources
again; `reduced` and `whole` turn a source into an image. Whether an image is large depends on its size alone, so
results do not depend on the available memory.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation

LARGE_PIXELS = 2_000_000
"""Images with more pixels are processed in bands."""

BAND_PIXELS = 1 << 19
"""Pixels per band, of the source or the result, whichever is more."""


def is_large(width: int, height: int) -> bool:
    """Whether an image of this size is processed in bands."""
    return width * height > LARGE_PIXELS


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
        total, count = np.zeros(3), 0
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
            side = 2 * self._reach + 1
            part = binary_dilation(part, np.ones((side, side), bool))
        return part[first - top : last - top, :, None].astype(np.float32)


def band_ranges(height: int, width: int, step: float = 1.0) -> list[tuple[int, int]]:
    """First and last row of every band, if each row is computed from ``step`` rows of ``width`` pixels."""
    count = max(1, int(BAND_PIXELS / (max(1, width) * max(1.0, step))))
    return [(first, min(first + count, height)) for first in range(0, height, count)]


def whole(source: Rows) -> NDArray[np.float32]:
    """All rows ``[H, W, C]``."""
    found = np.empty((source.height, source.width, source.rows(0, 1).shape[2]), np.float32)
    for first, last in band_ranges(source.height, source.width):
        found[first:last] = source.rows(first, last)
    return found


def reduced(source: Rows, size: tuple[int, int]) -> NDArray[np.float32]:
    """A source at a smaller ``(width, height)``: each pixel is the mean over the area it covers."""
    if size == (source.width, source.height):
        return whole(source)
    step = source.height / size[1]
    found = np.empty((size[1], size[0], source.rows(0, 1).shape[2]), dtype=np.float32)
    for top, bottom in band_ranges(size[1], source.width, step):
        first, last = int(top * step), min(source.height, math.ceil(bottom * step))
        band = source.rows(first, last)
        box = (0.0, top * step - first, float(source.width), min(bottom * step - first, float(last - first)))
        for channel in range(band.shape[2]):
            plane = Image.fromarray(np.ascontiguousarray(band[..., channel]))
            smaller = plane.resize((size[0], bottom - top), Image.Resampling.BOX, box=box)
            found[top:bottom, :, channel] = np.asarray(smaller)
    return found
