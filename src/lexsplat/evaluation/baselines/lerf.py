"""LERF: CLIP at several physical scales, the scale chosen per prompt, DINO as a regularizer.

Kerr et al. 2023 train a field F(x, s) whose target at a pixel is the embedding of the crop that is s wide at the
depth of the surface. Here each Gaussian stores one vector for each of a few scales s: the back-projected mean of maps
at that scale. The depth of a pixel is rendered, and the embedding of the crop that is s wide at this depth is
interpolated between the available crop sizes. LERF's DINO branch makes similar neighbors agree through a shared grid;
here the features of a Gaussian are averaged over its nearest neighbors, weighted by DINO similarity.

A prompt is scored at every scale; the scale with the highest relevancy is taken (LERF's rule, per view).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.evaluation.baselines.baseline import BaselineRun
from lexsplat.evaluation.baselines.feature_rendering import (
    GaussianFeatures,
    LevelMaps,
    TrainingData,
    TrainingViews,
    back_projected_mean,
    resized_map,
)
from lexsplat.rendering import render
from lexsplat.runtime.progress import Event


@dataclass(frozen=True)
class LerfConfig:
    """Settings of `Lerf`.

    Args:
        scales: Number of physical scales.
        neighbors: Number of neighbors in the average; 0 disables it, and with it DINO.
        sharpness: Weight of a neighbor by its DINO cosine: exp(sharpness (cos - 1)).
    """

    scales: int = 4
    neighbors: int = 8
    sharpness: float = 10.0


def physical_scales(views: TrainingViews, level_maps: LevelMaps, count: int) -> Tensor:
    """Widths ``[S]`` in world units, spaced evenly in the logarithm over the range of the crops."""
    smallest, largest = [], []
    # Not `evenly`, which takes other views: recorded results depend on these.
    for name in views.names[:: max(1, len(views.names) // 12)]:
        camera, _ = views.prepared(name)
        depth = _depth(views, name)
        near = depth[depth > 0]
        if len(near) == 0:
            continue
        sides = level_maps(name)[1]
        unit = camera.width / float(camera.K[0, 0])
        smallest.append(min(sides) * unit * float(near.quantile(0.25)))
        largest.append(max(sides) * unit * float(near.quantile(0.75)))
    if not smallest:
        raise ValueError("no training view shows the scene")
    low, high = float(np.median(smallest)), float(np.median(largest))
    return torch.logspace(np.log10(low), np.log10(max(high, low)), count)


@torch.no_grad()
def _depth(views: TrainingViews, name: str) -> Tensor:
    camera, prepared = views.prepared(name)
    depth = render(views.gaussians, camera, color=False, depth=True, prepared=prepared).depth
    if depth is None:
        raise ValueError("the backend renders no depth")
    return depth


def _map_at_scale(views: TrainingViews, name: str, level_maps: LevelMaps, scale: float) -> Tensor:
    """The map ``[H, W, D]`` of crops that are ``scale`` wide at the depth of each pixel."""
    levels, sides = level_maps(name)
    camera, _ = views.prepared(name)
    depth = _depth(views, name)
    wanted = scale * float(camera.K[0, 0]) / depth.clamp_min(1e-6) / camera.width
    weights = level_weights(wanted, sides).to(levels.device)
    maps = torch.stack([resized_map(level, camera) for level in levels])
    return F.normalize((weights[..., None] * maps).sum(0), dim=-1)


def level_weights(wanted: Tensor, sides: list[float]) -> Tensor:
    """Weights ``[L, H, W]`` of the crop sizes for wanted sides ``[H, W]``: linear in the logarithm, sum 1."""
    order = np.argsort(sides)
    knots = torch.tensor([np.log(sides[i]) for i in order], dtype=torch.float32, device=wanted.device)
    weights = torch.zeros(len(sides), *wanted.shape, device=wanted.device)
    if len(sides) == 1:
        return weights + 1
    place = wanted.clamp_min(1e-9).log().clamp(knots[0], knots[-1])
    upper = torch.searchsorted(knots, place.contiguous()).clamp(1, len(sides) - 1)
    low, high = knots[upper - 1], knots[upper]
    part = (place - low) / (high - low).clamp_min(1e-9)
    for position, level in enumerate(order.tolist()):
        weights[level] = torch.where(upper == position, part, 0) + torch.where(
            upper - 1 == position, 1 - part, 0
        )
    return weights


def smooth_by_similarity(means: Tensor, dino: Tensor, features: Tensor, config: LerfConfig) -> Tensor:
    """Features averaged over the nearest neighbors of each Gaussian, weighted by DINO similarity.

    Args:
        means: Centers ``[N, 3]``.
        dino: DINO features ``[N, E]``; a zero row (never seen) contributes nothing and is filled in by its neighbors.
        features: ``[S, N, D]``.
        config: Settings.
    """
    points = means.detach().cpu().numpy()
    near = min(config.neighbors + 1, len(points))
    _, index = cKDTree(points).query(points, k=near, workers=-1)
    neighbors = torch.as_tensor(index.reshape(len(points), near), device=features.device)
    unit = F.normalize(dino, dim=-1)
    seen = (dino.norm(dim=1) > 0).float()
    total = torch.zeros_like(features)
    weights = torch.zeros(len(points), device=features.device)
    for column in range(near):
        other = neighbors[:, column]
        similarity = torch.exp(config.sharpness * ((unit * unit[other]).sum(-1) - 1))
        # A Gaussian that was never seen has no similarity to its neighbors: they count equally.
        weight = torch.where(seen > 0, similarity, torch.ones_like(similarity)) * seen[other]
        for scale, values in enumerate(features):  # one scale at a time: gathering copies
            total[scale] += weight[:, None] * values[other]
        weights += weight
    return total / weights.clamp_min(1e-12)[:, None]


@dataclass(frozen=True)
class Lerf:
    """The baseline."""

    settings: LerfConfig = LerfConfig()
    name: ClassVar[str] = "lerf"
    knows_prompts: ClassVar[bool] = False
    needs_crop_sizes: ClassVar[bool] = True

    def fit(self, data: TrainingData, run: BaselineRun) -> GaussianFeatures:
        """Average CLIP at each scale over the training views, then over similar neighbors.

        The DINO part of the features regularizes. The seed has no effect. Events are of stage "lerf".
        """
        config = self.settings
        maps, level_maps, views = data.maps, data.level_maps, TrainingViews(data, memory=run.memory)
        scales = physical_scales(views, level_maps, config.scales)
        total = (config.scales + 1) * len(views.names)
        found = []
        for index, scale in enumerate(scales.tolist()):
            offset = index * len(views.names)
            features, _ = back_projected_mean(
                views,
                lambda name, scale=scale: _map_at_scale(views, name, level_maps, scale),  # type: ignore[misc]
                listener=lambda done, offset=offset: run.listener(Event("lerf", offset + done, total)),  # type: ignore[misc]
            )
            found.append(features)
        stacked = torch.stack(found)
        del found, features
        with_dino = maps[views.names[0]].dino is not None
        if config.neighbors and with_dino and len(data.gaussians) > 1:
            dino, _ = back_projected_mean(
                views,
                lambda name: maps[name].dino,  # type: ignore[arg-type, return-value]  # see with_dino
                listener=lambda done: run.listener(Event("lerf", total - len(views.names) + done, total)),
            )
            stacked = smooth_by_similarity(data.gaussians.means, dino, stacked, config)
        run.listener(Event("lerf", total, total))
        return GaussianFeatures("lerf", stacked, scales)
