"""A CPU replacement of gsplat 1.5.3's CUDA extension, used by gsplat's own Python code.

gsplat's Python code does not run without its extension, and its torch functions accept what the extension refuses
or leaves uninitialized: channel counts, shared memory, culled Gaussians, no Gaussians. A double of whole gsplat
functions would show neither these nor the arguments and gradients that pass through gsplat's own code.

It follows the sources (gsplat/cuda/csrc): thresholds and checks of inputs are the same, and memory that is
uninitialized there is NaN here. Gradients are computed by torch's autograd through gsplat's torch functions or, for
blending, through the forward pass in this file. Tensors are either all on the CPU or all pretended
(`pretended_gpu`); a mixture is refused, as by ``CHECK_CUDA``.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils._mode_utils import no_dispatch

from support.pretended_gpu import PretendedTensor, inner, wrapped

TILE_CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513)
"""Channel counts that the kernels are compiled for."""
SHARED_MEMORY = 64 << 10
"""Shared memory per block in bytes on the smallest supported devices (compute capability 7.5)."""
ALPHA_THRESHOLD, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4


def install(monkeypatch: Any) -> None:
    """Install the replacement where gsplat looks for its extension."""
    backend = ModuleType("gsplat.cuda._backend")  # the real module would try to compile the extension
    backend._C = Extension()
    monkeypatch.setitem(sys.modules, backend.__name__, backend)


def taken(*tensors: Tensor | None, names: str = "") -> tuple[Any, ...]:
    """Unwrap the inputs to CPU tensors, after the same checks as in the extension."""
    given = [tensor for tensor in tensors if tensor is not None]
    if len({isinstance(tensor, PretendedTensor) for tensor in given}) > 1:
        raise RuntimeError("an input must be a CUDA tensor")
    if not all(tensor.is_contiguous() for tensor in given):
        raise RuntimeError("an input must be contiguous")
    if not all(tensor.dtype in (torch.float32, torch.int32, torch.int64, torch.bool) for tensor in given):
        raise RuntimeError("expected scalar type Float")
    return tuple(None if tensor is None else inner(tensor).detach() for tensor in tensors)


def compiled(kernels: type) -> type:
    """A class whose functions are to the pretended GPU as compiled code: none of their operations is looked at."""

    def hidden(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def run(*args: Any) -> Any:
            with no_dispatch():
                return function(*args)

        return run

    for name, member in list(vars(kernels).items()):
        if callable(member) and not name.startswith("_"):
            setattr(kernels, name, hidden(member))
    return kernels


@compiled
class Extension:
    """The functions of the extension that rendering and density control call."""

    CameraModelType = None
    PINHOLE = "pinhole"  # the attribute that gsplat reads; its value is not used

    def projection_ewa_3dgs_fused_fwd(
        self, means, covars, quats, scales, opacities, viewmats, Ks,
        width, height, eps2d, near, far, radius_clip, calc_compensations, model,
    ):  # fmt: skip
        assert covars is None
        assert radius_clip == 0.0
        assert model == self.PINHOLE
        dress = type_of(means)
        means, quats, scales, opacities, viewmats, Ks = taken(means, quats, scales, opacities, viewmats, Ks)
        _not_empty(means)
        radii, means2d, depths, conics, compensations = project(
            means, quats, scales, viewmats, Ks, width, height, eps2d
        )
        radii = torch.zeros_like(radii)
        variances = torch.stack([conics[..., 2], conics[..., 0]], -1)
        variances = variances / (conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2)[..., None]
        seen = (depths >= near) & (depths <= far)
        extend = torch.full_like(depths, 3.33)
        if opacities is not None:
            opacities = opacities * compensations if calc_compensations else opacities[None]
            seen &= opacities >= ALPHA_THRESHOLD
            extend = extend.minimum((2 * (opacities / ALPHA_THRESHOLD).clamp_min(1).log()).sqrt())
        reach = (extend[..., None] * variances.sqrt()).ceil()
        size = torch.tensor([width, height])
        seen &= (reach > 0).any(-1) & (means2d + reach > 0).all(-1) & (means2d - reach < size).all(-1)
        radii[seen] = reach[seen].int()
        for values in (means2d, depths, conics):  # from at::empty, never written
            values[~seen] = torch.nan
        compensations[~seen] = 0.0  # from at::zeros
        return dress(radii, means2d, depths, conics, compensations if calc_compensations else None)

    def projection_ewa_3dgs_fused_bwd(
        self, means, covars, quats, scales, viewmats, Ks, width, height, eps2d, model, radii, conics,
        compensations, v_means2d, v_depths, v_conics, v_compensations, viewmats_requires_grad,
    ):  # fmt: skip
        dress = type_of(means)
        means, quats, scales, viewmats, Ks, radii, _, _, *given = taken(
            means, quats, scales, viewmats, Ks, radii, conics, compensations,
            v_means2d, v_depths, v_conics, v_compensations,
        )  # fmt: skip
        seen = (radii[0] > 0).all(-1)
        leaves = [t[seen].requires_grad_() for t in (means, quats, scales)] + [
            viewmats.clone().requires_grad_()
        ]
        with torch.enable_grad():
            _, means2d, depths, conics, found = project(*leaves, Ks, width, height, eps2d)
        outputs = [means2d, depths, conics, found]
        pairs = [(out, v[:, seen]) for out, v in zip(outputs, given, strict=True) if v is not None]
        gradients = torch.autograd.grad(
            [p[0] for p in pairs], leaves, [p[1] for p in pairs], allow_unused=True
        )
        results = []
        for whole, gradient in zip((means, quats, scales), gradients):
            results.append(torch.zeros_like(whole))
            results[-1][seen] = gradient
        v_means, v_quats, v_scales = results
        return dress(v_means, None, v_quats, v_scales, gradients[3] if viewmats_requires_grad else None)

    def intersect_tile(
        self, means2d, radii, depths, image_ids, gaussian_ids, images, tile, columns, rows, sort, segmented
    ):
        assert image_ids is None
        assert images == 1
        dress = type_of(means2d)
        means2d, radii, depths = taken(means2d, radii, depths)
        assert radii.dtype == torch.int32
        means2d, radii, depths = means2d[0], radii[0].float(), depths[0]
        seen = (radii > 0).all(-1)
        limits = torch.tensor([columns, rows])
        places = torch.where(seen[:, None], means2d, torch.zeros_like(means2d)) / tile
        first = (places - radii / tile).floor().long().clamp_min(0).minimum(limits)
        last = (places + radii / tile).ceil().long().clamp_min(0).minimum(limits)
        sides = (last - first) * seen[:, None]
        counts = sides.prod(-1)
        members = torch.repeat_interleave(torch.arange(len(counts)), counts)
        place = torch.arange(len(members)) - (counts.cumsum(0) - counts)[members]
        across = sides[members, 0]
        tiles = (first[members, 1] + place // across) * columns + first[members, 0] + place % across
        keys = (tiles << 32) | depths.view(torch.int32)[members].long()
        if sort:
            keys, order = keys.sort(stable=True)
            members = members[order]
        return dress(counts.int()[None], keys, members.int())

    def intersect_offset(self, keys, images, columns, rows):
        dress = type_of(keys)
        (keys,) = taken(keys)
        starts = torch.searchsorted(keys >> 32, torch.arange(rows * columns))
        return dress(starts.int().reshape(images, rows, columns))[0]

    def spherical_harmonics_fwd(self, degree, dirs, coeffs, masks):
        dress = type_of(dirs)
        dirs, coeffs, masks = taken(dirs, coeffs, masks)
        colors = harmonics(degree, dirs, coeffs)
        if masks is not None:
            colors[~masks] = torch.nan  # from at::empty_like, never written
        return dress(colors)[0]

    def spherical_harmonics_bwd(self, bases, degree, dirs, coeffs, masks, v_colors, compute_v_dirs):
        dress = type_of(dirs)
        dirs, coeffs, masks, v_colors = taken(dirs, coeffs, masks, v_colors)
        assert bases == coeffs.shape[-2]
        seen = torch.ones(len(dirs), dtype=torch.bool) if masks is None else masks
        leaves = [dirs[seen].requires_grad_(), coeffs[seen].requires_grad_()]
        with torch.enable_grad():
            colors = harmonics(degree, *leaves)
        gradients = torch.autograd.grad(colors, leaves, v_colors[seen], allow_unused=True)
        v_dirs, v_coeffs = torch.zeros_like(dirs), torch.zeros_like(coeffs)
        v_coeffs[seen] = gradients[1]
        if gradients[0] is not None:
            v_dirs[seen] = gradients[0]
        return dress(v_coeffs, v_dirs if compute_v_dirs else None)

    def rasterize_to_pixels_3dgs_fwd(
        self, means2d, conics, colors, opacities, backgrounds, masks, width, height, tile, offsets, members
    ):
        assert masks is None
        dress = type_of(means2d)
        if colors.shape[-1] not in TILE_CHANNELS:
            raise RuntimeError(f"Unsupported number of channels: {colors.shape[-1]}")
        means2d, conics, colors, opacities, background, offsets, members = taken(
            means2d, conics, colors, opacities, backgrounds, offsets, members
        )
        image, alpha = blend(
            means2d, conics, colors, opacities, background, width, height, tile, offsets, members
        )
        return dress(image, alpha, torch.zeros(1, height, width, dtype=torch.int32))

    def rasterize_to_pixels_3dgs_bwd(
        self, means2d, conics, colors, opacities, backgrounds, masks, width, height, tile, offsets, members,
        render_alphas, last_ids, v_colors, v_alphas, absgrad,
    ):  # fmt: skip
        dress = type_of(means2d)
        wanted = tile * tile * (28 + 4 * colors.shape[-1])
        if wanted > SHARED_MEMORY:
            raise RuntimeError(f"Failed to set maximum shared memory size (requested {wanted} bytes)")
        means2d, conics, colors, opacities, background, offsets, members, _, _, v_colors, v_alphas = taken(
            means2d, conics, colors, opacities, backgrounds, offsets, members,
            render_alphas, last_ids, v_colors, v_alphas,
        )  # fmt: skip
        leaves = [t.clone().requires_grad_() for t in (means2d, conics, colors, opacities)]
        with torch.enable_grad():
            found = blend(*leaves, background, width, height, tile, offsets, members)
            # If the tile is empty, no input requires gradients.
            found = tuple(part + 0 * sum(leaf.flatten()[:0].sum() for leaf in leaves) for part in found)
        gradients = torch.autograd.grad(found, leaves, (v_colors, v_alphas))
        return dress(None, *gradients)

    def relocation(self, opacities, scales, ratios, binoms, n_max):
        dress = type_of(opacities)
        opacities, scales, ratios, binoms = taken(opacities, scales, ratios, binoms)
        assert ratios.dtype == torch.int32
        assert binoms.shape == (n_max, n_max)
        new = 1 - (1 - opacities) ** (1 / ratios)
        k = torch.arange(n_max)
        terms = (-1.0) ** k / (k + 1).sqrt() * new[:, None] ** (k + 1)
        total = (binoms.cumsum(0)[ratios.long() - 1] * terms).sum(1)  # over i <= ratio and k < i
        return dress(new, (opacities / total)[:, None] * scales)

    def quat_scale_to_covar_preci_fwd(self, quats, scales, compute_covar, compute_preci, triu):
        from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

        assert not compute_preci
        dress = type_of(quats)
        return dress(*_quat_scale_to_covar_preci(*taken(quats, scales), compute_covar, False, triu))


def type_of(example: Tensor) -> Any:
    """Function that moves results to the device of an input."""
    on_gpu = isinstance(example, PretendedTensor)
    return lambda *results: tuple(wrapped(result) if on_gpu else result for result in results)


def _not_empty(means: Tensor) -> None:
    """``B = means.numel() / (N * 3)`` in integers: zero Gaussians would terminate the process."""
    if not len(means):
        raise SystemError("SIGFPE: gsplat divides by the number of Gaussians")


def project(means, quats, scales, viewmats, Ks, width, height, eps2d):
    """gsplat's torch function: radii, means2d, depths, conics and compensations, with a leading dimension of 1."""
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    covariances, _ = _quat_scale_to_covar_preci(quats, scales, True, False, False)
    return _fully_fused_projection(
        means, covariances, viewmats, Ks, width, height, eps2d, calc_compensations=True
    )


