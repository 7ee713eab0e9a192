"""The 3D Gaussians: stored (unconstrained) and activated values, and their initialization from points.

Dimension letters used across the project: N Gaussians, K codes of the codebook (N in the paper), S = 8 semantic
channels, D feature dimensions, H and W image size, C rendered channels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""

TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
"""The tensors of `Gaussians`, in the order of the fields."""

LARGEST = 1e12
"""Upper limit of the magnitude of valid numbers (see `Gaussians.find_invalid`)."""


@dataclass
class Gaussians:
    """Geometry and appearance of a scene. All tensors are float32 on one device.

    Args:
        means: Centers ``[N, 3]``, world units.
        quats: Rotations ``[N, 4]``, wxyz, not necessarily of unit length.
        log_scales: Natural logarithm of the standard deviations along the axes ``[N, 3]``.
        opacity_logits: Inverse sigmoid of the opacities ``[N]``.
        sh0: Constant color coefficient ``[N, 1, 3]``.
        shN: Higher spherical-harmonic coefficients ``[N, (degree + 1)^2 - 1, 3]``.
        antialiased: Whether they were trained with the mip filter and need it for rendering.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    shN: Tensor
    antialiased: bool = False

    def __post_init__(self) -> None:
        count = self.means.shape[0]
        shapes = {
            "means": (count, 3),
            "quats": (count, 4),
            "log_scales": (count, 3),
            "opacity_logits": (count,),
            "sh0": (count, 1, 3),
        }
        for name, shape in shapes.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"{name} must be {list(shape)}, got {list(found)}")
        if self.shN.ndim != 3 or self.shN.shape[0] != count or self.shN.shape[1] not in (0, 3, 8, 15, 24):
            raise ValueError(f"shN must be [{count}, 0 | 3 | 8 | 15 | 24, 3], got {list(self.shN.shape)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, sh_degree={self.sh_degree}, device={str(self.device)!r})"

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.means.device

    @property
    def sh_degree(self) -> int:
        """Highest stored degree of spherical harmonics."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes ``[N, 3]``, positive, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities ``[N]`` in 0..1."""
        return self.opacity_logits.sigmoid()

    def tensors(self) -> dict[str, Tensor]:
        """The stored tensors by name, in the order of the fields."""
        return {name: getattr(self, name) for name in TENSORS}

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """A copy with ``function`` applied to every tensor."""
        tensors: dict[str, Any] = {name: function(value) for name, value in self.tensors().items()}
        return replace(self, **tensors)

    def to(self, device: torch.device | str) -> Gaussians:
        """A copy on another device."""
        return self.map(lambda tensor: tensor.to(device))

    def detach(self) -> Gaussians:
        """The same values without gradient history."""
        return self.map(lambda tensor: tensor.detach())

    def find_invalid(self) -> str:
        """The first defect that prevents rendering, such as "NaN or Inf in means"; empty if there is none.

        Finite numbers can be invalid too: beyond `LARGEST`, squares and sums overflow in float32 and images get NaN.
        """
        for name, tensor in self.tensors().items():
            if not bool(torch.isfinite(tensor).all()):
                return f"NaN or Inf in {name}"
        for name in ("means", "quats", "log_scales", "sh0", "shN"):
            values = getattr(self, name)
            size, limit = (values, math.log(LARGEST)) if name == "log_scales" else (values.abs(), LARGEST)
            if not bool((size <= limit).all()):
                return f"numbers out of range in {name}"
        return ""

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians selected by a boolean mask ``[N]`` or an index tensor ``[M]``."""
        return self.map(lambda tensor: tensor[index])


def gaussians_from_points(
    points: np.ndarray,
    colors: np.ndarray,
    *,
    sh_degree: int = 3,
    opacity: float = 0.1,
    device: torch.device | str = "cpu",
) -> Gaussians:
    """One isotropic Gaussian per point; its scale is the mean distance to the three nearest neighbors (3DGS).

    Args:
        points: Positions ``[N, 3]``, world units.
        colors: RGB ``[N, 3]`` in 0..1.
        sh_degree: Highest stored degree of spherical harmonics; all coefficients but the constant start at zero.
        opacity: Initial opacity in 0..1.
        device: Device of the result.

    Raises:
        ValueError: If there are no points, a coordinate is not finite, the shape of the colors differs, or the
            opacity is not between 0 and 1.
    """
    points = np.asarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be [N, 3] with N > 0, got {list(points.shape)}")
    if not np.isfinite(points).all():
        raise ValueError("points must be finite, got NaN or infinity")
    if np.shape(colors) != points.shape:
        raise ValueError(f"colors must be {list(points.shape)}, got {list(np.shape(colors))}")
    if not 0 < opacity < 1:
        raise ValueError(f"opacity must be between 0 and 1, got {opacity:g}")
    count = len(points)
    spacing = np.ones(1)
    if count > 1:
        from scipy.spatial import cKDTree

        distances, _ = cKDTree(points).query(points, k=min(4, count), workers=-1)
        spacing = distances[:, 1:].mean(1)
        typical = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 1.0
        spacing = np.clip(spacing, 1e-3 * typical, 1e2 * typical)
    log_scales = torch.from_numpy(np.log(spacing).astype(np.float32))[:, None].repeat(1, 3)
    rgb = torch.from_numpy(np.asarray(colors, dtype=np.float32))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means=torch.from_numpy(points.copy()),  # a copy, because training is in place
        quats=quats,
        log_scales=log_scales,
        opacity_logits=torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        sh0=((rgb - 0.5) / SH_C0)[:, None, :],
        shN=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    ).to(device)


def joined(parts: list[Gaussians]) -> Gaussians:
    """All Gaussians in one; missing spherical harmonics are zero."""
    most = max(part.shN.shape[1] for part in parts)

    def padded(part: Gaussians, name: str) -> Tensor:
        tensor: Tensor = getattr(part, name)
        missing = most - part.shN.shape[1] if name == "shN" else 0
        return torch.nn.functional.pad(tensor, (0, 0, 0, missing)) if missing else tensor

    tensors = {name: torch.cat([padded(part, name) for part in parts]) for name in TENSORS}
    return replace(parts[0], **tensors, antialiased=all(part.antialiased for part in parts))
