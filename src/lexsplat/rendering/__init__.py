"""Rendering Gaussians to images with any number of channels, and the one choice of backend.

`render` composites color, features and alpha of one view; gradients of color and alpha reach the geometry,
gradients of features reach the features only. `prepare` does what depends on geometry and camera alone, for
those who render many features over geometry that does not move. `accumulate_codes` goes the other way: from
codes on pixels to weights on Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import posing
from lexsplat.runtime.errors import BackendError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "Backend",
    "PreparedView",
    "Rendering",
    "accumulate_codes",
    "accumulate_weights",
    "prepare",
    "render",
    "spread",
]

Backend = Literal["auto", "cpu", "gsplat"]
NEAR = 0.01
"""Gaussians nearer than this are not drawn, world units."""
BACK_PROJECTED_CHANNELS = 64
"""Channels that `spread` takes at a time."""
IGNORED_CODE = 255
"""In code maps with at most 255 codes: a pixel without a code."""


@dataclass
class Rendering:
    """One rendered view.

    Args:
        channels: Color, then features ``[H, W, C]``.
        alpha: 1 - transmittance behind the last Gaussian ``[H, W]`` in 0..1.
        means2d: Centers on the image ``[N, 2]`` in pixels; keeps its gradient when it has one.
        radii: Radius in pixels ``[N]``, 0 for Gaussians that are not drawn.
        color_channels: How many of the channels are color: 3 or 0.
        depth: Mean depth of what is seen ``[H, W]``, world units along the view axis, 0 where nothing is; only
            if asked for. It has no gradient.
    """

    channels: Tensor
    alpha: Tensor
    means2d: Tensor
    radii: Tensor
    color_channels: int
    depth: Tensor | None = None

    @property
    def image(self) -> Tensor:
        """RGB ``[H, W, 3]``; may exceed 1."""
        return self.channels[..., : self.color_channels]

    @property
    def features(self) -> Tensor:
        """Feature channels ``[H, W, C]``."""
        return self.channels[..., self.color_channels :]


@dataclass(frozen=True)
class PreparedView:
    """Projection and pairs of one view, for geometry that does not change.

    Args:
        backend: Who made it.
        projected: Means2d, conics, opacities, depths, radii, ... detached.
        pairs: The backend's lists of who touches which tile.
        camera: The camera it was made for.
    """

    backend: str
    projected: tuple[Tensor, ...]
    pairs: Any
    camera: Camera

    @property
    def nbytes(self) -> int:
        """Memory held."""
        tensors = sum(t.numel() * t.element_size() for t in self.projected)
        return tensors + int(self.pairs.nbytes)


def _module(gaussians: Gaussians, backend: Backend) -> Any:
    device = gaussians.device.type
    if backend not in ("auto", "cpu", "gsplat"):
        raise BackendError(f"rasterizer {backend!r}", expected="auto, cpu or gsplat")
    chosen = {"cpu": "cpu", "cuda": "gsplat"}.get(device) if backend == "auto" else backend
    if chosen is None or (chosen == "cpu") != (device == "cpu"):
        raise BackendError(
            f"rasterizer {backend!r}",
            expected="tensors on a CUDA device"
            if chosen == "gsplat"
            else "tensors on the CPU or a CUDA device",
            found=f"tensors on {device}",
            remedy="move the Gaussians or let the backend be chosen (auto)",
        )
    if chosen == "cpu":
        from lexsplat.rendering import cpu_backend

        return cpu_backend
    from lexsplat.rendering import gsplat_backend

    return gsplat_backend


def prepare(
    gaussians: Gaussians, camera: Camera, *, near: float = NEAR, backend: Backend = "auto"
) -> PreparedView:
    """Project and sort once, for many calls of `render` or `accumulate_codes` with the same geometry.

    The result knows nothing of later changes of the Gaussians and passes no gradients to their geometry.
    """
    module = _module(gaussians, backend)
    with torch.no_grad():
        projected = module.project(gaussians, camera, near)
        return PreparedView(module.__name__, projected, module.pairs_of(projected, camera), camera)


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    features: Tensor | None = None,
    color: bool = True,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    near: float = NEAR,
    depth: bool = False,
    viewmat: Tensor | None = None,
    prepared: PreparedView | None = None,
    backend: Backend = "auto",
) -> Rendering:
    """Render one view by front-to-back blending.

    Gradients of the feature channels reach ``features`` only: geometry, opacity and color are deaf to them, bit
    for bit. Gradients of RGB and alpha reach everything else.

    Args:
        gaussians: What to render; antialiased if it says so.
        camera: Where from, and the size of the image.
        features: Further channels ``[N, C]``, composited over zero.
        color: Whether to render RGB.
        sh_degree: Highest degree of spherical harmonics to use; all that are stored by default.
        background: RGB ``[3]`` behind the Gaussians; black by default.
        near: Gaussians nearer than this are not drawn, world units.
        depth: Also render the mean depth.
        viewmat: World to camera ``[4, 4]`` in place of the camera's own, for poses that get a gradient. It must be
            rigid, and its gradient is meant for rigid changes of it (rotation and translation).
        prepared: From `prepare` for the same Gaussians and camera; ``near`` is then that of `prepare`.
        backend: "auto" takes the CPU kernels for CPU tensors and gsplat for CUDA tensors.

    Raises:
        ValueError: If an argument has a wrong shape, or the prepared view is of another camera.
        BackendError: If the backend cannot render tensors of this device.
    """
    module = _module(gaussians, backend)
    count = len(gaussians)
    if features is not None and (features.ndim != 2 or len(features) != count):
        raise ValueError(f"features must be [{count}, C], got {list(features.shape)}")
    if background is not None and background.shape != (3,):
        raise ValueError(f"background must be [3], got {list(background.shape)}")
    if viewmat is not None:
        if viewmat.shape != (4, 4) or prepared is not None:
            raise ValueError("viewmat must be [4, 4] and does not go with a prepared view")
        viewmat = viewmat.to(gaussians.means)
        camera = posing.at_the_origin(camera)
    if prepared is None:
        body = gaussians if viewmat is None else posing.in_camera_frame(gaussians, viewmat)
        projected = module.project(body, camera, near)
        pairs = module.pairs_of(projected, camera)
    else:
        _check_prepared(prepared, module, gaussians, camera)
        projected, pairs = prepared.projected, prepared.pairs
    means2d, depths, radii = projected[0], projected[3], projected[4]
    if means2d.requires_grad:
        means2d.retain_grad()
    colors = None
    if color:
        stored = gaussians.sh_degree
        degree = stored if sh_degree is None else max(0, min(sh_degree, stored))
        colors = module.shade(*_to_shade(gaussians, camera, projected, viewmat), degree)
    extra = features
    if depth:
        column = depths[:, None]
        extra = column if features is None else torch.cat([features, column], 1)
    channels, alpha = module.blend(projected, pairs, colors, extra, background if color else None)
    mean_depth = None
    if depth:
        mean_depth = (channels[..., -1] / alpha.clamp_min(1e-8)).detach()
        channels = channels[..., :-1]
    if radii.ndim == 2:
        radii = radii.amax(-1)
    return Rendering(channels, alpha, means2d, radii, 3 if color else 0, mean_depth)


def _to_shade(
    gaussians: Gaussians, camera: Camera, projected: tuple[Tensor, ...], viewmat: Tensor | None
) -> tuple[Gaussians, Camera, tuple[Tensor, ...]]:
    """What the backends shade: where a pose has a gradient, the world around the camera, in the world's axes."""
    if viewmat is None:
        return gaussians, camera, projected
    around = posing.around_the_camera(gaussians, viewmat)
    # The CPU backend shades the means that the projection hands on; here they are in other axes.
    return around, camera, (*projected[:6], around.means)


