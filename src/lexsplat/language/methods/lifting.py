"""How much of a view's features each Gaussian takes, where that is not the weight alpha T alone.

Ways of lifting that others found better than the weighted mean. Each is a setting of method "averaged", and off by
default; docs/lab-notes/2026-11-objects.md has what each gains:

- ``gate``: a view gives its features to the Gaussians that make up the first share of its summed weight, the heaviest
  first (VALA, "visibility-aware language aggregation").
- ``squared``: weights are squared, as in the least-squares solution of rendering for features (Splat Feature Solver).
- ``agreement``: a second pass over the views, in which a feature counts the more, the more it agrees with the mean
  of the first: a mean that resists outliers (ReLaGS; VALA's median).

``least_weight`` (ReLaGS) and ``reliability`` (NormLift) need no weights of their own; `average_features` and
`field_from_means` have them. Dimension letters: N Gaussians, E entries of the view's sparse matrix, D dimensions.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

if TYPE_CHECKING:
    from lexsplat.language.methods.averaged import AveragedConfig
    from lexsplat.rendering.cell_weights import SparseCellWeights

BESIDE_GATE = 1e-4
"""Factor on weights that do not pass the gate: what passes in no view keeps its mean, and nothing else notices."""
_ROWS = 16_384


def lifted(
    weights: SparseCellWeights, features: Tensor, means: NDArray[np.float16] | None, config: AveragedConfig
) -> tuple[SparseCellWeights, Tensor]:
    """The weights by which a view's features enter the sums, and the largest alpha T of a Gaussian in a cell ``[N]``.

    Args:
        weights: The weights alpha T of the view.
        features: Its features ``[cells, D]``.
        means: Means of the first pass ``[N, D]`` for ``config.agreement``; None in the first pass.
        config: The settings.
    """
    owners, values = weights.owners(), weights.weights.astype(np.float64)
    in_cells, largest = weights.in_cells(owners), np.zeros(weights.tiles.count)
    np.maximum.at(largest, owners, in_cells)
    if config.gate < 1:
        passing = np.where(passes_gate(weights.totals().numpy(), config.gate), 1.0, BESIDE_GATE)[owners]
        values, in_cells = values * passing, in_cells * passing
    if config.squared:
        values *= in_cells  # the entries of one cell add up to the square of their sum
    if means is not None:
        values *= agreeing(owners, weights.cells, features, means, config.agreement)
    return replace(weights, weights=values.astype(np.float32)), torch.from_numpy(largest.astype(np.float32))


def passes_gate(totals: NDArray[np.float32], share: float) -> NDArray[np.bool_]:
    """The Gaussians ``[N]`` that make up the first ``share`` of the sum of ``totals [N]``, the heaviest first."""
    order = np.argsort(-totals, kind="stable")
    reached = np.cumsum(totals[order], dtype=np.float64)
    passes = np.zeros(len(totals), bool)
    passes[order] = reached - totals[order] < share * reached[-1]
    return passes


def agreeing(
    owners: NDArray[np.int32],
    cells: NDArray[np.int32],
    features: Tensor,
    means: NDArray[np.float16],
    strength: float,
) -> NDArray[np.float64]:
    """Factors ``exp(strength (cos - 1))`` of entries ``[E]``, by the angle between feature and mean."""
    units, factors = functional.normalize(features.float(), dim=-1), np.empty(len(owners))
    for start in range(0, len(owners), _ROWS):
        rows = slice(start, start + _ROWS)
        own = functional.normalize(torch.from_numpy(means[owners[rows]]).float(), dim=-1)
        cosines = (own * units[torch.from_numpy(cells[rows])]).sum(-1)
        factors[rows] = np.exp(strength * (cosines.double().numpy() - 1))
    return factors
