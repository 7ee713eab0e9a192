"""The transpose of rendering: values on pixels, added up on the Gaussians by their blending weights."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import backends
from lexsplat.rendering.compositing import check_prepared, prepare, render
from lexsplat.rendering.results import PreparedView

if TYPE_CHECKING:
    from numpy.typing import NDArray

BACK_PROJECTED_CHANNELS = 64
"""Channels that `back_project` processes at a time."""
IGNORED_CODE = 255
"""Marks a pixel without a code, in code maps with at most 255 codes."""


def back_project(gaussians: Gaussians, camera: Camera, values: Tensor, prepared: PreparedView) -> Tensor:
    """Back-project a map: the sum of alpha T values over the pixels, for each Gaussian.

    Rendering is linear in the features, so this is its gradient, computed `BACK_PROJECTED_CHANNELS` at a time.

    Args:
        gaussians: The scene.
        camera: The view of the map, with its size.
        values: ``[H, W, C]``, on the device of the Gaussians.
        prepared: From `prepare` for the same Gaussians and camera.

    Returns:
        ``[N, C]``.
    """
    parts = []
    with torch.enable_grad():
        for part in values.split(BACK_PROJECTED_CHANNELS, dim=-1):
            carried = torch.zeros(len(gaussians), part.shape[-1], device=gaussians.device, requires_grad=True)
            image = render(gaussians, camera, features=carried, color=False, prepared=prepared).features
            (gradient,) = torch.autograd.grad(image, carried, part.contiguous())
            parts.append(gradient)
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def accumulate_codes(
    gaussians: Gaussians,
    camera: Camera,
    code_map: Tensor | NDArray[Any],
    num_codes: int,
    *,
    prepared: PreparedView | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """Blending weight of each Gaussian at the pixels of each code: the sum of alpha T over them.

    This is the back-projection of one-hot codes without making them: one addition per pixel and Gaussian, whatever
    the number of codes.

    Args:
        gaussians: The scene.
        camera: The view of the code map, with its size.
        code_map: Code of each pixel ``[H, W]``, integers below ``num_codes``. Negative codes are ignored, and so is
            255 if ``num_codes`` <= 255.
        num_codes: K.
        prepared: From `prepare` for the same Gaussians and camera.
        out: Tensor ``[N, K]`` float32 to add to, for sums over views without a copy; default is zeros.

    Returns:
        Weights ``[N, K]`` in pixels; ``out`` if it was given.

    Raises:
        ValueError: If the map has another size than the camera, or a code is out of range.
    """
    module = backends.backend_for(gaussians)
    codes = np.asarray(code_map.cpu() if isinstance(code_map, Tensor) else code_map)
    if codes.shape != (camera.height, camera.width) or not np.issubdtype(codes.dtype, np.integer):
        raise ValueError(
            f"code_map must be integer [{camera.height}, {camera.width}], got {codes.dtype} {list(codes.shape)}"
        )
    highest = int(codes.max(initial=0, where=codes != IGNORED_CODE if num_codes <= IGNORED_CODE else True))
    if num_codes < 1 or highest >= num_codes:
        raise ValueError(f"codes must be below {num_codes}, got {highest}")
    # After the check: a 64-bit number could wrap around to a valid code.
    codes = np.ascontiguousarray(np.maximum(codes, -1) if codes.dtype.kind == "i" else codes, dtype=np.int32)
    if num_codes <= IGNORED_CODE:
        codes = np.where(codes == IGNORED_CODE, np.int32(-1), codes)
    if out is None:
        out = torch.zeros(len(gaussians), num_codes, device=gaussians.device)
    elif out.shape != (len(gaussians), num_codes) or out.dtype != torch.float32 or not out.is_contiguous():
        raise ValueError(
            f"out must be contiguous float32 [{len(gaussians)}, {num_codes}], got {list(out.shape)}"
        )
    if prepared is None:
        prepared = prepare(gaussians, camera)
    check_prepared(prepared, module, gaussians, camera)
    with torch.no_grad():
        module.accumulate_codes(prepared.projection, prepared.pairs, codes, num_codes, out)
    return out


def accumulate_weights(
    gaussians: Gaussians, camera: Camera, *, prepared: PreparedView | None = None
) -> Tensor:
    """Blending weight of each Gaussian over the whole view ``[N]``, in pixels."""
    everywhere = np.zeros((camera.height, camera.width), np.int32)
    return accumulate_codes(gaussians, camera, everywhere, 1, prepared=prepared)[:, 0]
