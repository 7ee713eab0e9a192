"""The up direction, and upright oriented boxes around points.

One axis of a box is vertical; the other two are rotated to the smallest footprint. Objects in a room stand upright,
and an upright box is stable for round objects, whose free box would have a random orientation.
"""

from __future__ import annotations

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
_SAMPLE = 2048  # points that determine the rotation of a box


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

    def contains(self, points: NDArray, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which points ``[M, 3]`` are inside, or at most ``margin`` outside along each axis."""
        local = np.abs((np.asarray(points) - self.center) @ self.axes.T)
        return np.asarray((local <= self.half_sizes + margin).all(-1))


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


def fit_box(points: NDArray, up: NDArray, weights: NDArray | None = None, *, trim: float = 0.01) -> Box:
    """The upright box with the smallest footprint around all but the outermost points.

    Args:
        points: ``[M, 3]``, M > 0, world units.
        up: World direction of one axis ``[3]``.
        weights: Weight of each point ``[M]``; default is equal weights.
        trim: Share of the weight that may lie beyond each end of each axis, in 0..0.5.

    Raises:
        ValueError: If there is no point.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be [M, 3] with M > 0, got {list(points.shape)}")
    shares = np.ones(len(points)) if weights is None else np.asarray(weights, dtype=np.float64)
    first, second, upwards = upright_frame(up)
    step = max(1, len(points) // _SAMPLE)
    flat, flat_shares = points[::step], shares[::step]
    plane = np.stack([flat @ first, flat @ second], 1)
    # Widths in all directions at once; the two sides of a box are a quarter of the turns apart.
    low, high = _ends(plane @ _DIRECTIONS.T, flat_shares, trim)
    widths = high - low
    areas = widths[: len(_ANGLES)] * widths[len(_ANGLES) :]
    smallest = areas.min()
    # Round objects have no best angle; the first nearly optimal one keeps the box stable.
    angle = next(a for a, area in zip(_ANGLES, areas) if area <= smallest * 1.02 + 1e-12)
    turn = _turn(angle)
    axes = np.stack([*(turn @ np.stack([first, second])), upwards])
    low, high = _ends(points @ axes.T, shares, trim)
    return Box(((low + high) / 2) @ axes, axes, (high - low) / 2)


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


def _ends(values: NDArray, weights: NDArray, trim: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted quantiles ``trim`` and ``1 - trim`` of every column ``[M, C]``."""
    count, columns = values.shape
    rows = np.ascontiguousarray(values.T)
    limit, kept = trim * float(weights.sum()), min(count, 16 + int(6 * trim * count))
    while True:  # only the tails are sorted; light tails have more points
        parted = np.argpartition(rows, sorted({kept - 1, count - kept}), axis=1)  # both tails of a row
        tails = np.concatenate([parted[:, :kept], parted[:, count - kept :]])
        found = np.take_along_axis(np.concatenate([rows, -rows]), tails, 1)
        order = np.argsort(found, axis=1)
        beyond = np.cumsum(weights[np.take_along_axis(tails, order, 1)], axis=1)
        if kept == count or beyond[:, -1].min() > limit:
            break
        kept = min(count, 4 * kept)
    places = np.concatenate([(beyond[:columns] < limit).sum(1), (beyond[columns:] <= limit).sum(1)])
    every = np.arange(len(found))
    ends = found[every, order[every, places.clip(0, kept - 1)]]
    return ends[:columns], -ends[columns:]
