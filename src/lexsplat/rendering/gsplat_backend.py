"""The CUDA rasterizer: gsplat's kernels behind the same functions as `cpu_backend`.

gsplat's steps are called one by one instead of its `rasterization`, so that the color pass and the feature pass
share projection and sorting. The feature pass receives the geometry detached.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import sys
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering.results import Projection, Rendering
from lexsplat.runtime.errors import BackendError

log = logging.getLogger("lexsplat")

TILE = 16
CHANNELS = 32
"""Channels blended at a time. This bounds memory to [N, 32] and [H, W, 32]. In the backward
pass gsplat keeps the colors of 256 Gaussians in a block's shared memory; 64 channels do not fit on small cards."""
CAMERAS = 4096
"""Number of camera matrices cached on the device, so that rendering a view again needs no copy."""


@dataclass(frozen=True)
class TileLists:
    """The Gaussians of each tile, in gsplat's layout.

    Args:
        width: Image width in pixels.
        height: Image height in pixels.
        offsets: First entry of each tile ``[1, tile rows, tile columns]``.
        members: Gaussian of each entry ``[M]``.
    """

    width: int
    height: int
    offsets: Tensor
    members: Tensor

    @property
    def nbytes(self) -> int:
        """Memory held by the lists."""
        return sum(t.numel() * t.element_size() for t in (self.offsets, self.members))


def require_gsplat(instead: str = "--device cpu") -> None:
    """Load gsplat with its CUDA extension.

    Args:
        instead: Options of the command with which it runs without gsplat, for the error.

    Raises:
        BackendError: If it is not installed, or has no extension and no compiler to build it with.
    """
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        raise BackendError(
            "gsplat", found=str(error), remedy=f"run: pip install gsplat==1.5.3; or use {instead}"
        ) from error
    found = "an installation without one"
    # The import may compile the extension and print to standard output, which carries our JSON.
    first = "gsplat.cuda._backend" not in sys.modules
    try:
        with contextlib.redirect_stdout(sys.stderr) if first else contextlib.nullcontext():
            from gsplat.cuda._backend import _C
    except Exception as error:  # a compiler can fail in any way
        log.debug("gsplat: its CUDA extension: %s", error, exc_info=error)
        _C, found = None, f"{type(error).__name__} {_cause(str(error))}"
    if _C is None:
        raise BackendError(
            "gsplat",
            expected="its CUDA extension",
            found=found,
            remedy="install a wheel built for this torch and CUDA, or put nvcc and a C++ compiler on the PATH, or "
            f"rasterize on the CPU: {instead}",
        )


def _cause(output: str) -> str:
    """What a compiler says at last: the last lines with an error, else the last lines."""
    lines = [line.strip()[:160] for line in output.splitlines() if line.strip()]
    return "; ".join([line for line in lines if "error" in line.lower()][-3:] or lines[-3:])


def _matrix(matrix: NDArray[np.float64], device: torch.device) -> Tensor:
    """A camera's matrix ``[1, ...]`` on the device; it is cached and must not be changed."""
    single = np.ascontiguousarray(matrix, dtype=np.float32)[None]
    return _cached(single.tobytes(), single.shape, device)