def accumulate_codes(
    gaussians: Gaussians,
    camera: Camera,
    code_map: Tensor | NDArray[Any],
    num_codes: int,
    *,
    near: float = NEAR,
    prepared: PreparedView | None = None,
    out: Tensor | None = None,
    backend: Backend = "auto",
) -> Tensor:
    """Blending weight of each Gaussian at the pixels of each code: sum of alpha T over them.

    The gradient of rendered one-hot codes, without rendering them: one addition per pixel and Gaussian however
    many codes there are.

    Args:
        gaussians: The scene.
        camera: The view of the code map, of its size.
        code_map: Code of each pixel ``[H, W]``, integers below ``num_codes``. Negative pixels are left out, and
            255 where ``num_codes`` <= 255.
        num_codes: K.
        near: See `render`.
        prepared: See `render`.
        out: Where to add to ``[N, K]`` float32, for sums over views without a copy; zeros by default.
        backend: See `render`.

    Returns:
        Weights ``[N, K]`` in pixels: ``out`` if it was given.

    Raises:
        ValueError: If the map has another size than the camera, or a code out of range.
    """
    module = _module(gaussians, backend)
    codes = np.asarray(code_map.cpu() if isinstance(code_map, Tensor) else code_map)
    if codes.shape != (camera.height, camera.width) or not np.issubdtype(codes.dtype, np.integer):
        raise ValueError(
            f"code_map must be integer [{camera.height}, {camera.width}], got {codes.dtype} {list(codes.shape)}"
        )
    highest = int(codes.max(initial=0, where=codes != IGNORED_CODE if num_codes <= IGNORED_CODE else True))
    if num_codes < 1 or highest >= num_codes:
        raise ValueError(f"codes must be below {num_codes}, got {highest}")
    # Only now: a number of 64 bits would wrap around to a code.
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
        prepared = prepare(gaussians, camera, near=near, backend=backend)
    _check_prepared(prepared, module, gaussians, camera)
    with torch.no_grad():
        module.accumulate_codes(prepared.projected, prepared.pairs, codes, num_codes, out)
    return out


def back_project(gaussians: Gaussians, camera: Camera, values: Tensor, prepared: PreparedView) -> Tensor:
    """A map spread over the Gaussians by their blending weights, the transpose of rendering: sum of alpha T values.

    Rendering is linear in what the Gaussians carry, so this is its gradient; `SPREAD_CHANNELS` are taken at a time.

    Args:
        gaussians: The scene.
        camera: The view of the map, of its size.
        values: ``[H, W, C]``, on the device of the Gaussians.
        prepared: See `render`.

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


def accumulate_weights(gaussians: Gaussians, camera: Camera, **options: Any) -> Tensor:
    """Blending weight of each Gaussian over the whole view ``[N]``, in pixels; options as in `accumulate_codes`."""
    everywhere = np.zeros((camera.height, camera.width), np.int32)
    return accumulate_codes(gaussians, camera, everywhere, 1, **options)[:, 0]


def _check_prepared(prepared: PreparedView, module: Any, gaussians: Gaussians, camera: Camera) -> None:
    same_camera = prepared.camera is camera or (
        (prepared.camera.width, prepared.camera.height) == (camera.width, camera.height)
        and np.array_equal(prepared.camera.K, camera.K)
        and np.array_equal(prepared.camera.viewmat, camera.viewmat)
    )
    if not same_camera or len(prepared.projected[0]) != len(gaussians) or prepared.backend != module.__name__:
        raise ValueError("the prepared view is of another camera, scene or backend")
