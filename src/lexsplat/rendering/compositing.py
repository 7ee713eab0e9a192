"""Front-to-back blending of one view: color, features, alpha and depth."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import backends, posing
from lexsplat.rendering.results import PreparedView, Projection, Rendering

NEAR = 0.01
"""Default distance of the near plane in world units; Gaussians in front of it are not drawn."""


def prepare(gaussians: Gaussians, camera: Camera) -> PreparedView:
    """Project and sort once, for many calls of `render` or `back_project` with the same geometry.

    The result does not follow later changes of the Gaussians and passes no gradients to their geometry.

    Args:
        gaussians: The scene.
        camera: The view.
    """
    module = backends.backend_for(gaussians)
    with torch.no_grad():
        projection = module.project(gaussians, camera, NEAR)
        return PreparedView(module.__name__, projection, module.find_tiles(projection, camera), camera)


# Ten parameters: independent options of one operation, of which a call names one or two.
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
) -> Rendering:
    """Render one view by front-to-back blending, on the device of the Gaussians.

    Gradients of the feature channels reach ``features`` only; geometry, opacity and color are detached from them, bit
    for bit. Gradients of RGB and alpha reach everything else.

    Args:
        gaussians: The scene; rendered with the mip filter if it is antialiased.
        camera: The view, with the size of the image.
        features: Further channels ``[N, C]``, composited over zero.
        color: Whether to render RGB.
        sh_degree: Highest degree of spherical harmonics to use; default is all that are stored.
        background: RGB ``[3]`` behind the Gaussians; default is black.
        near: Distance of the near plane in world units; Gaussians in front of it are not drawn.
        depth: Whether to render the mean depth.
        viewmat: World to camera ``[4, 4]`` that replaces the camera's own and receives a gradient. It must be rigid,
            and its gradient is valid for rigid changes (rotation and translation).
        prepared: From `prepare` for the same Gaussians and camera; ``near`` is then `NEAR`.

    Raises:
        ValueError: If an argument has a wrong shape, or the prepared view belongs to another camera.
        BackendError: If there is no rasterizer for the device.
    """
    module = backends.backend_for(gaussians)
    _check_shapes(len(gaussians), features, background)
    posed = gaussians
    if viewmat is not None:
        if viewmat.shape != (4, 4) or prepared is not None:
            raise ValueError("viewmat must be [4, 4] and cannot be combined with a prepared view")
        viewmat = viewmat.to(gaussians.means)
        camera, posed = replace(camera, viewmat=np.eye(4)), posing.in_camera_frame(gaussians, viewmat)
    if prepared is None:
        projection: Projection = module.project(posed, camera, near)
        pairs = module.find_tiles(projection, camera)
    else:
        check_prepared(prepared, module, gaussians, camera)
        projection, pairs = prepared.projection, prepared.pairs
    if projection.means2d.requires_grad:
        projection.means2d.retain_grad()
    colors = None
    if color:
        degree = gaussians.sh_degree if sh_degree is None else max(0, min(sh_degree, gaussians.sh_degree))
        shaded, seen = gaussians, projection
        if viewmat is not None:
            # Colors depend on directions in the world, and the projection is in camera axes.
            shaded = posing.around_the_camera(gaussians, viewmat)
            seen = replace(projection, means=shaded.means)
        colors = module.shade(shaded, camera, seen, degree)
    if depth:
        column = projection.depths[:, None]
        features = column if features is None else torch.cat([features, column], 1)
    channels, alpha = module.blend(projection, pairs, colors, features, background if color else None)
    mean_depth = None
    if depth:
        mean_depth = (channels[..., -1] / alpha.clamp_min(1e-8)).detach()
        channels = channels[..., :-1]
    radii = projection.radii if projection.radii.ndim == 1 else projection.radii.amax(-1)
    return Rendering(channels, alpha, projection.means2d, radii, 3 if color else 0, mean_depth)


def _check_shapes(count: int, features: Tensor | None, background: Tensor | None) -> None:
    if features is not None and (features.ndim != 2 or len(features) != count):
        raise ValueError(f"features must be [{count}, C], got {list(features.shape)}")
    if background is not None and background.shape != (3,):
        raise ValueError(f"background must be [3], got {list(background.shape)}")


def check_prepared(prepared: PreparedView, module: ModuleType, gaussians: Gaussians, camera: Camera) -> None:
    """Refuse a prepared view of another camera, number of Gaussians or backend.

    Raises:
        ValueError: If it does not belong to the arguments.
    """
    same_camera = prepared.camera is camera or (
        (prepared.camera.width, prepared.camera.height) == (camera.width, camera.height)
        and np.array_equal(prepared.camera.K, camera.K)
        and np.array_equal(prepared.camera.viewmat, camera.viewmat)
    )
    same_scene = len(prepared.projection.means2d) == len(gaussians)
    if not same_camera or not same_scene or prepared.backend != module.__name__:
        raise ValueError("the prepared view belongs to another camera, scene or backend")
