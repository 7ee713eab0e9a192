"""Rotations: quaternions (wxyz), matrices, and the covariances of Gaussians.

Functions on tensors are differentiable and take batches; functions on arrays compute in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_PARALLEL = 1e-6
"""Largest sine of the angle between parallel directions; below it, rounding decides what is up."""
_IDENTITY = np.eye(3)


def matrices_from_quaternions(quats: Tensor) -> Tensor:
    """Rotation matrices ``[N, 3, 3]`` of quaternions ``[N, 4]``, wxyz of any length but 0."""
    entries = _entries(*torch.nn.functional.normalize(quats, dim=-1).unbind(-1))
    return torch.stack(entries, -1).reshape(-1, 3, 3)


def _entries(w: Any, x: Any, y: Any, z: Any) -> list[Any]:
    """The nine entries of the rotation matrix of a unit quaternion, row by row."""
    return [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances ``R S S^T R^T`` of Gaussians.

    Args:
        quats: Rotations ``[N, 4]``, wxyz of any length but 0.
        scales: Standard deviations ``[N, 3]``, world units.

    Returns:
        ``[N, 3, 3]``, world units squared.
    """
    half = matrices_from_quaternions(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def multiply_quaternions(first: Tensor, second: Tensor) -> Tensor:
    """Products of quaternions wxyz ``[..., 4]``: the rotation by ``second``, then by ``first``."""
    w1, x1, y1, z1 = first.unbind(-1)
    w2, x2, y2, z2 = second.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def differentiable_quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternion wxyz ``[4]`` of a rotation matrix ``[3, 3]``, differentiable.

    Of the four equivalent formulas, the one with the largest divisor is used (Shepperd 1978).
    """
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Row i is 4 q_i q: each of them is the quaternion, up to length and sign.
    rows = torch.stack(
        [
            torch.stack([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]),
            torch.stack([m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]]),
            torch.stack([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]]),
            torch.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace]),
        ]
    )
    best = rows[int(rows.detach().diagonal().argmax())]
    return best / best.norm()


def quaternion_from_matrix(rotation: NDArray) -> NDArray[np.float64]:
    """Unit quaternion wxyz ``[4]`` of a rotation matrix ``[3, 3]``, with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_quat(canonical=True)
    return np.array([w, x, y, z])


def matrix_from_quaternion(quaternion: NDArray) -> NDArray[np.float64]:
    """Rotation matrix ``[3, 3]`` of a quaternion wxyz ``[4]``; NaN for one of length 0."""
    q = np.asarray(quaternion, dtype=np.float64)
    return np.array(_entries(*(q / np.linalg.norm(q)))).reshape(3, 3)


def rotation_about(axis: NDArray, degrees: float) -> NDArray[np.float64]:
    """Rotation matrix ``[3, 3]`` by an angle about an axis ``[3]``, counterclockwise when the axis points at you."""
    from scipy.spatial.transform import Rotation

    unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    return np.asarray(Rotation.from_rotvec(unit * np.radians(degrees)).as_matrix(), dtype=np.float64)


def is_rotation(matrix: NDArray, tolerance: float) -> bool:
    """Whether a matrix ``[3, 3]`` is a rotation; ``tolerance`` bounds the error of an entry of its Gram matrix."""
    error = np.abs(matrix @ matrix.T - _IDENTITY).max()
    return bool(error <= tolerance and _cross(matrix[0], matrix[1]) @ matrix[2] > 0)


def looking_along(forward: NDArray, up: NDArray) -> NDArray[np.float64]:
    """Rotation world to camera ``[3, 3]`` (OpenCV axes) of a camera that looks along a direction.

    Args:
        forward: Viewing direction ``[3]``, world, of any length but 0.
        up: World direction that appears upwards ``[3]``; not parallel to ``forward``.

    Raises:
        ValueError: If ``up`` is parallel to ``forward``, or 0.
    """
    forward, up = np.asarray(forward, dtype=np.float64), np.asarray(up, dtype=np.float64)
    forward = forward / np.linalg.norm(forward)
    right = _cross(forward, up)
    length = np.linalg.norm(right)
    if length <= _PARALLEL * np.linalg.norm(up):
        raise ValueError(
            f"up: expected a direction that is not parallel to the viewing direction {forward.round(6).tolist()}, "
            f"found {up.tolist()}; choose another one"
        )
    right /= length
    return np.array([right, _cross(forward, right), forward])


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product of two vectors ``[3]``; `numpy.cross` takes ten times as long for the same bits."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
