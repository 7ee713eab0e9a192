"""Reads images of every mode that Pillow supports into arrays and raises typed errors for unreadable files."""

from __future__ import annotations

import io
import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures.images.bands import band_ranges
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.fingerprints import file_stamp

HEIC_SUFFIXES = (".heic", ".heif")
"""Suffixes of HEIF photos, as Apple's phones take them; reading them requires the library pi-heif."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", *HEIC_SUFFIXES)
"""Suffixes of image files, in the order in which they are tried for names without a suffix."""

MAX_PIXELS = 2 * (Image.MAX_IMAGE_PIXELS or 0)
"""Largest image that is opened: 179 million pixels. Larger headers are treated as decompression bombs."""

_HALF = 127
"""Largest alpha, of 255, of a pixel that does not count."""


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image opened by Pillow; its pixels are not decoded yet.

    The EXIF orientation is not applied: the cameras of a capture were computed on the pixels as stored (COLMAP,
    nerfstudio and instant-ngp ignore the tag), so rotating the pixels would break the poses.

    Raises:
        CaptureError: If the file is missing, truncated or not an image, exceeds `MAX_PIXELS`, or requires a library
            that is not installed.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise CaptureError(path, expected="an image", found=found, remedy="restore the file")
    if path.suffix.lower() in HEIC_SUFFIXES:
        _register_heic(path)
    try:
        with warnings.catch_warnings():
            # Pillow warns between one and two times its limit; photos of that size are accepted.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with _BoundedFile(path) as file, Image.open(file) as image:
                yield image
    except CaptureError:
        raise
    except _UNREADABLE as error:  # the block contains only decoding
        raise _unreadable(path, error) from error


_UNREADABLE = (
    Image.DecompressionBombError,
    MemoryError,
    # The other types that Pillow's decoders raise on damaged files.
    *(OSError, SyntaxError, ValueError, EOFError, LookupError, TypeError, ArithmeticError, struct.error),
)


def _unreadable(path: Path, error: BaseException) -> CaptureError:
    expected, remedy = "a complete image", "copy the file again, or remove it from the capture"
    found = f"damaged data ({error or type(error).__name__})"
    if isinstance(error, Image.UnidentifiedImageError):
        expected, remedy = "an image", "replace it with a JPEG or PNG, or remove it from the capture"
        found = f"{path.stat().st_size} bytes that are not an image format Pillow supports"
    elif isinstance(error, (Image.DecompressionBombError, MemoryError)):
        many = isinstance(error, Image.DecompressionBombError)
        expected = f"at most {MAX_PIXELS:,} pixels" if many else "an image that fits into memory"
        found, remedy = "more", "scale the image down before building"
    return CaptureError(path, expected=expected, found=found, remedy=remedy)


class _BoundedFile(io.BufferedReader):
    """A file that never allocates more than its size, even if a damaged header states a larger length."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._end = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """At most ``size`` bytes, or all bytes up to the end of the file."""
        remaining = max(0, self._end - self.tell())
        return super().read(remaining if size is None or size < 0 else min(size, remaining))


def _register_heic(path: Path) -> None:
    try:
        from pi_heif import register_heif_opener
    except ImportError as error:
        raise CaptureError(
            path,
            expected="the library pi-heif, which reads HEIC images",
            found="not installed",
            remedy='pip install "lexsplat[heic]", or save the photos as JPEG',
        ) from error
    register_heif_opener()


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header alone.

    Raises:
        CaptureError: As :func:`open_image`, or if the image has no pixels.
    """
    with open_image(path) as image:
        width, height = image.size
    if width < 1 or height < 1:
        raise CaptureError(
            path, expected="at least one pixel", found=f"{width}x{height}", remedy="replace the file"
        )
    return width, height


