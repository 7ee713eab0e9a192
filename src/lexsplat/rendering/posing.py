"""Gradients for the camera's pose, on every backend: move the Gaussians into the camera's frame, then render.

Rendering from world-to-camera (R, t) equals rendering the Gaussians moved by (R, t) from a camera at the origin.
Means and rotations move differentiably here, so whatever gradient a backend gives them reaches the pose, and no
backend needs to know of poses. Colors depend on directions in the world; they are shaded there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians


def in_camera_frame(gaussians: Gaussians, viewmat: Tensor) -> Gaussians:
    """The Gaussians with means and rotations in camera axes; differentiable in both arguments.

    Args:
        gaussians: In the world.
        viewmat: World to camera ``[4, 4]``, rigid.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    return replace(
        gaussians,
        means=gaussians.means @ rotation.T + translation,
        quats=multiplied(quaternion(rotation), gaussians.quats),
    )


def around_the_camera(gaussians: Gaussians, viewmat: Tensor) -> Gaussians:
    """The Gaussians shifted so that the camera's center is the origin, in world axes: what shading looks at."""
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return replace(gaussians, means=gaussians.means - center)


def at_the_origin(camera: Camera) -> Camera:
    """The camera with its intrinsics and no pose."""
    return replace(camera, viewmat=np.eye(4))


def quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternion wxyz ``[4]`` of a rotation matrix ``[3, 3]``, differentiable.

    Of the four ways to write it, that with the largest divisor is taken (Shepperd 1978).
    """
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Row i is 4 q_i q: any of them is the quaternion, up to its length and sign.
    ways = torch.stack(
        [
            torch.stack([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]),
            torch.stack([m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]]),
            torch.stack([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]]),
            torch.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace]),
        ]
    )
    best = ways[int(ways.detach().diagonal().argmax())]
    return best / best.norm()


def multiplied(first: Tensor, second: Tensor) -> Tensor:
    """Products of quaternions wxyz, ``[..., 4]`` each: turn by ``second``, then by ``first``."""
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
