"""Similarity transforms of Gaussians: rotation, scale and translation, colors included.

Spherical harmonics are a function of the viewing direction in the world, so rotating a body rotates its
coefficients: within a degree they mix by a matrix that depends on the rotation alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import multiply_quaternions, quaternion_from_matrix, rotation_about
from lexsplat.queries.selection import Selection
from lexsplat.rendering.kernels.spherical_harmonics import basis_at
from lexsplat.runtime.errors import QueryError

_DIRECTIONS = 64


def transformed(
    gaussians: Gaussians,
    *,
    rotation: NDArray[np.float64] | None = None,
    scale: float = 1.0,
    translation: NDArray[np.float64] | None = None,
    center: NDArray[np.float64] | None = None,
) -> Gaussians:
    """The Gaussians after x -> scale R (x - center) + center + translation.

    Args:
        gaussians: The Gaussians to transform.
        rotation: R ``[3, 3]``, a proper rotation; None is the identity.
        scale: Factor on sizes and distances, positive.
        translation: ``[3]``, world units; None is zero.
        center: Fixed point of rotation and scaling ``[3]``; None is the origin.

    Raises:
        ValueError: If R is not a rotation, the scale is not positive, or a number is not finite.
    """
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(f"scale must be positive, got {scale:g}")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    if (
        turn.shape != (3, 3)
        or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-5)
        or np.linalg.det(turn) < 0
    ):
        raise ValueError("rotation must be a [3, 3] matrix of a proper rotation")
    place = np.zeros(3) if center is None else np.asarray(center, dtype=np.float64)
    shift = np.zeros(3) if translation is None else np.asarray(translation, dtype=np.float64)
    if not all(vector.shape == (3,) and np.isfinite(vector).all() for vector in (place, shift)):
        raise ValueError("center and translation must be three finite numbers")
    matrix, offset = scale * turn, place + shift - scale * turn @ place
    means = gaussians.means.double() @ _like(matrix.T, gaussians) + _like(offset, gaussians)
    changed = replace(gaussians, means=means.float(), log_scales=gaussians.log_scales + math.log(scale))
    if np.allclose(turn, np.eye(3), atol=1e-12):
        return changed
    quats = multiply_quaternions(
        _like(quaternion_from_matrix(turn), gaussians), gaussians.quats.double()
    ).float()
    return replace(changed, quats=quats, shN=rotated_harmonics(gaussians.shN, turn))


def rotated_harmonics(shN: Tensor, rotation: NDArray[np.float64]) -> Tensor:
    """Coefficients ``[N, (degree + 1)^2 - 1, 3]`` of a body after ``rotation [3, 3]``.

    The rotated body has in direction d the color that the body has in direction R^T d. The matrix of each degree is
    the least-squares solution over many directions. It is exact, as the harmonics of a degree are closed under
    rotation.
    """
    degree = round((shN.shape[1] + 1) ** 0.5) - 1
    if degree == 0:
        return shN
    turn = np.asarray(rotation, dtype=np.float64)
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after, before = basis_at(directions, degree), basis_at(directions @ turn, degree)
    blocks = []
    for order in range(1, degree + 1):
        columns = slice(order * order, (order + 1) ** 2)
        matrix = np.linalg.lstsq(after[:, columns], before[:, columns], rcond=None)[0]
        rows = shN[:, columns.start - 1 : columns.stop - 1].double()
        blocks.append(torch.einsum("ij,njc->nic", torch.from_numpy(matrix).to(rows), rows))
    return torch.cat(blocks, dim=1).float()


def _like(array: NDArray[np.float64], gaussians: Gaussians) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(gaussians.device)


@dataclass(frozen=True)
class Motion:
    """A similarity transform of a selection about the center c of its box: x -> scale R (x - c) + c + t.

    Args:
        translation: ``[3]``, world units. t is this and what keeps the bottom of the box at its height.
        rotation: R ``[3, 3]``, a proper rotation; None is the identity.
        scale: Factor on sizes, positive.
        turn: Degrees about the up direction, counterclockwise from above, after the rotation.

    Raises:
        ValueError: If the translation is not three numbers, or the rotation no ``[3, 3]``.
    """

    translation: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: NDArray[np.float64] | None = None
    scale: float = 1.0
    turn: float = 0.0

    def __post_init__(self) -> None:
        for name, shape in (("translation", (3,)), ("rotation", (3, 3))):
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise ValueError(f"{name} must have the shape {shape}, got {value!r}"[:200])

    def values(self, chosen: Selection) -> dict[str, Any]:
        """The numbers of a `Step` that moves ``chosen``.

        Raises:
            QueryError: If nothing would move.
        """
        rotation = np.eye(3) if self.rotation is None else self.rotation
        still = self.scale == 1 and not self.turn and not np.any(self.translation)
        if still and np.array_equal(rotation, np.eye(3)):
            raise QueryError(
                "motion", expected="a translation, a rotation or a scale other than 1", found="none of them"
            )
        center, lift = np.zeros(3), np.zeros(3)
        if chosen:
            center, lift = chosen.center, (self.scale - 1) * chosen.box.half_sizes[2] * chosen.up.direction
        if self.turn:
            rotation = rotation_about(chosen.up.direction, self.turn) @ rotation
        vectors = {
            "rotation": rotation,
            "translation": np.asarray(self.translation, float) + lift,
            "center": center,
        }
        numbers = {name: np.asarray(value, float).tolist() for name, value in vectors.items()}
        return {**numbers, "scale": float(self.scale)}
