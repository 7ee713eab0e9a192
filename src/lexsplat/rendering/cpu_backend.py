"""The CPU rasterizer as autograd functions: projection, shading, tile pairs and blending with their gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering.cell_weights import weigh_cells
from lexsplat.rendering.kernels import blending, gradients, projection, spherical_harmonics
from lexsplat.rendering.kernels.jit import parallel
from lexsplat.rendering.pairs import GRAIN, TILE_GRAIN, TilePairs, find_pairs
from lexsplat.rendering.results import Projection

__all__ = ["blend", "find_tiles", "project", "shade", "weigh_cells"]


def camera_vector(camera: Camera, near: float) -> NDArray[np.float64]:
    """The camera in the layout of the projection kernels: rotation, translation, intrinsics, size, near plane."""
    K, viewmat = camera.K, camera.viewmat
    intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height, near]
    return np.concatenate([viewmat[:3, :3].ravel(), viewmat[:3, 3], intrinsics])


def _array(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().contiguous().numpy()


def _zeros(*shape: int) -> Tensor:
    """Zeros from fresh pages; ``torch.zeros`` would start torch's threads, which then compete with ours."""
    return torch.from_numpy(np.zeros(shape, np.float32))


class _Project(torch.autograd.Function):
    """(means, quats, log_scales, opacity_logits) -> (means2d, conics, opacities, depths, radii, extents, means).

    The means are also an output, which shading reads, so that both of their gradients meet in the backward kernel.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, camera, antialiased = inputs
        count = len(tensors[0])
        shapes = ((count, 2), (count, 3), (count,), (count,), (count,), (count, 2))
        outputs = [
            torch.empty(s, dtype=torch.int32 if i == 4 else torch.float32) for i, s in enumerate(shapes)
        ]
        arrays = [_array(t) for t in (*tensors, *outputs)]
        parallel(projection.project, count, GRAIN, *arrays[:4], camera, antialiased, *arrays[4:])
        ctx.camera, ctx.antialiased = camera, antialiased
        ctx.save_for_backward(*tensors, outputs[4])
        ctx.mark_non_differentiable(*outputs[3:])
        ctx.set_materialize_grads(False)
        return (*outputs, tensors[0].detach())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> tuple[Any, ...]:
        *tensors, radii = ctx.saved_tensors
        outputs = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in tensors]
        shapes = ((len(radii), 2), (len(radii), 3), (len(radii),), (len(radii), 3))
        given = (*grads[:3], grads[6])
        incoming = [_array(_zeros(*shape) if g is None else g) for g, shape in zip(given, shapes)]
        parallel(
            projection.project_backward, len(radii), GRAIN,
            *[_array(t) for t in tensors], ctx.camera, ctx.antialiased, _array(radii),
            *incoming, *[_array(t) for t in outputs],
        )  # fmt: skip
        return (*outputs, None, None)


class _Shade(torch.autograd.Function):
    """(means, sh0, shN) -> colors ``[N, 3]`` of the visible Gaussians."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, sh0: Tensor, shN: Tensor, *constants: Any) -> Tensor:
        radii, eye, degree = constants
        colors = torch.empty(len(means), 3)
        arrays = [_array(t) for t in (means, sh0, shN, radii, colors)]
        parallel(spherical_harmonics.shade, len(means), GRAIN, degree, arrays[0], eye, *arrays[1:])
        ctx.eye, ctx.degree = eye, degree
        ctx.save_for_backward(means, shN, radii, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        means, shN, radii, colors = ctx.saved_tensors
        outputs = torch.empty_like(means), torch.empty(len(means), 1, 3), torch.empty(shN.shape)
        arrays = [_array(t) for t in (means, shN, radii, colors, grads[0], *outputs)]
        parallel(
            spherical_harmonics.shade_backward, len(means), GRAIN, ctx.degree, arrays[0], ctx.eye, *arrays[1:]
        )
        return (*outputs, None, None, None)


class _Blend(torch.autograd.Function):
    """(means2d, conics, opacities, colors, features, background) -> (channels [H, W, C], alpha [H, W]).

    The geometry is read from the pairs; the first three tensors only receive its gradients. Gradients of colors and
    alpha reach the geometry, gradients of features do not.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        *tensors, pairs = inputs
        colors, features, background = tensors[3:]
        image = torch.empty(pairs.height, pairs.width, _channels(colors) + _channels(features))
        alpha = torch.empty(pairs.height, pairs.width)
        values = _gather(pairs, colors, features)
        kept = pairs.tiles * blending.PIXELS if any(ctx.needs_input_grad) else 0
        ctx.passed, ctx.last_pairs = np.empty(kept, np.float32), np.empty(kept, np.float32)
        parallel(
            blending.blend, pairs.tiles, TILE_GRAIN,
            pairs.ellipses, pairs.tile_offsets, pairs.members, pairs.rows, values, _behind(background),
            pairs.tiles_x, _array(image), _array(alpha), ctx.passed, ctx.last_pairs,
        )  # fmt: skip
        ctx.pairs = pairs
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(alpha, colors, features, background)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> tuple[Any, ...]:
        grad_image, grad_alpha = grads
        alpha, colors, features, background = ctx.saved_tensors
        pairs: TilePairs = ctx.pairs
        visible, color_channels = len(pairs.order), _channels(colors)
        channels = color_channels + _channels(features)
        geometry = any(ctx.needs_input_grad[:3])
        grad_image = _zeros(*alpha.shape, channels) if grad_image is None else grad_image
        grad_alpha = _zeros(*alpha.shape) if grad_alpha is None else grad_alpha
        values = _gather(pairs, colors, features)
        listed = int(
            pairs.pair_offsets[-1]
        )  # more than are drawn in a narrowed view, whose other rows stay 0
        rows = (np.empty if listed == len(pairs.members) else np.zeros)(
            listed * gradients.row_width(channels), np.float32
        )
        parallel(
            gradients.blend_backward, pairs.tiles, TILE_GRAIN,
            pairs.ellipses, pairs.tile_offsets, pairs.members, pairs.pairs, pairs.rows, values,
            _behind(background), pairs.tiles_x, color_channels, geometry, ctx.passed, ctx.last_pairs,
            _array(grad_image), _array(grad_alpha), rows,
        )  # fmt: skip
        count = pairs.count if geometry else 0
        shapes = (
            (count, 2),
            (count, 3),
            (count,),
            (pairs.count, color_channels),
            (pairs.count, _channels(features)),
        )
        outputs = [_zeros(*shape) for shape in shapes]
        parallel(
            gradients.sum_pairs, visible, GRAIN,
            pairs.order, pairs.ellipses, pairs.pair_offsets, rows, geometry, color_channels,
            *[_array(t) for t in outputs],
        )  # fmt: skip
        grad_background = None
        if ctx.needs_input_grad[5]:
            # NumPy sums on one thread: torch's order of addition depends on the number of threads.
            factors = _array(grad_image[..., :color_channels]), _array(1 - alpha)
            total = np.einsum("hwc,hw->c", *factors, dtype=np.float64)
            grad_background = torch.from_numpy(total.astype(np.float32))
        wanted = [g if ctx.needs_input_grad[i] else None for i, g in enumerate(outputs)]
        return (*wanted, grad_background, None)


def _behind(background: Tensor | None) -> NDArray[np.float32]:
    return np.zeros(0, np.float32) if background is None else _array(background)


def _channels(values: Tensor | None) -> int:
    return 0 if values is None else values.shape[1]


def _gather(pairs: TilePairs, *sources: Tensor | None) -> NDArray[np.float32]:
    visible = len(pairs.order)
    values = np.empty((visible, sum(_channels(s) for s in sources)), np.float32)
    column = 0
    for source in sources:
        if source is not None:
            parallel(gradients.gather, visible, GRAIN, pairs.order, _array(source), column, values)
            column += source.shape[1]
    return values


def project(gaussians: Gaussians, camera: Camera, near: float) -> Projection:
    """Project every Gaussian; means2d, conics, opacities and means have gradients."""
    g = gaussians
    tensors = (g.means, g.quats, g.log_scales, g.opacity_logits)
    means2d, conics, opacities, depths, radii, extents, means = _Project.apply(
        *tensors, camera_vector(camera, near), g.antialiased
    )
    return Projection(
        means2d=means2d,
        conics=conics,
        opacities=opacities,
        depths=depths,
        radii=radii,
        extents=extents,
        means=means,
    )


def find_tiles(projection: Projection, camera: Camera) -> TilePairs:
    """The (tile, Gaussian) pairs of a projection, sorted by depth."""
    return find_pairs(projection, camera.width, camera.height)


def shade(gaussians: Gaussians, camera: Camera, projection: Projection, degree: int) -> Tensor:
    """RGB ``[N, 3]`` of the visible Gaussians as seen from the camera: max(0, SH + 0.5)."""
    eye = np.ascontiguousarray(camera.position)
    return _Shade.apply(projection.means, gaussians.sh0, gaussians.shN, projection.radii, eye, degree)


def blend(
    projection: Projection,
    pairs: TilePairs,
    colors: Tensor | None,
    features: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Blend front to back.

    Args:
        projection: Receives the gradients of the geometry.
        pairs: From `find_tiles`.
        colors: RGB ``[N, 3]``; None renders none.
        features: Further channels ``[N, C]``; None renders none.
        background: RGB ``[3]`` behind the colors; None is black.

    Returns:
        Channels ``[H, W, 3 + C]`` and alpha ``[H, W]``.
    """
    p = projection
    return _Blend.apply(p.means2d, p.conics, p.opacities, colors, features, background, pairs)
