"""Things in another color, with their old shading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.queries.colors import LUMINANCE

_BRIGHT = 0.9
"""Quantile of the shading from which on a recolored thing may turn pale."""


def recolored(gaussians: Gaussians, color: Sequence[float], strength: float) -> Gaussians:
    """The Gaussians in another color with their old shading: brighter parts stay brighter.

    Args:
        gaussians: The Gaussians of an object.
        color: Mean RGB in 0..1 afterwards. It is darkened where more than a tenth of the thing would be brighter than
            1, and the tenth is mixed with gray of its luminance, as highlights are.
        strength: 0 changes nothing, 1 removes the old hue and the view-dependent color.

    Raises:
        ValueError: If a number is out of range.
    """
    target = torch.tensor([float(c) for c in color])
    if target.shape != (3,) or not bool(((target >= 0) & (target <= 1)).all()) or not 0 <= strength <= 1:
        raise ValueError(
            f"a color is three numbers in 0..1, and strength too, got {list(color)}, {strength:g}"
        )
    if len(gaussians) == 0:
        return gaussians
    target = target.to(gaussians.sh0)
    old = gaussians.sh0[:, 0] * SH_C0 + 0.5
    weights = torch.from_numpy(LUMINANCE).to(old)
    light = (old.clamp(0, 1) @ weights).clamp_min(0.02)
    shares = gaussians.opacities / gaussians.opacities.sum().clamp_min(1e-12)
    shading = light / (light * shares).sum()
    ordered, order = shading.sort()
    bright = ordered[int((shares[order].cumsum(0) < _BRIGHT).sum().clamp_max(len(shading) - 1))]
    new = target * (shading / (target.max() * bright).clamp_min(1))[:, None]
    gray = (new @ weights)[:, None].clamp_max(1)
    room = (1 - gray) / (new.amax(1, keepdim=True) - gray).clamp_min(1e-6)
    new = gray + room.clamp_max(1) * (new - gray)
    mixed = (1 - strength) * old + strength * new
    sh0 = ((mixed - 0.5) / SH_C0)[:, None]
    return replace(gaussians, sh0=sh0, shN=gaussians.shN * (1 - strength))