@functools.lru_cache(CAMERAS)
def _cached(content: bytes, shape: tuple[int, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # gsplat saves it for the backward pass
        return torch.from_numpy(np.frombuffer(content, np.float32).reshape(shape).copy()).to(device)


def project(gaussians: Gaussians, camera: Camera, near: float) -> Projection:
    """Project every Gaussian; means2d, conics and opacities have gradients."""
    require_gsplat()
    from gsplat.cuda._wrapper import fully_fused_projection

    g = gaussians
    opacities = g.opacities
    if len(g) == 0:  # gsplat divides by the number of Gaussians, which kills the process
        none = g.means.new_zeros(0, 2).int()
        depths = g.means[:, 2].detach()
        return Projection(
            means2d=g.means[:, :2], conics=g.means, opacities=opacities, depths=depths, radii=none
        )
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        g.means, None, g.quats, g.scales,
        _matrix(camera.viewmat, g.device), _matrix(camera.K, g.device), camera.width, camera.height,
        near_plane=near, calc_compensations=g.antialiased, opacities=opacities.detach(),
    )  # fmt: skip
    if compensations is not None:
        opacities = opacities * compensations[0]
    return Projection(
        means2d=means2d[0], conics=conics[0], opacities=opacities, depths=depths[0].detach(), radii=radii[0]
    )


def find_tiles(projection: Projection, camera: Camera) -> TileLists:
    """The Gaussians of each tile, sorted by depth."""
    from gsplat.cuda._wrapper import isect_offset_encode, isect_tiles

    p = projection
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    with torch.no_grad():
        _, keys, members = isect_tiles(
            p.means2d.detach()[None], p.radii[None], p.depths[None], TILE, columns, rows
        )
        offsets = isect_offset_encode(keys, 1, columns, rows)
    return TileLists(camera.width, camera.height, offsets, members)


def shade(gaussians: Gaussians, camera: Camera, projection: Projection, degree: int) -> Tensor:
    """RGB ``[N, 3]`` of the visible Gaussians as seen from the camera: max(0, SH + 0.5)."""
    from gsplat.cuda._wrapper import spherical_harmonics

    eye = _matrix(camera.position, gaussians.device)
    coefficients = torch.cat([gaussians.sh0, gaussians.shN[:, : (degree + 1) ** 2 - 1]], 1)
    colors = spherical_harmonics(
        degree, gaussians.means - eye, coefficients, masks=(projection.radii > 0).all(-1)
    )
    return torch.clamp_min(colors + 0.5, 0.0)


def _rasterize(
    geometry: tuple[Tensor, ...], lists: TileLists, values: Tensor, background: Tensor | None
) -> tuple[Tensor, Tensor]:
    from gsplat.cuda._wrapper import rasterize_to_pixels

    means2d, conics, opacities = geometry
    images: list[Tensor] = []
    alphas: list[Tensor] = []
    for part in values.split(CHANNELS, dim=1):
        image, found = rasterize_to_pixels(
            means2d[None], conics[None], part[None], opacities[None],
            lists.width, lists.height, TILE, lists.offsets, lists.members,
            backgrounds=None if background is None else background[None],
        )  # fmt: skip
        images.append(image[0])
        alphas.append(found[0, ..., 0])
    return (images[0] if len(images) == 1 else torch.cat(images, -1)), alphas[0]


def blend(
    projection: Projection,
    pairs: TileLists,
    colors: Tensor | None,
    features: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Channels ``[H, W, C]`` and alpha ``[H, W]``: a color pass, then a feature pass over detached geometry."""
    geometry = projection.means2d, projection.conics, projection.opacities
    detached = tuple(t.detach() for t in geometry)
    alone = not any(t.requires_grad for t in geometry)
    images = []
    alpha = None
    if colors is not None:
        image, alpha = _rasterize(geometry, pairs, colors, background)
        images.append(image)
    if features is not None and features.shape[1] > 0:
        image, detached_alpha = _rasterize(detached, pairs, features, None)
        images.append(image)
        if alpha is None and alone:
            alpha = detached_alpha
    if alpha is None:
        _, alpha = _rasterize(geometry, pairs, geometry[2].detach()[:, None], None)
    if not images:
        return alpha.new_empty(pairs.height, pairs.width, 0), alpha
    return (images[0] if len(images) == 1 else torch.cat(images, -1)), alpha


def render_distributed(gaussians: Gaussians, camera: Camera, degree: int, background: Tensor) -> Rendering:
    """Render the view of this process with the Gaussians of all processes of the group (`torch.distributed`).

    All processes call it at once, with their own Gaussians and views of one size.

    Args:
        gaussians: Those of this process.
        camera: The view of this process.
        degree: Highest degree of spherical harmonics.
        background: RGB ``[3]`` behind the Gaussians.

    Returns:
        The rendering; its centers ``[C, N, 2]`` and radii ``[C, N]`` are those of the N Gaussians of this process in
        the views of all C processes.
    """
    require_gsplat()
    from gsplat.rendering import rasterization

    g = gaussians
    image, alpha, found = rasterization(
        g.means, g.quats, g.scales, g.opacities, torch.cat([g.sh0, g.shN], 1),
        _matrix(camera.viewmat, g.device), _matrix(camera.K, g.device), camera.width, camera.height,
        sh_degree=degree, tile_size=TILE, backgrounds=background[None], packed=False, distributed=True,
        rasterize_mode="antialiased" if g.antialiased else "classic",
    )  # fmt: skip
    means2d = found["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    return Rendering(image[0], alpha[0, ..., 0], means2d, found["radii"].amax(-1), 3)
