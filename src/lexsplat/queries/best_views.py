"""The views that show a selection best. What they show of segments may be kept (`lexsplat.queries.seen`)."""

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
_NEARLY = 0.8
"""A view that shows a thing whole wins over one that the border cuts if it shows this share of what that one does."""
_CUT = 0.01
"""Share of the points of a thing outside the image, or within this share of its longer side from the border, from
which on the border cuts the thing; fewer are strays."""
_POINTS = 512


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


def best_of(selection: Selection) -> str:
    """Name of the view that shows most of a selection, or nearly as much and the whole of it; "" for none."""
    shares, seen = selection.view_shares, selection.seen
    if not shares or shares[0][1] <= 0 or _is_whole(selection, shares[0][0]):
        return shares[0][0] if shares else ""
    if seen is not None and seen.complete:
        shares = seen.shares(selection.indices, None, most=len(seen.names))
    enough = (name for name, share in shares if share >= _NEARLY * shares[0][1])
    return next((name for name in enough if _is_whole(selection, name)), shares[0][0])


def _is_whole(selection: Selection, view: str) -> bool:
    """Whether the border of a view cuts nothing off a selection, whatever hides it."""
    camera, points = selection.cameras[view], selection.sample
    pixels, depth, _ = camera.project(points[:: max(1, len(points) // _POINTS)])
    size = np.array([camera.width, camera.height])
    margin = _CUT * size.max()
    inside = ((pixels >= margin) & (pixels < size - margin)).all(1) & (depth > 0)
    return bool(inside.mean() >= 1 - _CUT)


@torch.no_grad()
def visible_share(selection: Selection, camera: Camera) -> float:
    """Share of the image that the selection covers, with occlusion."""
    small = camera.within(_LONG_SIDE)
    carried = selection.mask[:, None].float()
    return float(render(selection.gaussians, small, features=carried, color=False).features.mean())
