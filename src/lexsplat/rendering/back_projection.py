"""The transpose of rendering: values on pixels, added up on the Gaussians by their blending weights."""

from __future__ import annotations

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering.compositing import prepare, render
from lexsplat.rendering.results import PreparedView

BACK_PROJECTED_CHANNELS = 64
"""Channels that `back_project` processes at a time."""


def back_project(
    gaussians: Gaussians, camera: Camera, values: Tensor, prepared: PreparedView | None = None
) -> Tensor:
    """Back-project a map: the sum of alpha T values over the pixels, for each Gaussian.

    Rendering is linear in the features, so this is its gradient, computed `BACK_PROJECTED_CHANNELS` at a time.

    Args:
        gaussians: The scene.
        camera: The view of the map, with its size.
        values: ``[H, W, C]``, on the device of the Gaussians.
        prepared: From `prepare` for the same Gaussians and camera; None prepares the view here.

    Returns:
        ``[N, C]``.
    """
    if prepared is None:
        prepared = prepare(gaussians, camera)
    parts = []
    with torch.enable_grad():
        for part in values.split(BACK_PROJECTED_CHANNELS, dim=-1):
            carried = torch.zeros(len(gaussians), part.shape[-1], device=gaussians.device, requires_grad=True)
            image = render(gaussians, camera, features=carried, color=False, prepared=prepared).features
            (gradient,) = torch.autograd.grad(image, carried, part.contiguous())
            parts.append(gradient)
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def accumulate_weights(
    gaussians: Gaussians, camera: Camera, *, prepared: PreparedView | None = None
) -> Tensor:
    """Blending weight of each Gaussian over the whole view ``[N]``, in pixels."""
    everywhere = torch.ones(camera.height, camera.width, 1, device=gaussians.device)
    return back_project(gaussians, camera, everywhere, prepared)[:, 0]
