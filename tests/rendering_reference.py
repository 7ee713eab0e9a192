"""Rendering by definition: float64, one Gaussian after another over all pixels, gradients by torch autograd.

Written from the equations, not from the kernels: no tiles, no boxes, no fused anything.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from lexsplat.cameras import Camera
from lexsplat.gaussians import Gaussians


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


def project(p: dict[str, Tensor], camera: Camera, antialiased: bool, near: float = 0.01) -> dict[str, Tensor]:
    view = torch.from_numpy(camera.viewmat)
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


def spherical_harmonics(direction: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics by associated Legendre functions (scipy's complex ones), no gradient."""
    from scipy.special import sph_harm_y

    d = (direction / direction.norm(dim=-1, keepdim=True)).detach().numpy()
    theta, phi = np.arccos(np.clip(d[:, 2], -1, 1)), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            value = sph_harm_y(l, abs(m), theta, phi)
            if m == 0:
                columns.append(value.real)
            else:
                columns.append(math.sqrt(2) * (value.imag if m < 0 else value.real))
    return torch.from_numpy(np.stack(columns, -1))


def blend(
    projected: dict[str, Tensor], values: Tensor, camera: Camera, near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    """Channels [H, W, C], alpha [H, W] and the weight of each Gaussian at each pixel [N, H, W]."""
    ys, xs = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack([xs, ys], -1).double()
    transmittance = torch.ones(camera.height, camera.width, dtype=torch.float64)
    done = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    image = torch.zeros(camera.height, camera.width, values.shape[1], dtype=torch.float64)
    weights: list[Tensor] = [torch.zeros_like(transmittance)] * len(values)
    depth = projected["depth"].detach()
    for n in torch.argsort(depth.float(), stable=True).tolist():
        if depth[n] < near:
            continue
        offset = pixels - projected["means2d"][n]
        power = 0.5 * torch.einsum("hwi,ij,hwj->hw", offset, projected["conic"][n], offset)
        alpha = (projected["opacity"][n] * torch.exp(-power)).clamp_max(0.999)
        alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
        after = transmittance * (1 - alpha)
        done = done | (after <= 1e-4)
        weight = torch.where(done, torch.zeros_like(alpha), alpha * transmittance)
        transmittance = torch.where(done, transmittance, after)
        image = image + weight[..., None] * values[n]
        weights[n] = weight
    return image, 1 - transmittance, torch.stack(weights)
