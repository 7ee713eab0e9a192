"""Pinhole cameras and conversion between camera conventions.

All other modules use one convention: OpenCV axes (x right, y down, z forward), ``viewmat`` maps world to camera,
``K`` is in pixels, and the center of the top-left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.rotations import is_rotation, looking_along

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Flips the y and z axes of the camera: OpenGL looks along -z with y up, OpenCV along +z with y down."""

_ROUNDING = 1e-3
"""Largest error of an entry that is constant in every camera, since other programs write few digits."""
_LAST = np.eye(4)[3]


@dataclass(frozen=True, repr=False)
class Camera:
    """A pinhole camera without distortion.

    Args:
        width: Image width in pixels, a whole number of any type.
        height: Image height in pixels, likewise.
        K: Intrinsics ``[3, 3]`` in pixels, float64: focal lengths and the principal point, without skew.
        viewmat: World to camera ``[4, 4]``, OpenCV axes, float64: a rotation and a translation.

    Raises:
        ValueError: If a shape is wrong, a value is NaN or infinite, a size or focal length is not positive, or a
            matrix is of another form; errors of 0.001, as from rounding, are accepted.
    """

    width: int
    height: int
    K: NDArray[np.float64]
    viewmat: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, _whole(name, getattr(self, name)))
        object.__setattr__(self, "K", np.asarray(self.K, dtype=np.float64))
        object.__setattr__(self, "viewmat", np.asarray(self.viewmat, dtype=np.float64))
        if self.K.shape != (3, 3):
            raise ValueError(f"K must be [3, 3], got {list(self.K.shape)}")
        if self.viewmat.shape != (4, 4):
            raise ValueError(f"viewmat must be [4, 4], got {list(self.viewmat.shape)}")
        if not (np.isfinite(self.K).all() and np.isfinite(self.viewmat).all()):
            raise ValueError("camera contains NaN or infinity")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be positive, got {self.width}x{self.height}")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError(f"focal lengths must be positive, got {self.K[0, 0]:g}, {self.K[1, 1]:g}")
        self._check_form()

    def _check_form(self) -> None:
        """Refuse matrices that are not those of a pinhole camera, of which rendering would ignore a part."""
        (fx, skew, _), (tilt, fy, _), last = self.K.tolist()
        if max(abs(skew) / fx, abs(tilt) / fy, *(abs(a - b) for a, b in zip(last, (0, 0, 1)))) > _ROUNDING:
            form, remedy = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", "divide by K[2, 2] and leave out skew"
            raise ValueError(f"K must be {form}, got {self.K.tolist()}; {remedy}")
        turn, row = self.viewmat[:3, :3], self.viewmat[3]
        if not is_rotation(turn, 5 * _ROUNDING):  # entries that are off by 0.001 are so together
            found, remedy = f"a matrix of determinant {np.linalg.det(turn):.3g}", "remove scale and mirroring"
            raise ValueError(f"viewmat[:3, :3] must be a rotation, got {found}; {remedy}")
        if np.abs(row - _LAST).max() > _ROUNDING:
            remedy = "give the translation as the last column"
            raise ValueError(f"the last row of viewmat must be 0, 0, 0, 1, got {row.tolist()}; {remedy}")

    def __repr__(self) -> str:
        x, y, z = self.position
        return f"Camera({self.width}x{self.height}, focal {self.K[0, 0]:.4g}, at ({x:.3g}, {y:.3g}, {z:.3g}))"

    @property
    def position(self) -> NDArray[np.float64]:
        """Center of projection in world coordinates ``[3]``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def forward(self) -> NDArray[np.float64]:
        """Viewing direction in world coordinates ``[3]``, unit length."""
        return np.asarray(self.viewmat[2, :3] / np.linalg.norm(self.viewmat[2, :3]), dtype=np.float64)

    def local(self, points: NDArray) -> NDArray[np.float64]:
        """World points ``[..., 3]`` in the axes of the camera."""
        return np.asarray(points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3])

    def world(self, local: NDArray) -> NDArray[np.float64]:
        """The inverse of `local`."""
        return np.asarray((local - self.viewmat[:3, 3]) @ self.viewmat[:3, :3])

    def project(self, points: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Pixels ``[..., 2]``, depths ``[...]``, and whether in the image ``[...]``, of world points ``[..., 3]``.

        Lenses do not count. The pixels of points behind the camera mean nothing.
        """
        local = self.local(points) @ self.K.T
        depth = local[..., 2]
        pixels = local[..., :2] / np.maximum(depth, 1e-6)[..., None]
        inside = ((pixels >= 0) & (pixels < (self.width, self.height))).all(-1)
        return pixels, depth, inside & (depth > 1e-6)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for another image size; the field of view is unchanged."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(width, height, scale @ self.K, self.viewmat)

    def downscaled(self, factor: float) -> Camera:
        """The same camera for an image smaller by ``factor``; sizes are rounded and at least one pixel."""
        if not factor > 0:
            raise ValueError(f"downscale must be positive, got {factor:g}")
        return self.resized(max(1, round(self.width / factor)), max(1, round(self.height / factor)))

    def within(self, side: int) -> Camera:
        """The same camera, downscaled if its longer side exceeds ``side`` pixels."""
        return self.downscaled(max(1.0, max(self.width, self.height) / side))


def _whole(name: str, value: object) -> int:
    """A size as an ``int``, whichever type of number states it."""
    number = _number(value)
    if isinstance(number, Real) and number % 1 == 0:
        return int(float(number))
    raise ValueError(f"{name} must be a whole number of pixels, got {value!r:.40}")


def _number(value: object) -> object:
    """The number in an array or tensor without dimensions."""
    return value.item() if getattr(value, "ndim", None) == 0 and hasattr(value, "item") else value


def look_at(position: NDArray, target: NDArray, up: NDArray, width: int, height: int, fov_y: float) -> Camera:
    """A camera at ``position`` directed at ``target``.

    Args:
        position: Center of projection ``[3]``, world.
        target: Point projected to the image center ``[3]``, world.
        up: World direction that points up in the image ``[3]``; not parallel to the viewing direction.
        width: Image width in pixels.
        height: Image height in pixels.
        fov_y: Vertical field of view in radians, above 0 and below pi.

    Raises:
        ValueError: If the field of view is outside its range, the target is at the position, or the directions are
            parallel; see also `Camera`.
    """
    fov_y = cast(float, _number(fov_y))
    if not (isinstance(fov_y, Real) and 0 < fov_y < np.pi):
        remedy = "convert degrees with math.radians"
        raise ValueError(f"fov_y: expected radians above 0 and below pi, found {fov_y!r:.40}; {remedy}")
    if np.array_equal(position, target):
        raise ValueError(
            f"position and target: expected two points, found {np.asarray(target).tolist()} twice; move one"
        )
    rotation = looking_along(np.asarray(target, float) - np.asarray(position, float), up)
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ np.asarray(position, float)
    focal = 0.5 * height / np.tan(0.5 * fov_y)
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(width, height, K, viewmat)


def camera_extent(cameras: Iterable[Camera]) -> float:
    """Scene scale of 3DGS: 1.1 times the largest distance of a camera from the mean camera position.

    The extent of a single camera, or of cameras at one point, is 1.
    """
    positions = np.stack([camera.position for camera in cameras])
    radius = float(np.linalg.norm(positions - positions.mean(0), axis=1).max()) * 1.1
    return radius if radius > 1e-6 else 1.0
