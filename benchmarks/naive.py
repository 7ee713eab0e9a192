"""3DGS as a newcomer writes it from the paper: torch operations, autograd and `torch.optim.Adam`, for `peers.py`.

It covers the first 500 steps of 3DGS at full resolution: before density control and view-dependent colors.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.captures import Capture, InitialPoints
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import SH_C0, Gaussians, gaussians_from_points
from lexsplat.rendering.results import Projection

TILE = 16
LAST_STEP = 500
NEAR = 0.2
RATES = {"means": 1.6e-4, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 5e-2, "sh0": 2.5e-3}
"""Learning rates of 3DGS; that of the means is relative to the extent and decays to a hundredth."""


class NaiveTrainer:
    """A training of ``steps`` steps from the points of the capture."""

    def __init__(self, capture: Capture, points: InitialPoints, steps: int) -> None:
        if steps > LAST_STEP:
            raise ValueError(f"the naive port has no density control: at most {LAST_STEP} steps, got {steps}")
        start = gaussians_from_points(points.points, points.colors, sh_degree=0).tensors()
        self.shN = start.pop("shN")
        self.parameters = {name: value.requires_grad_() for name, value in start.items()}
        rates = RATES | {"means": RATES["means"] * capture.extent}
        groups = [{"params": [value], "lr": rates[name]} for name, value in self.parameters.items()]
        self.optimizer = torch.optim.Adam(groups, eps=1e-15)
        self.decay = 0.01 ** (1 / steps)
        self.views = [(view.camera, torch.from_numpy(view.load_image())) for view in capture.train_views]
        self.order: list[int] = []
        self.generator = torch.Generator().manual_seed(0)
        self.background = torch.tensor(capture.background)

    def gaussians(self) -> Gaussians:
        return Gaussians(**self.parameters, shN=self.shN)

    def step(self) -> float:
        """One step on one view; returns the loss."""
        self.order = self.order or torch.randperm(len(self.views), generator=self.generator).tolist()
        camera, photo = self.views[self.order.pop()]
        image = draw(self.gaussians(), camera, self.background)
        loss = 0.8 * (image - photo).abs().mean() + 0.2 * (1 - ssim(image, photo))
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.optimizer.param_groups[0]["lr"] *= self.decay
        return loss.item()


def draw(gaussians: Gaussians, camera: Camera, background: Tensor) -> Tensor:
    """The image ``[H, W, 3]`` over the background."""
    projection = project(gaussians, camera)
    colors = (SH_C0 * gaussians.sh0[:, 0] + 0.5).clamp_min(0)
    return blend(projection, find_tiles(projection, camera), colors, None, background)[0]


def project(gaussians: Gaussians, camera: Camera) -> Projection:
    """Equations 5 and 6 of 3DGS: centers, covariances of the local affine approximation, radii of 3 sigma."""
    view, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (camera.viewmat, camera.K))
    x, y, depths = (gaussians.means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    visible = depths > NEAR
    z = torch.where(visible, depths, 1.0)
    limits = 0.65 * camera.width / K[0, 0], 0.65 * camera.height / K[1, 1]
    u, v = (value.clamp(-limit, limit) for value, limit in zip((x / z, y / z), limits))
    zero = torch.zeros_like(z)
    jacobian = torch.stack([K[0, 0] / z, zero, -K[0, 0] * u / z, zero, K[1, 1] / z, -K[1, 1] * v / z], -1)
    axes = view[:3, :3] @ rotations(gaussians.quats) * gaussians.scales[:, None]
    factor = jacobian.reshape(-1, 2, 3) @ axes
    covariance = factor @ factor.transpose(1, 2) + 0.3 * torch.eye(2)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    area = a * c - b * b
    largest = (a + c) / 2 + ((a - c) ** 2 / 4 + b * b).sqrt()
    return Projection(
        means2d=torch.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], -1),
        conics=torch.stack([c / area, -b / area, a / area], -1),
        opacities=gaussians.opacities,
        depths=depths.detach(),
        radii=(3 * largest.detach().sqrt()).ceil() * visible,
    )


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices ``[N, 3, 3]`` of quaternions wxyz."""
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def find_tiles(projection: Projection, camera: Camera) -> SimpleNamespace:
    """The Gaussians of each tile, nearest first: those whose square of 3 sigma overlaps it."""
    order = projection.depths.argsort()
    order = order[projection.radii[order] > 0]
    low = projection.means2d.detach()[order] - projection.radii[order, None]
    high = projection.means2d.detach()[order] + projection.radii[order, None]
    members = []
    for top in range(0, camera.height, TILE):
        for left in range(0, camera.width, TILE):
            corner = torch.tensor([left, top])
            members.append(order[((low < corner + TILE) & (high > corner)).all(1)])
    return SimpleNamespace(camera=camera, members=members)


def blend_tile(
    projection: Projection, colors: Tensor, members: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    """Colors ``[P, C]`` and transmittance ``[P]`` of the pixels ``[P, 2]`` behind the listed Gaussians."""
    offset = pixels[:, None] - projection.means2d[members]
    xx, xy, yy = projection.conics[members].unbind(-1)
    exponent = (
        0.5 * (xx * offset[..., 0] ** 2 + yy * offset[..., 1] ** 2) + xy * offset[..., 0] * offset[..., 1]
    )
    alpha = (projection.opacities[members] * torch.exp(-exponent)).clamp_max(0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones(len(pixels), 1), after[:, :-1]], 1)
    return (alpha * before * (after > 1e-4)) @ colors[members], after[:, -1]


def blend(
    projection: Projection, tiles: SimpleNamespace, colors: Tensor, features: None, background: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The image ``[H, W, 3]`` over the background and alpha ``[H, W]``, tile by tile."""
    width, height = tiles.camera.width, tiles.camera.height
    behind = torch.zeros(3) if background is None else background
    members_of = iter(tiles.members)
    rows = []
    for top in range(0, height, TILE):
        row = []
        for left in range(0, width, TILE):
            members = next(members_of)
            ys, xs = torch.meshgrid(
                torch.arange(top, min(top + TILE, height)) + 0.5,
                torch.arange(left, min(left + TILE, width)) + 0.5,
                indexing="ij",
            )
            values = torch.cat([behind.expand(ys.numel(), 3), torch.zeros(ys.numel(), 1)], 1)
            if len(members):
                pixels = torch.stack([xs.flatten(), ys.flatten()], 1)
                color, passed = blend_tile(projection, colors, members, pixels)
                values = torch.cat([color + passed[:, None] * behind, 1 - passed[:, None]], 1)
            row.append(values.reshape(*ys.shape, 4))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows, 0)
    return image[..., :3], image[..., 3]


def ssim(image: Tensor, photo: Tensor) -> Tensor:
    """Mean structural similarity of images ``[H, W, 3]``: a window of 11 pixels, sigma 1.5, zeros around."""
    line = torch.exp(-0.5 * (torch.arange(-5, 6) / 1.5) ** 2)
    window = (line[:, None] * line / line.sum() ** 2).expand(3, 1, 11, 11)
    a, b = image.permute(2, 0, 1), photo.permute(2, 0, 1)
    moments = [F.conv2d(value, window, padding=5, groups=3) for value in (a, b, a * a, b * b, a * b)]
    mean_a, mean_b, aa, bb, ab = moments
    likeness = (2 * mean_a * mean_b + 0.01**2) * (2 * (ab - mean_a * mean_b) + 0.03**2)
    spread = (mean_a**2 + mean_b**2 + 0.01**2) * (aa - mean_a**2 + bb - mean_b**2 + 0.03**2)
    return (likeness / spread).mean()
