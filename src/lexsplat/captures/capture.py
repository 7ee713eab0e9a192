"""`Capture` and `View`, the input of every stage: views with pinhole cameras, keyed by image name, and points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from lexsplat.captures.images.bands import FilledRows, MaskRows, Rows, is_large, reduced, whole
from lexsplat.captures.images.reading import (
    image_size,
    read_image,
    read_mask,
    read_rows,
    resize_image,
    resize_nearest,
    sizes_agree,
)
from lexsplat.captures.images.undistortion import Lens, RemappedRows, undistort, undistort_large
from lexsplat.geometry.cameras import Camera, camera_extent
from lexsplat.runtime.errors import CaptureError


def stem_of(name: str) -> str:
    """An image name without its suffix, with its folders: ``"left/0001.jpg"`` gives ``"left/0001"``."""
    folder, slash, file = name.rpartition("/")
    head, dot, _ = file.rpartition(".")
    return f"{folder}{slash}{head if dot and head else file}"


@dataclass(frozen=True)
class View:
    """One photo and its pinhole camera after undistortion.

    Args:
        name: Path of the image relative to the image folder, with "/": the key of the view everywhere.
        image_path: The photo on disk, still distorted.
        camera: Pinhole camera at the working resolution.
        capture_size: Width and height of the undistorted photo at full resolution, in pixels.
        lens: The lens of the photo, at the photo's size on disk.
        background: Color behind transparent pixels, RGB in 0..1.
        ignore_path: Mask of the photo (from ``masks/``), black where pixels are ignored; None if no pixel is.
    """

    name: str
    image_path: Path
    camera: Camera
    capture_size: tuple[int, int]
    lens: Lens
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ignore_path: Path | None = None

    @property
    def stem(self) -> str:
        """The name without its suffix, with its folders."""
        return stem_of(self.name)

    def load_image(self, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """The undistorted photo ``[H, W, 3]`` in 0..1, read from disk at every call.

        Masked pixels are replaced by the mean color of the others, so resizing, SSIM windows and encoder crops never
        see masked content.

        Args:
            size: Width and height of the result; None is the camera's.

        Raises:
            CaptureError: If the file is missing or damaged, or its size has changed.
            ValueError: If ``size`` is not positive.
        """
        size = self._checked_size(size)
        found = image_size(self.image_path)
        if found != (self.lens.width, self.lens.height):
            raise CaptureError(
                self.image_path,
                expected=f"{self.lens.width}x{self.lens.height} pixels",
                found=f"{found[0]}x{found[1]}",
                remedy="the file changed since the capture was loaded; load it again",
            )
        if self.ignore_path is None and not self.lens.distorts:
            return read_image(self.image_path, self.background, size=size)
        if is_large(*found):
            return self._load_large(size)
        image = read_image(self.image_path, self.background)
        mask = None if self.ignore_path is None else read_mask(self.ignore_path, nonzero=True)
        if mask is not None and self._is_undistorted(mask):
            image = undistort(image, self.lens, self.capture_size)
            return resize_image(filled(image, mask), size)
        if mask is not None:
            self._check_aspect(self.ignore_path or self.image_path, (mask.shape[1], mask.shape[0]))
            image = filled(image, resize_nearest(mask, found))
        if self.lens.distorts:
            return undistort(image, self.lens, size)
        return resize_image(image, size)

    def _load_large(self, size: tuple[int, int]) -> NDArray[np.float32]:
        """Load a large masked or distorted photo in bands."""
        source: Rows = read_rows(self.image_path, self.background)
        mask = None if self.ignore_path is None else read_mask(self.ignore_path, nonzero=True)
        if mask is not None and self._is_undistorted(mask):
            source = FilledRows(RemappedRows(source, self.lens, self.capture_size), mask)
        else:
            if mask is not None:
                self._check_aspect(self.ignore_path or self.image_path, (mask.shape[1], mask.shape[0]))
                source = FilledRows(source, resize_nearest(mask, (source.width, source.height)))
            if self.lens.distorts:
                return undistort_large(source, self.lens, size)
        if size[0] <= source.width and size[1] <= source.height:
            return reduced(source, size)
        return resize_image(whole(source), size)

    def load_mask(self, path: Path, size: tuple[int, int] | None = None) -> NDArray[np.bool_]:
        """A mask drawn on the photo as ``[H, W]`` bool on the undistorted image, by nearest pixel.

        Args:
            path: The mask: an image of the photo's aspect, drawn on the photo on disk, or on the undistorted photo if
                it has exactly that size.
            size: Width and height of the result; None keeps the mask's own resolution.

        Raises:
            CaptureError: If the mask cannot be read or its aspect is not the photo's.
        """
        return self.undistort_mask(read_mask(path), path, size)

    def undistort_mask(
        self, mask: NDArray[np.bool_], subject: Path, size: tuple[int, int] | None = None
    ) -> NDArray[np.bool_]:
        """A mask ``[h, w]`` drawn on the photo, undistorted as by `load_mask`.

        Args:
            mask: The mask.
            subject: The file named in messages.
            size: Width and height of the result; None keeps the mask's own resolution.

        Raises:
            CaptureError: If the aspect of the mask is not the photo's.
        """
        height, width = mask.shape
        self._check_aspect(subject, (width, height))
        if self._is_undistorted(mask) or not self.lens.distorts:
            return mask if size is None else resize_nearest(mask, self._checked_size(size))
        if size is None:
            full = self.capture_size
            size = (
                max(1, round(full[0] * width / self.lens.width)),
                max(1, round(full[1] * height / self.lens.height)),
            )
        pixels = mask[..., None].astype(np.float32)
        return undistort(pixels, self.lens, self._checked_size(size), nearest=True)[..., 0] > 0.5

    def load_valid(self, size: tuple[int, int] | None = None) -> NDArray[np.bool_] | None:
        """Pixels that losses use, ``[H, W]`` bool at the camera's size, or None for all.

        A pixel is used if no masked pixel of the photo contributes to it.

        Raises:
            CaptureError: As :meth:`load_mask`.
        """
        share = self.valid_share(size)
        return None if share is None else share > 1 - 1e-4

    def valid_share(self, size: tuple[int, int] | None = None) -> NDArray[np.float32] | None:
        """Share of each pixel ``[H, W]`` in 0..1 that is not masked in the photo, or None without a mask.

        Undistortion widens the mask by the support of its interpolation.

        Raises:
            CaptureError: As :meth:`load_mask`.
        """
        if self.ignore_path is None:
            return None
        size = self._checked_size(size)
        mask = read_mask(self.ignore_path, nonzero=True)
        self._check_aspect(self.ignore_path, (mask.shape[1], mask.shape[0]))
        undistorted = self._is_undistorted(mask)
        masked = ~resize_nearest(
            mask, self.capture_size if undistorted else (self.lens.width, self.lens.height)
        )
        large = is_large(masked.shape[1], masked.shape[0])
        shrinks = size[0] <= masked.shape[1] and size[1] <= masked.shape[0]
        if large and (undistorted or not self.lens.distorts) and shrinks:
            return 1.0 - reduced(MaskRows(masked), size)[..., 0]
        if large and not undistorted and self.lens.distorts:
            return 1.0 - undistort_large(MaskRows(masked, reach=2), self.lens, size)[..., 0]
        if undistorted or not self.lens.distorts:
            return 1.0 - resize_image(masked[..., None].astype(np.float32), size)[..., 0]
        # Bicubic interpolation has a support of two pixels.
        reach = binary_dilation(masked, np.ones((5, 5), bool))[..., None].astype(np.float32)
        return 1.0 - undistort(reach, self.lens, size)[..., 0]

    def check_mask(self, path: Path) -> None:
        """Compare a mask's size with the photo's by their headers.

        Raises:
            CaptureError: If the mask cannot be read or its aspect is not the photo's.
        """
        self._check_aspect(path, image_size(path))

    def _is_undistorted(self, mask: NDArray[np.bool_]) -> bool:
        """Whether a mask was drawn on the undistorted photo: it has exactly that size, and not the photo's."""
        found = (mask.shape[1], mask.shape[0])
        return found == self.capture_size != (self.lens.width, self.lens.height)

    def _check_aspect(self, path: Path, found: tuple[int, int]) -> None:
        expected = (self.lens.width, self.lens.height)
        if not (sizes_agree(found, expected) or sizes_agree(found, self.capture_size)):
            raise CaptureError(
                path,
                expected=f"a mask of {self.name}, {expected[0]}x{expected[1]} pixels or scaled uniformly",
                found=f"{found[0]}x{found[1]}",
                remedy="draw the mask on this photo, or remove it",
            )

    def _checked_size(self, size: tuple[int, int] | None) -> tuple[int, int]:
        width, height = (self.camera.width, self.camera.height) if size is None else size
        if width < 1 or height < 1:
            raise ValueError(f"size must be positive, got {width}x{height}")
        return int(width), int(height)


