"""`Capture` and `View`, the input of every stage: views with pinhole cameras, keyed by image name, and points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.images.bands import FilledRows, MaskRows, Rows, resized
from lexsplat.captures.images.reading import (
    PhotoRows,
    image_size,
    misfit,
    read_mask,
    resize_nearest,
    sizes_agree,
)
from lexsplat.captures.images.undistortion import Lens, RemappedRows, undistort, undistort_nearest
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
        ignore_path: Mask of the photo (from ``masks/``), black where pixels are ignored; None if there is none.
        ignores_transparent: Whether transparent pixels of the photo are ignored, too, rather than being
            ``background``.
    """

    name: str
    image_path: Path
    camera: Camera
    capture_size: tuple[int, int]
    lens: Lens
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ignore_path: Path | None = None
    ignores_transparent: bool = False

    @property
    def is_masked(self) -> bool:
        """Whether pixels of the photo may be ignored, by a mask or because they are transparent."""
        return self.ignore_path is not None or self.ignores_transparent

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
        photo = PhotoRows(self.image_path, None if self.ignores_transparent else self.background)
        source: Rows = photo
        found, remapped = (photo.width, photo.height), False
        if found != (self.lens.width, self.lens.height):
            raise CaptureError(
                self.image_path,
                expected=f"{self.lens.width}x{self.lens.height} pixels",
                found=f"{found[0]}x{found[1]}",
                remedy="the file changed since the capture was loaded; load it again",
            )
        if self.is_masked:
            mask, remapped = self._valid_pixels(photo)
            if remapped:
                source = RemappedRows(source, self.lens, self.capture_size)
            source = FilledRows(source, mask)
        if self.lens.distorts and not remapped:
            return undistort(source, self.lens, size)
        return resized(source, size)

    def _valid_pixels(self, photo: PhotoRows | None = None) -> tuple[NDArray[np.bool_], bool]:
        """Valid pixels of a masked photo, and whether they are those of the undistorted photo, as its mask may be."""
        opaque = (photo or PhotoRows(self.image_path)).opaque() if self.ignores_transparent else None
        if self.ignore_path is None:
            return np.ones((self.lens.height, self.lens.width), bool) if opaque is None else opaque, False
        mask = read_mask(self.ignore_path, nonzero=True)
        self._check_aspect(self.ignore_path, (mask.shape[1], mask.shape[0]))
        undistorted = self._is_undistorted(mask)
        mask = resize_nearest(mask, self.capture_size if undistorted else (self.lens.width, self.lens.height))
        if opaque is None:
            return mask, undistorted
        if undistorted:
            opaque = self._widened(~opaque, self.capture_size) < 1e-4
        return mask & opaque, undistorted

    def _widened(self, ignored: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.float32]:
        """Share of each undistorted pixel ``[H, W]`` that ignored pixels of the photo contribute to."""
        # Bicubic interpolation has a support of two pixels.
        return undistort(MaskRows(ignored, reach=2), self.lens, size)[..., 0]

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

    def undistort_mask(self, mask: NDArray, subject: Path, size: tuple[int, int] | None = None) -> NDArray:
        """A mask, or a map of numbers, ``[h, w]`` as `load_mask` undistorts one; errors name the file ``subject``."""
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
        return undistort_nearest(mask, self.lens, self._checked_size(size))

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
        if not self.is_masked:
            return None
        size = self._checked_size(size)
        mask, undistorted = self._valid_pixels()
        if undistorted or not self.lens.distorts:
            return 1.0 - resized(MaskRows(~mask), size)[..., 0]
        return 1.0 - self._widened(~mask, size)

    def check_mask(self, path: Path) -> None:
        """Compare a mask's size with the photo's by their headers.

        Raises:
            CaptureError: If the mask cannot be read or its aspect is not the photo's.
        """
        self._check_aspect(path, image_size(path))

    def _is_undistorted(self, mask: NDArray) -> bool:
        """Whether a mask was drawn on the undistorted photo: it has exactly that size, and not the photo's."""
        found = (mask.shape[1], mask.shape[0])
        return found == self.capture_size != (self.lens.width, self.lens.height)

    def _check_aspect(self, path: Path, found: tuple[int, int]) -> None:
        expected = (self.lens.width, self.lens.height)
        if not (sizes_agree(found, expected) or sizes_agree(found, self.capture_size)):
            raise misfit(path, found, self.name, expected)

    def _checked_size(self, size: tuple[int, int] | None) -> tuple[int, int]:
        width, height = (self.camera.width, self.camera.height) if size is None else size
        if width < 1 or height < 1:
            raise ValueError(f"size must be positive, got {width}x{height}")
        return int(width), int(height)


def _no_points() -> NDArray[np.float32]:
    return np.zeros((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class Capture:
    """A capture: its views, their split, and points.

    Args:
        root: The capture folder.
        views: All views by name, sorted by name.
        train_names: Names of the training views, sorted.
        test_names: Names of the held-out views, sorted.
        points: Points of structure from motion ``[P, 3]``, world; P may be 0.
        point_colors: Their colors ``[P, 3]``, RGB in 0..1.
        warnings: Skipped content and the reasons, one line each.
        background: Color behind transparent pixels, RGB in 0..1.
    """

    root: Path
    views: Mapping[str, View]
    train_names: tuple[str, ...]
    test_names: tuple[str, ...] = ()
    points: NDArray[np.float32] = field(default_factory=_no_points)
    point_colors: NDArray[np.float32] = field(default_factory=_no_points)
    warnings: tuple[str, ...] = ()
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
