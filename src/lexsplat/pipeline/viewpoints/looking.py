"""Small renderings of splats: depth, and the share that looks like surfaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.candidates import above
from lexsplat.pipeline.viewpoints.surroundings import Target
from lexsplat.rendering import prepare, render

SMALL = (96, 72)
"""Width and height of the views that are examined, in pixels."""
_SPREAD = 0.1
"""Standard deviation of depth along a ray, relative to depth, beyond which a pixel shows no surface."""
_LEAST_DRAWN = 0.15
"""Least share of the pixels of a view that show anything."""

Image = NDArray[np.float32]


def look(gaussians: Gaussians, camera: Camera) -> tuple[Image, float]:
    """Depth of a small view ``[H, W]``, infinite where nothing is drawn, and its share of surfaces."""
    depth, square, alpha = draw_depth(gaussians, camera)
    return np.where(alpha > 0.1, depth, np.inf), surface_share(depth, square, alpha)


def draw_depth(gaussians: Gaussians, camera: Camera) -> tuple[Image, Image, Image]:
    """Mean depth and mean squared depth of what is blended in each pixel, and alpha, all ``[H, W]``."""
    prepared = prepare(gaussians, camera)
    depths = prepared.projection.depths[:, None]
    moments = torch.cat([depths, depths**2], 1)
    drawn = render(gaussians, camera, features=moments, color=False, prepared=prepared)
    alpha = drawn.alpha.cpu().numpy()
    depth, square = (drawn.features[..., i].cpu().numpy() / np.maximum(alpha, 1e-6) for i in (0, 1))
    return depth, square, alpha


def look_from_above(gaussians: Gaussians) -> Callable[[Target, NDArray[np.float64]], float]:
    """How much Gaussians look like surfaces from above, in 0..1, as a function of the whole and the up direction."""

    def measure(whole: Target, up: NDArray[np.float64]) -> float:
        shares = [look(gaussians, camera)[1] for camera in above(whole, up, SMALL)]
        return float(np.mean(sorted(shares)[len(shares) // 2 :]))  # photos are often taken from one side only

    return measure


def surface_share(depth: Image, square: Image, alpha: Image) -> float:
    """Share of the drawn pixels of a view that show a surface; 0 if hardly anything is drawn.

    A pixel shows a surface if it is opaque and what is blended in it lies at one depth. Floaters, fog, holes and the
    backs of things blend what is far apart.

    Args:
        depth: Mean depth ``[H, W]``, world units.
        square: Mean squared depth ``[H, W]``.
        alpha: ``[H, W]`` in 0..1.
    """
    drawn = alpha > 0.1
    if drawn.mean() < _LEAST_DRAWN:
        return 0.0
    spread = np.sqrt(np.maximum(square - depth**2, 0)) / np.maximum(depth, 1e-6)
    return float(((alpha > 0.9) & (spread < _SPREAD)).sum() / drawn.sum())