def filled(image: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """An image ``[H, W, C]`` whose invalid pixels are replaced by the mean of the valid ones ``[H, W]``."""
    if valid.all():
        return image
    kept = image[valid]
    mean = kept.mean(0, dtype=np.float64) if len(kept) else np.zeros(image.shape[2])
    return np.where(valid[..., None], image, mean.astype(np.float32))


def _no_points() -> NDArray[np.float32]:
    return np.zeros((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class Capture:
    """A capture: its views, their split, points and ground-truth masks.

    Args:
        root: The capture folder.
        views: All views by name, sorted by name.
        train_names: Names of the training views, sorted.
        test_names: Names of the held-out views, sorted.
        points: Points of structure from motion ``[P, 3]``, world; P may be 0.
        point_colors: Their colors ``[P, 3]``, RGB in 0..1.
        segmentations: Folder with ``STEM/PROMPT.png``, or None.
        warnings: What was skipped and why, one line each.
        source: Format of the camera files: ``"colmap"`` or ``"transforms"``.
        background: Color behind transparent pixels, RGB in 0..1.
    """

    root: Path
    views: Mapping[str, View]
    train_names: tuple[str, ...]
    test_names: tuple[str, ...] = ()
    points: NDArray[np.float32] = field(default_factory=_no_points)
    point_colors: NDArray[np.float32] = field(default_factory=_no_points)
    segmentations: Path | None = None
    warnings: tuple[str, ...] = ()
    source: str = "colmap"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training views, in order of their names."""
        return tuple(self.views[name] for name in self.train_names)

    @property
    def test_views(self) -> tuple[View, ...]:
        """The held-out views, in order of their names."""
        return tuple(self.views[name] for name in self.test_names)

    def downscaled(self, factor: float) -> Capture:
        """The same capture at ``1 / factor`` of the size of the undistorted photos."""
        views = {
            name: replace(view, camera=view.camera.resized(*view.capture_size).downscaled(factor))
            for name, view in self.views.items()
        }
        return replace(self, views=views)

    @property
    def extent(self) -> float:
        """Scene scale of 3DGS: 1.1 times the radius of the training cameras' positions, in world units."""
        return camera_extent(view.camera for view in self.train_views)
