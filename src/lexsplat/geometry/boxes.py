"""The up direction, and upright oriented boxes around points.

One axis of a box is vertical; the other two are rotated to the smallest footprint. Objects in a room stand upright,
and an upright box is stable for round objects, whose free box would have a random orientation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera

_ANGLES = np.radians(np.arange(0.0, 90.0, 2.0))
_DIRECTIONS = np.concatenate(
    [np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1), np.stack([-np.sin(_ANGLES), np.cos(_ANGLES)], 1)]
)
"""First and second axis of the boxes of all angles ``[2 A, 2]``."""
SAMPLE, _OF_LARGE = 1024, 4096
"""Points that determine the box of a thing, and of what has more Gaussians than the latter, such as a table: it is
thin at its ends, which moved by a tenth of it with a Gaussian more or less."""
_TURNED, _TRIM_TURNED = 1024, 2048
"""Points that determine the rotation of a box, and of a trimmed one."""
_STRETCH, _DENSE = 0.03, 0.0075
"""Part of the length of a thing, from 5 to 95 % of its points, and the share of them that it holds at an end."""
_FEW = 0.01
"""Share of the points that may lie far beyond an end."""


class Box(NamedTuple):
    """An oriented box.

    Args:
        center: Center ``[3]``, world units.
        axes: Axes as rows ``[3, 3]``, of unit length, right-handed; the last one points up.
        half_sizes: Half of its extent along each of the axes ``[3]``, world units.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    half_sizes: NDArray[np.float64]

    @property
    def corners(self) -> NDArray[np.float64]:
        """The eight corners ``[8, 3]``."""
        signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(8, 3)
        return np.asarray(self.center + (signs * self.half_sizes) @ self.axes, dtype=np.float64)

    @property
    def volume(self) -> float:
        """Volume in cubic world units."""
        return float(np.prod(2 * self.half_sizes))

    def contains(self, points: NDArray) -> NDArray[np.bool_]:
        """Which points ``[M, 3]`` are inside."""
        local = np.abs((np.asarray(points) - self.center) @ self.axes.T)
        return np.asarray((local <= self.half_sizes).all(-1))


@dataclass(frozen=True)
class Up:
    """The direction away from the ground.

    Args:
        direction: World direction ``[3]`` of unit length.
        reliable: Whether the cameras agree; photos taken at odd angles do not.
    """

    direction: NDArray[np.float64]
    reliable: bool


def gravity_up(cameras: Iterable[Camera]) -> Up:
    """Estimate the up direction from the camera poses.

    People hold cameras level: the x axes are horizontal, whatever the pitch. Up is therefore the direction most
    orthogonal to all x axes. If all cameras look the same way, their x axes agree and leave a plane of directions;
    then up is the mean of the images' up directions.

    Raises:
        ValueError: If there is no camera.
    """
    rotations = [camera.viewmat[:3, :3] for camera in cameras]
    if not rotations:
        raise ValueError("gravity needs at least one camera")
    rights = np.stack([r[0] / np.linalg.norm(r[0]) for r in rotations])
    mean_up = -np.stack([r[1] / np.linalg.norm(r[1]) for r in rotations]).mean(0)
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    length = float(np.linalg.norm(mean_up))
    if values[1] > 4 * values[0] + 0.02:
        direction = vectors[:, 0] * (1.0 if vectors[:, 0] @ mean_up >= 0 else -1.0)
        return Up(direction, bool(values[0] < 0.05 and abs(direction @ mean_up) > 0.1))
    if length < 1e-6:
        return Up(np.array([0.0, 0.0, 1.0]), False)
    return Up(mean_up / length, bool(length > 0.8))


