"""The smoothing MLP (Eq. 13): language as a smooth function of position."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor, nn

SEMANTIC_CHANNELS = 8
"""S: channels of s_G, the paper's d_s."""

SMOOTHING_WIDTHS = (128, 128, 128)
"""Widths of the hidden layers of the smoothing MLP (supplement, table of PE and MLP)."""


class SmoothingMLP(nn.Module):
    """Eq. 13: s_MLP = MLP(PE(p)), three hidden layers of 128 with ReLU, then a linear layer to 8.

    A coordinate MLP learns low frequencies first, hence the smoothing. Positions are mapped to -1..1 over the box of
    the scene and clamped to -2..2. The paper does not specify a normalization; its code feeds raw coordinates.

    Args:
        center: Center of the box ``[3]``, world units.
        extent: Half the longest side of the box, world units.
        num_frequencies: L of NeRF's encoding (x, sin(2^l pi x), cos(2^l pi x) for l < L). 0 is x alone, as in the
            paper's table.
        generator: Generator of the initial weights.
    """

    center: Tensor
    extent: Tensor

    def __init__(
        self,
        center: Tensor,
        extent: Tensor,
        num_frequencies: int = 0,
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if num_frequencies < 0:
            raise ValueError(f"num_frequencies must not be negative, got {num_frequencies}")
        self.num_frequencies = num_frequencies
        self.register_buffer("center", center.detach().clone())
        self.register_buffer("extent", extent.detach().clone())
        self.layers = mlp((3 + 6 * num_frequencies, *SMOOTHING_WIDTHS, SEMANTIC_CHANNELS), generator)

    def forward(self, means: Tensor, *, bfloat16: bool = False) -> Tensor:
        """s_MLP ``[N, 8]`` at positions ``[N, 3]``; no gradient reaches the positions. ``bfloat16`` as in `MLP`."""
        unit = ((means.detach() - self.center) / self.extent).clamp(-2, 2)
        return self.layers(positional_encoding(unit, self.num_frequencies), bfloat16=bfloat16)


def positional_encoding(positions: Tensor, num_frequencies: int) -> Tensor:
    """NeRF's encoding with the identity: ``[N, 3]`` to ``[N, 3 + 6 L]``, all sines before the cosines."""
    if num_frequencies == 0:
        return positions
    octaves = 2.0 ** torch.arange(num_frequencies, device=positions.device) * math.pi
    angles = (positions[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([positions, angles.sin(), angles.cos()], dim=-1)


def scene_box(means: Tensor) -> tuple[Tensor, Tensor]:
    """Center ``[3]`` and half the longest side ``[]`` of the box between the 2nd and 98th percentile on each axis.

    The percentiles keep far floaters from shrinking the scene to a corner of the box.
    """
    points = means.detach().float()
    if len(points) > 1_000_000:  # torch.quantile has a size limit; a sample is enough
        points = points[:: len(points) // 1_000_000 + 1]
    ends = torch.quantile(points, torch.tensor([0.02, 0.98], device=points.device), dim=0)
    extent = ((ends[1] - ends[0]).max() / 2).clamp_min(1e-6)
    return ends.mean(0), extent


class _EmptyLinear(nn.Linear):
    """A layer whose numbers are not initialized; `nn.utils.skip_init` would import sympy."""

    def reset_parameters(self) -> None:
        pass


class MLP(nn.Sequential):
    """Linear layers with ReLU between them."""

    def forward(self, rows: Tensor, *, bfloat16: bool = False) -> Tensor:
        """Outputs ``[M, C]`` of inputs ``[M, D]``.

        With ``bfloat16`` all layers but the first, whose inputs are positions or s, multiply bfloat16 numbers and
        sum in float32. Weights and their gradients are float32 in any case.
        """
        first, *others = self
        rows = first(rows)
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=bfloat16):
            for layer in others:
                rows = layer(rows)
        return rows.float() if bfloat16 else rows


def mlp(widths: tuple[int, ...], generator: torch.Generator | None) -> MLP:
    """Linear layers with ReLU between them, initialized as nn.Linear is, but by the given generator."""
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        linear = _EmptyLinear(inputs, outputs)
        bound = 1 / math.sqrt(inputs)
        with torch.no_grad():
            linear.weight.uniform_(-bound, bound, generator=generator)
            linear.bias.uniform_(-bound, bound, generator=generator)
        layers += [linear, nn.ReLU()]
    return MLP(*layers[:-1])
