"""The views that show a selection best, where the visibility of segments is not kept (`lexsplat.queries.seen`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from lexsplat.geometry.cameras import Camera
from lexsplat.rendering import render

if TYPE_CHECKING:
    from lexsplat.queries.selection import Selection

_SAMPLE = 2048
_MOST = 8
_LONG_SIDE = 120


def promising_views(selection: Selection) -> list[str]:
    """The views in which the selection would be largest without occlusion, at most 8, best first."""
    if not selection or not selection.cameras:
        return []
    points, weights = selection.points
    sizes = selection.gaussians.log_scales.detach()[selection.indices].exp().cpu().numpy()
    areas = weights * np.sort(sizes, axis=1)[:, 1:].prod(1)
    step = max(1, len(points) // _SAMPLE)
    points, areas = points[::step], areas[::step]
    found = []
    for name, camera in selection.cameras.items():
        _, depth, inside = camera.project(points)
        scale = camera.K[0, 0] * camera.K[1, 1] / (camera.width * camera.height)
        size = (areas * inside / np.maximum(depth, 1e-6) ** 2).sum() * scale * inside.mean()
        found.append((float(size), name))
    found.sort(key=lambda entry: -entry[0])
    return [name for size, name in found[:_MOST] if size > 0] or [found[0][1]]


@torch.no_grad()
def visible_share(selection: Selection, camera: Camera) -> float:
    """Share of the image that the selection covers, with occlusion."""
    small = camera.within(_LONG_SIDE)
    carried = selection.mask[:, None].float()
    return float(render(selection.gaussians, small, features=carried, color=False).features.mean())
