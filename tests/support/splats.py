"""Random Gaussians for tests of file formats."""

from __future__ import annotations

import torch

from lexsplat.geometry.gaussians import Gaussians


def make(count: int, degree: int, seed: int = 0, antialiased: bool = False) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    rest = (degree + 1) ** 2 - 1
    r = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return Gaussians(
        r(count, 3), r(count, 4), r(count, 3), r(count), r(count, 1, 3), r(count, rest, 3), antialiased
    )
