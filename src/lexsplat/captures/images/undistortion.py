"""Undistortion: from any perspective COLMAP camera model to a pinhole image without invalid borders.

pycolmap implements the models: it chooses the pinhole camera (the largest one whose pixels all lie inside the photo,
COLMAP's ``blank_pixels = 0``) and projects its rays into the distorted photo. This module resamples the pixels by
bicubic interpolation, in bands for large photos. `pycolmap.undistort_image` is bilinear and blurs fine detail: it
differs by up to 79/255 on noise, and by 1/255 on a smooth image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.images import bands
from lexsplat.captures.images.bands import ArrayRows, Rows, resized

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

MAX_SIDE = 65535
"""Longest image side in pixels (the limit of JPEG); a camera with a larger one is damaged."""


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera: model and intrinsics for images of one size.

    Args:
        model: Name of the model in COLMAP, such as ``"OPENCV"``.
        width: Image width in pixels.
        height: Image height in pixels.
        params: The model's parameters in COLMAP's order; lengths in pixels, pixel centers at +0.5.

    Raises:
        ValueError: If the parameters are not those of a perspective camera of this model.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        from lexsplat.captures.sfm.pycolmap_import import pycolmap

        if not (1 <= self.width <= MAX_SIDE and 1 <= self.height <= MAX_SIDE):
            raise ValueError(f"image size {self.width}x{self.height}")
        if self.model not in pycolmap.CameraModelId.__members__ or self.model == "INVALID":
            raise ValueError(f"camera model {self.model!r}")
        if not np.isfinite(self.params).all():
            raise ValueError("an intrinsic that is not finite")
        camera = self.to_pycolmap()
        if not camera.verify_params():
            raise ValueError(f"{len(self.params)} parameters for model {self.model} ({camera.params_info})")
        if not camera.is_perspective():
            raise ValueError(f"a {self.model} camera, which has no pinhole equivalent")
        side = max(self.width, self.height)
        for focal in (camera.focal_length_x, camera.focal_length_y):
            if not 1e-2 * side <= focal <= 1e3 * side:
                raise ValueError(f"focal length {focal:g} for images of {self.width}x{self.height}")
        # The principal point of a crop may lie outside, but not by a hundred image sides.
        for center in (camera.principal_point_x, camera.principal_point_y):
            if abs(center) > 1e2 * side:
                raise ValueError(f"principal point at {center:g} for images of {self.width}x{self.height}")

    def to_pycolmap(self) -> pycolmap.Camera:
        """The same camera as a pycolmap object."""
        from lexsplat.captures.sfm.pycolmap_import import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )

    def resized(self, width: int, height: int) -> Lens:
        """The same lens for photos of another size, with the same field of view."""
        if (width, height) == (self.width, self.height):
            return self
        camera = self.to_pycolmap()
        camera.rescale(width, height)
        return Lens(self.model, width, height, tuple(float(p) for p in camera.params))

    @property
    def distorts(self) -> bool:
        """Whether photos have to be resampled; false for a pinhole and for zero distortion."""
        return not self.to_pycolmap().is_undistorted()


@lru_cache(maxsize=4096)
def pinhole_of(lens: Lens) -> tuple[int, int, NDArray[np.float64]]:
    """The pinhole camera that replaces a lens: width, height and ``K [3, 3]``.

    Without distortion, size and intrinsics are unchanged. Otherwise COLMAP's undistortion chooses the largest image
    without invalid pixels, 0.2 to 2 times the size of the photo.

    Raises:
        ValueError: If the distortion is so strong that no such image exists.
    """
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    camera = lens.to_pycolmap()
    if lens.distorts:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    K = np.asarray(camera.calibration_matrix(), dtype=np.float64)
    if not np.isfinite(K).all() or min(camera.width, camera.height) < 1 or not _covers(lens, camera):
        raise ValueError(f"distortion of {lens.model} {list(lens.params)} that cannot be undone")
    K.setflags(write=False)
    return int(camera.width), int(camera.height), K


def _covers(lens: Lens, pinhole: pycolmap.Camera) -> bool:
    """Whether a grid of points of the pinhole image falls into the photo, within 2 % of its size.

    COLMAP finds the pinhole camera by Newton steps, which can silently diverge for extreme parameters.
    """
    steps = np.linspace(0, 1, 9)
    u, v = np.meshgrid(steps * pinhole.width, steps * pinhole.height)
    rays = np.ones((81, 3))
    rays[:, :2] = pinhole.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1))
    where = np.asarray(lens.to_pycolmap().img_from_cam(rays)) / [lens.width, lens.height]
    slack = 0.02 + 2.0 / min(lens.width, lens.height)  # COLMAP rounds sizes to whole pixels
    return bool(((where >= -slack) & (where <= 1 + slack)).all())


def undistort(source: Rows, lens: Lens, size: tuple[int, int]) -> NDArray[np.float32]:
    """The pinhole image at ``size`` (width, height) of a photo taken through ``lens``.

    If the result is much smaller, the photo is area-averaged before resampling and the result once more, so that no
    pixel of the photo is skipped. Of a large photo, only the result and a band are held in memory as floats.

    Args:
        source: The photo; its size may be any uniform scale of the lens's.
        lens: The lens.
        size: Width and height of the result in pixels.

    Raises:
        ValueError: If the lens maps a pixel to NaN or infinity.
    """
    width, height, _ = pinhole_of(lens)
    shrink = max(1, int(min(width / size[0], height / size[1]) / 2))
    if shrink > 1:
        smaller = (max(1, source.width // shrink), max(1, source.height // shrink))
        source = ArrayRows(resized(source, smaller))
    enlarges = size[0] > width or size[1] > height
    between = size if enlarges else (max(1, round(width / shrink)), max(1, round(height / shrink)))
    return resized(RemappedRows(source, lens, between), size)


def undistort_nearest(values: NDArray, lens: Lens, size: tuple[int, int]) -> NDArray:
    """A mask or other map ``[h, w]`` drawn on a photo, at ``size`` (width, height) on its pinhole image.

    The nearest pixel is taken, rounded as by torch's ``grid_sample``.
    """
    grid = _sampling_grid(lens, size)
    rows, columns = (
        np.rint(((grid[..., axis] + 1) * length - 1) / 2).clip(0, length - 1).astype(np.intp)
        for axis, length in ((1, values.shape[0]), (0, values.shape[1]))
    )
    return np.asarray(values[rows, columns])


class RemappedRows:
    """The pinhole image of a source; each band of a large photo reads only the rows that it samples."""

    def __init__(self, source: Rows, lens: Lens, size: tuple[int, int]) -> None:
        self._source, self._lens = source, lens
        self.width, self.height = size

    def rows(self, first: int, last: int) -> NDArray[np.float32]:
        """Rows of the pinhole image."""
        size, height = (self.width, self.height), self._source.height
        if self._source.width * height <= bands.LARGE_PIXELS:
            return _remap(self._source.rows(0, height), _sampling_grid(self._lens, size)[first:last])
        grid = _grid_rows(self._lens, size, first, last)
        y = (grid[..., 1].astype(np.float64) + 1.0) * (height / 2)  # pixels from the top edge of the photo
        # Bicubic interpolation has a support of two pixels; beyond the photo, its border is repeated.
        top = int(np.clip(np.floor(y.min()) - 3, 0, height - 1))
        bottom = int(np.clip(np.ceil(y.max()) + 3, top + 1, height))
        grid[..., 1] = (y - top) * (2.0 / (bottom - top)) - 1.0
        return _remap(self._source.rows(top, bottom), grid)


@lru_cache(maxsize=2)
def _sampling_grid(lens: Lens, size: tuple[int, int]) -> NDArray[np.float32]:
    """Where in the photo each pinhole pixel lies: ``[h, w, 2]``, x and y from -1 to 1 edge to edge."""
    return _grid_rows(lens, size, 0, size[1])


def _grid_rows(lens: Lens, size: tuple[int, int], first: int, last: int) -> NDArray[np.float32]:
    """Rows ``first`` to ``last`` of the sampling grid."""
    width, height, K = pinhole_of(lens)
    camera = lens.to_pycolmap()
    x = ((np.arange(size[0]) + 0.5) * (width / size[0]) - K[0, 2]) / K[0, 0]
    y = ((np.arange(size[1]) + 0.5) * (height / size[1]) - K[1, 2]) / K[1, 1]
    grid = np.empty((last - first, size[0], 2), dtype=np.float32)
    scale = 2.0 / np.array([lens.width, lens.height])
    rays = np.ones((size[0], 3))
    rays[:, 0] = x
    for row in range(first, last):  # row by row: all rays in float64 would take more memory than the photo
        rays[:, 1] = y[row]
        grid[row - first] = np.asarray(camera.img_from_cam(rays)) * scale - 1.0
    if not np.isfinite(grid).all():
        raise ValueError(
            f"distortion of {lens.model} {list(lens.params)} that maps a pixel to NaN or infinity"
        )
    return grid


def _remap(image: NDArray[np.float32], grid: NDArray[np.float32]) -> NDArray[np.float32]:
    import torch

    source = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
    # Without align_corners, -1 and 1 are the outer edges, which matches pixel centers at +0.5.
    sampled = torch.nn.functional.grid_sample(
        source, torch.from_numpy(grid)[None], mode="bicubic", padding_mode="border", align_corners=False
    )
    return sampled[0].permute(1, 2, 0).clamp(0.0, 1.0).contiguous().numpy()