def fit_box(points: NDArray, up: NDArray, spreads: NDArray | None = None) -> Box:
    """The upright box of a thing: it ends where its points are dense, and strays beyond do not count.

    An end is dense where the next 3 % of the length inwards hold .75 % of the points: about a quarter of what they
    hold where the points are spread evenly. Strays are few or near: all but 1 % of the points lie at most 3 % of the
    longest side beyond an end. What is more and farther is a sparse part, such as the pot under a plant. The axes
    have the smallest footprint, measured without the outermost 1 % and the outermost 5 %, each relative to the
    smallest.

    Args:
        points: ``[M, 3]``, M > 0, world units, of equal weight; `representatives` picks those of many.
        up: World direction of one axis ``[3]``.
        spreads: The axes of the Gaussians around the points as columns, times their standard deviations
            ``[M, 3, 3]``: each counts at one standard deviation before and behind its center. None: at its center.

    Raises:
        ValueError: If there is no point.
    """
    points = _checked(points)
    axes = _smallest_footprint(points[:: -(-len(points) // _TURNED)], up, (0.01, 0.05))
    along = points @ axes.T
    if spreads is not None:
        reach = np.linalg.norm(axes @ np.asarray(spreads, dtype=np.float64), axis=2)
        along = np.concatenate([along - reach, along + reach])
    (low, high), ([fewest_low], [fewest_high]) = _dense_ends(along), _trimmed_ends(along, (_FEW,))
    near = _STRETCH * (fewest_high - fewest_low).max()
    return _box(np.minimum(low, fewest_low + near), np.maximum(high, fewest_high - near), axes)


def representatives(weights: NDArray) -> NDArray[np.intp]:
    """Indices of points that stand for all in `fit_box`: each is there as often as it weighs.

    They are at most `SAMPLE`, or four times as many of a large thing.

    Args:
        weights: Weight of each point ``[M]``, not negative, M > 0; there are at most two indices for each point.
    """
    reached = np.cumsum(np.asarray(weights, dtype=np.float64))
    count = _OF_LARGE if len(reached) > _OF_LARGE else min(SAMPLE, 2 * len(reached))
    steps = (np.arange(count) + 0.5) / count * reached[-1]
    return np.searchsorted(reached, steps).clip(0, len(reached) - 1)


def trimmed_box(points: NDArray, up: NDArray, trim: float) -> Box:
    """The upright box with the smallest footprint around all but a share of the points.

    Args:
        points: ``[M, 3]``, M > 0, world units.
        up: World direction of one axis ``[3]``.
        trim: Share of the points that may lie beyond each end of each axis, in 0..0.5.

    Raises:
        ValueError: If there is no point.
    """
    points = _checked(points)
    axes = _smallest_footprint(points[:: max(1, len(points) // _TRIM_TURNED)], up, (trim,))
    low, high = _trimmed_ends(points @ axes.T, (trim,))
    return _box(low[0], high[0], axes)


def upright_frame(up: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Two horizontal directions and up ``[3]`` each: right-handed, of unit length."""
    upwards = np.asarray(up, dtype=np.float64)
    upwards = upwards / np.linalg.norm(upwards)
    start = np.eye(3)[int(np.abs(upwards).argmin())]
    first = start - (start @ upwards) * upwards
    first /= np.linalg.norm(first)
    return first, np.cross(upwards, first), upwards


def _turn(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def _checked(points: NDArray) -> NDArray[np.float64]:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be [M, 3] with M > 0, got {list(points.shape)}")
    return points


def _box(low: NDArray, high: NDArray, axes: NDArray) -> Box:
    return Box(((low + high) / 2) @ axes, axes, (high - low) / 2)


def _smallest_footprint(points: NDArray, up: NDArray, trims: tuple[float, ...]) -> NDArray[np.float64]:
    """Axes ``[3, 3]`` whose footprints, relative to the smallest one at each trim, have the smallest sum."""
    first, second, upwards = upright_frame(up)
    plane = np.stack([points @ first, points @ second], 1)
    # Widths in all directions at once; the two sides of a box are a quarter of the turns apart.
    low, high = _trimmed_ends(plane @ _DIRECTIONS.T, trims)
    widths = high - low
    areas = widths[:, : len(_ANGLES)] * widths[:, len(_ANGLES) :] + 1e-12
    relative = (areas / areas.min(1, keepdims=True)).mean(0)
    # Round objects have no best angle; the first nearly optimal one keeps the box stable.
    turn = _turn(next(a for a, area in zip(_ANGLES, relative) if area <= relative.min() * 1.02))
    return np.stack([*(turn @ np.stack([first, second])), upwards])


def _trimmed_ends(
    values: NDArray, trims: tuple[float, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Minimum and maximum ``[T, C]`` of each column of ``[M, C]`` after trimming each of T shares at both ends."""
    count = len(values)
    low = [max(math.ceil(trim * count) - 1, 0) for trim in trims]
    high = [count - 1 - math.floor(trim * count) for trim in trims]
    parted = np.partition(np.ascontiguousarray(values.T), sorted({*low, *high}), axis=1)
    return parted[:, low].T, parted[:, high].T


def _dense_ends(values: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The outermost of every column of ``[M, C]`` from which `_STRETCH` of the length hold `_DENSE` of all."""
    rows = np.sort(values, axis=0)
    count, more = len(rows), math.ceil(_DENSE * len(rows)) - 1
    length = rows[int(0.95 * count)] - rows[int(0.05 * count)]
    dense = rows[more:] - rows[: count - more] <= _STRETCH * length
    every = np.arange(rows.shape[1])
    return rows[dense.argmax(0), every], rows[count - 1 - dense[::-1].argmax(0), every]