def harmonics(degree: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """gsplat's torch function for spherical harmonics."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    return _spherical_harmonics(degree, dirs, coeffs)


def blend(means2d, conics, colors, opacities, background, width, height, tile, offsets, members):
    """Front-to-back blending of one image by tiles: ``[1, H, W, C]`` and alpha ``[1, H, W, 1]``."""
    rows, columns = offsets.shape[1:]
    starts = [*offsets.flatten().tolist(), len(members)]
    ys, xs = torch.meshgrid(torch.arange(tile) + 0.5, torch.arange(tile) + 0.5, indexing="ij")
    strips = []
    for row in range(rows):
        tiles = []
        for column in range(columns):
            start, stop = starts[row * columns + column : row * columns + column + 2]
            k = members[start:stop].long()
            x, y = (xs + column * tile).flatten(), (ys + row * tile).flatten()
            dx, dy = means2d[0, k, 0, None] - x, means2d[0, k, 1, None] - y
            a, b, c = conics[0, k].T[..., None]
            sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
            alpha = (opacities[0, k, None] * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
            alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_THRESHOLD), alpha, torch.zeros_like(alpha))
            stopped = (1 - alpha.detach()).cumprod(0) <= TRANSMITTANCE_MIN
            alpha = torch.where(stopped, torch.zeros_like(alpha), alpha)
            left = torch.cat([torch.ones(1, tile * tile), (1 - alpha).cumprod(0)])
            image = (alpha * left[:-1]).T @ colors[0, k]
            if background is not None:
                image = image + left[-1][:, None] * background[0]
            tiles.append(torch.cat([image, 1 - left[-1][:, None]], -1).unflatten(0, (tile, tile)))
        strips.append(torch.cat(tiles, 1))
    whole = torch.cat(strips, 0)[:height, :width]
    return whole[None, ..., :-1].contiguous(), whole[None, ..., -1:].contiguous()
