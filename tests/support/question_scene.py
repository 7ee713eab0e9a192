"""Text embeddings and a small scene for the tests of queries."""

import numpy as np
import torch

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.language.fields import CodeField


def texts(count, dim, seed):
    return torch.nn.functional.normalize(
        torch.randn(count, dim, generator=torch.Generator().manual_seed(seed)), dim=-1
    )


def coded_cloud() -> tuple[CodeField, Gaussians, Camera]:
    """Gaussians in a cloud with random codes, some without a code, and a camera whose view extends beyond them."""
    rng = np.random.default_rng(0)
    gaussians = gaussians_from_points(
        rng.uniform(-0.6, 0.6, (150, 3)), rng.random((150, 3)), sh_degree=0, opacity=0.7
    )
    gaussians.log_scales -= 0.7  # small, so that the corners of the view are empty
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(150, 4, generator=generator)
    weights = weights / weights.sum(1, keepdim=True)
    weights[:20] = 0
    codes = torch.stack([torch.randperm(12, generator=generator)[:4] for _ in range(150)]).to(torch.uint8)
    field = CodeField(Codebook(texts(12, 16, 2)), codes, weights, torch.zeros(150))
    camera = look_at(np.array([0, -4, 0.5]), np.zeros(3), np.array([0, 0, 1.0]), 48, 36, 0.9)
    return field, gaussians, camera
