"""Reference rendering in float64: one Gaussian after another over all pixels, with gradients by torch autograd.

It implements the equations independently of the kernels, without tiles, boxes or fused operations.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")


def to_float64(gaussians: Gaussians) -> dict[str, Tensor]:
    """Leaves with gradients, by field name."""
    return {k: v.detach().double().requires_grad_() for k, v in gaussians.tensors().items()}


def rotation_matrices(quats: Tensor) -> Tensor:
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def project(
    p: dict[str, Tensor], camera: Camera, antialiased: bool, near: float = 0.01, viewmat: Tensor | None = None
) -> dict[str, Tensor]:
    view = torch.from_numpy(camera.viewmat) if viewmat is None else viewmat
    K = camera.K
    at = p["means"] @ view[:3, :3].T + view[:3, 3]
    x, y, z = at.unbind(-1)
    z = torch.where(z >= near, z, torch.ones_like(z))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    sx = (x / z).clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    sy = (y / z).clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * sx / z, zero, fy / z, -fy * sy / z], -1).reshape(-1, 2, 3)
    factor = jacobian @ view[:3, :3] @ rotation_matrices(p["quats"]) @ torch.diag_embed(p["log_scales"].exp())
    covariance = factor @ factor.transpose(1, 2)
    blurred = covariance + 0.3 * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(blurred)
    opacity = p["opacity_logits"].sigmoid()
    if antialiased:
        opacity = opacity * (torch.linalg.det(covariance) / torch.linalg.det(blurred)).clamp_min(0).sqrt()
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    return {"means2d": means2d, "conic": conic, "opacity": opacity, "depth": at[:, 2]}


def shade(p: dict[str, Tensor], camera: Camera, degree: int, viewmat: Tensor | None = None) -> Tensor:
    """RGB [N, 3]; the polynomials are those of gsplat's torch function."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    view = torch.from_numpy(camera.viewmat) if viewmat is None else viewmat
    direction = p["means"] + view[:3, :3].T @ view[:3, 3]
    return (_spherical_harmonics(degree, direction, torch.cat([p["sh0"], p["shN"]], 1)) + 0.5).clamp_min(0)


def blend(
    projected: dict[str, Tensor], values: Tensor, camera: Camera, near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Channels [H, W, C], alpha [H, W], the weight of each Gaussian at each pixel [N, H, W], and clear [H, W].

    A pixel is clear if none of its comparisons (threshold, clamp, termination) is so close that float32 could decide
    differently.
    """
    ys, xs = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack([xs, ys], -1).double()
    transmittance = torch.ones(camera.height, camera.width, dtype=torch.float64)
    done = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    clear = ~done
    image = torch.zeros(camera.height, camera.width, values.shape[1], dtype=torch.float64)
    weights: list[Tensor] = [torch.zeros_like(transmittance)] * len(values)
    depth = projected["depth"].detach()
    for n in torch.argsort(depth.float(), stable=True).tolist():
        if depth[n] < near:
            continue
        offset = pixels - projected["means2d"][n]
        power = 0.5 * torch.einsum("hwi,ij,hwj->hw", offset, projected["conic"][n], offset)
        alpha = projected["opacity"][n] * torch.exp(-power)
        for decision in (1 / 255, 0.999):
            clear &= (alpha.detach() / decision - 1).abs() > 2e-5
        alpha = alpha.clamp_max(0.999)
        alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
        after = transmittance * (1 - alpha)
        clear &= done | ((after.detach() / 1e-4 - 1).abs() > 1e-3)
        done = done | (after <= 1e-4)
        weight = torch.where(done, torch.zeros_like(alpha), alpha * transmittance)
        transmittance = torch.where(done, transmittance, after)
        image = image + weight[..., None] * values[n]
        weights[n] = weight
    return image, 1 - transmittance, torch.stack(weights), clear


def render(
    p: dict[str, Tensor],
    camera: Camera,
    *,
    antialiased: bool,
    degree: int,
    background: Tensor | None = None,
    viewmat: Tensor | None = None,
) -> dict[str, Tensor]:
    """Image over the background, alpha, weights and clear pixels; from ``viewmat`` if it is given."""
    projected = project(p, camera, antialiased, viewmat=viewmat)
    image, alpha, weights, clear = blend(projected, shade(p, camera, degree, viewmat), camera)
    if background is not None:
        image = image + (1 - alpha)[..., None] * background
    return {"image": image, "alpha": alpha, "weights": weights, "clear": clear, **projected}


def random_gaussians(
    count: int, seed: int, *, degree: int = 3, antialiased: bool = False, scale: float = 0.15
) -> Gaussians:
    """Random Gaussians around the origin, of standard deviations around ``scale``, some nearly opaque."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    return Gaussians(
        means=0.8 * normal(count, 3),
        quats=normal(count, 4),
        log_scales=math.log(scale) + 0.5 * normal(count, 3),
        opacity_logits=2 * normal(count),
        sh0=normal(count, 1, 3),
        shN=0.3 * normal(count, (degree + 1) ** 2 - 1, 3),
        antialiased=antialiased,
    )


def front_camera(width: int = 50, height: int = 37) -> Camera:
    """A camera slightly off the axis, so that the view is not symmetric."""
    return look_at(
        np.array([0.4, -0.3, -3.0]),
        np.array([0.05, 0.0, 0.0]),
        np.array([0.1, -1.0, 0.0]),
        width,
        height,
        0.8,
    )


def with_gradients(gaussians: Gaussians) -> Gaussians:
    return gaussians.map(lambda t: t.clone().requires_grad_())


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found.double() - expected).norm() / expected.norm().clamp_min(1e-12))