class PhotoRows:
    """An image as a source of rows ``[rows, W, 3]`` in 0..1, composited on ``background``.

    The decoded pixels stay in memory, three or four bytes per pixel.

    Args:
        path: The image.
        background: Color behind transparent pixels, RGB in 0..1; None takes the colors as stored, without alpha.

    Raises:
        CaptureError: As :func:`open_image`.
    """

    def __init__(self, path: Path, background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> None:
        with open_image(path) as image:
            image.load()
        self._image, self._background = image, background
        self.width, self.height = image.size

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """Rows ``[last - first, W, 3]``, in 0..1."""
        return _as_floats(self._image.crop((0, first, self.width, last)), self._background)

    def opaque(self) -> NDArray[np.bool_]:
        """Pixels ``[H, W]`` that are more opaque than half."""
        alpha = _alpha_of(self._image)
        return np.ones((self.height, self.width), bool) if alpha is None else np.asarray(alpha) > _HALF


def read_bytes(path: Path) -> NDArray[np.uint8]:
    """An image as ``[H, W, 3]`` uint8, rounded; transparent pixels have the colors that are stored with them.

    Raises:
        CaptureError: As :func:`open_image`.
    """
    source = PhotoRows(path, None)
    found = np.empty((source.height, source.width, 3), np.uint8)
    for first, last in band_ranges(source.height, source.width):
        found[first:last] = (source.rows(first, last) * 255.0).round()
    return found


@dataclass(frozen=True)
class Transparency:
    """How transparent the pixels of an image are.

    Args:
        least: Alpha of its most transparent pixel, 0..255; 255 if the image is opaque.
        most: Alpha of its most opaque pixel, 0..255.
    """

    least: int = 255
    most: int = 255

    @property
    def is_any(self) -> bool:
        """Whether a pixel is at all transparent."""
        return self.least < 255

    @property
    def hides(self) -> bool:
        """Whether a pixel is more transparent than half."""
        return self.least <= _HALF

    @property
    def hides_all(self) -> bool:
        """Whether no pixel is more opaque than half."""
        return self.most <= _HALF


def transparency_of(path: Path) -> Transparency:
    """The transparency of an image. One without alpha is not decoded, and others are once per process.

    Raises:
        CaptureError: As :func:`open_image`.
    """
    with open_image(path) as image:
        if not _has_alpha(image):
            return Transparency()
    return _decoded_transparency(path, file_stamp(path))


@lru_cache(maxsize=1 << 14)
def _decoded_transparency(path: Path, stamp: tuple[int, int]) -> Transparency:
    """The transparency of the file with this stamp."""
    with open_image(path) as image:
        alpha = _alpha_of(image)
        if alpha is None:
            return Transparency()
        values = np.asarray(alpha)
        return Transparency(int(values.min()), int(values.max()))


def _has_alpha(image: Image.Image) -> bool:
    """Whether an image has an alpha channel or transparent colors; those of 16-bit gray are not read."""
    return image.has_transparency_data and not image.mode.startswith(("I", "F"))


def _alpha_of(image: Image.Image) -> Image.Image | None:
    """The alpha channel of an image, in 0..255; None if it has none."""
    if not _has_alpha(image):
        return None
    return image.getchannel("A") if image.mode in ("RGBA", "LA") else image.convert("RGBA").getchannel("A")


def _as_floats(image: Image.Image, background: tuple[float, float, float] | None) -> NDArray[np.float32]:
    """All pixels of an image of any mode as floats in 0..1."""
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, dtype=np.float32)
        # Pillow decodes 16-bit gray as I or I;16; float images are in 0..1 by convention.
        gray = values if image.mode == "F" else values / 65535.0
        gray = np.clip(np.nan_to_num(gray, nan=0.0), 0.0, 1.0)
        return np.repeat(gray[..., None], 3, axis=2)
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255.0
        if background is None:
            return np.ascontiguousarray(rgba[..., :3])
        alpha = rgba[..., 3:]
        return rgba[..., :3] * alpha + np.asarray(background, dtype=np.float32) * (1.0 - alpha)
    pixels = np.asarray(image.convert("RGB"), dtype=np.float32)
    if not pixels.flags.writeable:
        pixels = pixels.copy()
    pixels /= np.float32(255.0)  # in place, to save memory
    return pixels


def read_mask(path: Path, *, nonzero: bool = False) -> NDArray[np.bool_]:
    """A mask as ``[H, W]`` bool: true where the image is brighter than half of its range.

    In an image with values 0 and 1 only, 1 is true. Transparent pixels are false.

    Args:
        path: The image.
        nonzero: COLMAP's convention: every pixel that is not black is true.

    Raises:
        CaptureError: As :func:`open_image`, or if the mask is dark but not black, as images of labels are.
    """
    with open_image(path) as image:
        image.load()
        values = np.asarray(image if image.mode.startswith(("I", "F", "1")) else image.convert("L"))
        if image.has_transparency_data:
            alpha = np.asarray(image.convert("RGBA"))[..., 3]
            values = np.where(alpha > _HALF, values, 0)
    if values.dtype == np.bool_:
        return values
    if nonzero:
        return values > 0
    highest = float(values.max(initial=0))
    if highest <= 1:
        return values > 0.5
    half = 127 if highest <= 255 else 32767
    # Values slightly above black are JPEG noise; larger ones indicate colors, such as palette labels.
    if half / 4 < highest <= half:
        raise CaptureError(
            path,
            expected="a black-and-white mask",
            found=f"values up to {highest:g}: neither black nor brighter than half",
            remedy="save it as black and white",
        )
    return values > half


def resize_nearest(mask: NDArray, size: tuple[int, int]) -> NDArray:
    """Resample a mask or other map ``[H, W]`` to ``(width, height)`` by nearest neighbor."""
    rows = ((np.arange(size[1]) + 0.5) * mask.shape[0] / size[1]).astype(np.int64)
    columns = ((np.arange(size[0]) + 0.5) * mask.shape[1] / size[0]).astype(np.int64)
    return mask[rows[:, None], columns[None, :]]


def sizes_agree(found: tuple[int, int], expected: tuple[int, int]) -> bool:
    """Whether the sizes differ by a uniform scale, up to rounding of each side by less than one pixel."""
    low, high = 0.0, np.inf
    for a, b in zip(found, expected):
        low, high = max(low, (a - 1) / b), min(high, (a + 1) / b)
    return bool(low < high)


def misfit(mask: Path, found: tuple[int, int], photo: str, size: tuple[int, int]) -> CaptureError:
    """The error for a mask whose aspect ratio differs from that of its photo."""
    return CaptureError(
        mask,
        expected=f"a mask of {photo}, {size[0]}x{size[1]} pixels or scaled uniformly",
        found=f"{found[0]}x{found[1]}",
        remedy="draw the mask on this photo, or remove it",
    )
