"""Gaussians for tests of file formats and of chosen views."""

from __future__ import annotations

import numpy as np
import torch

from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points


def make(count: int, degree: int, seed: int = 0, antialiased: bool = False) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    rest = (degree + 1) ** 2 - 1
    r = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return Gaussians(
        r(count, 3), r(count, 4), r(count, 3), r(count), r(count, 1, 3), r(count, rest, 3), antialiased
    )


def tame(count: int, degree: int = 0, antialiased: bool = False) -> Gaussians:
    """Gaussians whose colors and sizes are in the range of 8-bit formats."""
    g = make(count, degree, antialiased=antialiased)
    return Gaussians(
        g.means, g.quats, g.log_scales * 0.3 - 3, g.opacity_logits, g.sh0 * 0.4, g.shN * 0.1, antialiased
    )


HARMONIC_SIGNS = {
    # y, z, x; xy, yz, 3z2 - 1, xz, x2 - y2; and so on: the sign of each where two of x, y and z change theirs
    "x": (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1),
    "z": (-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1),
}


def half_turned(g: Gaussians, axis: str) -> Gaussians:
    """Gaussians after half a turn about x or z, worked out by signs alone."""
    w, x, y, z = g.quats.unbind(1)
    quats = {"x": (-x, w, -z, y), "z": (-z, -y, x, w)}[axis]
    signs = {"x": (1, -1, -1), "z": (-1, -1, 1)}[axis]
    harmonics = torch.tensor(HARMONIC_SIGNS[axis][: g.shN.shape[1]]).float()
    return Gaussians(
        g.means * torch.tensor(signs), torch.stack(quats, 1), g.log_scales, g.opacity_logits, g.sh0,
        g.shN * harmonics[:, None], g.antialiased,
    )  # fmt: skip


def largest_differences(expected: Gaussians, found: Gaussians) -> dict[str, float]:
    """Largest difference of each property; the order may differ, so nearest centers are compared."""
    nearest = torch.cdist(expected.means, found.means, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
    assert len(found) == len(expected) == len(set(nearest.tolist())), "other Gaussians"
    found = found.select(nearest)
    a, b = (torch.nn.functional.normalize(g.quats, dim=1) for g in (expected, found))
    pairs = {
        "means": (expected.means, found.means), "log_scales": (expected.log_scales, found.log_scales),
        "opacities": (expected.opacities, found.opacities), "sh0": (expected.sh0, found.sh0),
        "shN": (expected.shN, found.shN), "rotations": ((a * b).sum(1).abs(), torch.ones(len(a))),
    }  # fmt: skip
    return {name: float((x - y).abs().max()) if x.numel() else 0.0 for name, (x, y) in pairs.items()}


def solid(points: np.ndarray, log_size: float = -0.1) -> Gaussians:
    """Opaque Gaussians that close the gaps between points."""
    colors = np.random.default_rng(0).uniform(0, 1, points.shape)
    made = gaussians_from_points(points, colors, sh_degree=0, opacity=0.98)
    made.log_scales += log_size
    return made


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(
        **{name: torch.cat([part.tensors()[name] for part in parts]) for name in parts[0].tensors()}
    )
