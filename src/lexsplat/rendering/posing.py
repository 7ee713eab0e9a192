"""Gradients for the camera's pose, on every backend: transform the Gaussians into the camera's frame, then render.

Rendering with world-to-camera (R, t) equals rendering the Gaussians transformed by (R, t) from a camera at the
origin. Means and rotations are transformed differentiably, so their gradients reach the pose, and no backend needs
to know about poses. Colors depend on directions in the world and are shaded there.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import differentiable_quaternion, multiply_quaternions


def in_camera_frame(gaussians: Gaussians, viewmat: Tensor) -> Gaussians:
    """The Gaussians with means and rotations in camera axes; differentiable in both arguments.

    Args:
        gaussians: Gaussians in the world.
        viewmat: World to camera ``[4, 4]``, rigid.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    return replace(
        gaussians,
        means=gaussians.means @ rotation.T + translation,
        quats=multiply_quaternions(differentiable_quaternion(rotation), gaussians.quats),
    )


def around_the_camera(gaussians: Gaussians, viewmat: Tensor) -> Gaussians:
    """The Gaussians in world axes with the camera's center at the origin, as shading needs them."""
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return replace(gaussians, means=gaussians.means - center)
