"""LERF: CLIP at several physical scales, the scale chosen for each question, DINO as a regularizer.

Kerr et al. 2023 train a field F(x, s) whose target at a pixel is the embedding of the crop that is s wide at the
depth of the surface. Here every Gaussian carries one vector for each of a few scales s: the average of what the
training views show of it at that scale, where depth is rendered and the crop size that is s wide there is
interpolated between the crop sizes at hand. LERF's DINO branch makes neighbors that look alike agree through a
shared grid; here a Gaussian takes the mean of its nearest neighbors, weighted by how alike their DINO features are.

A question is asked at every scale; the scale with the highest relevancy answers (LERF's rule, for each view).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.evaluation.baselines.dff import feature_scores
from lexsplat.evaluation.baselines.feature_rendering import (
    TrainingViews,
    average_features,
    render_cosines,
    resized_map,
    unit_texts,
)
from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import Question, pairwise_relevancy
from lexsplat.rendering import render
from lexsplat.runtime.progress import Event, Listener, silent

LevelMaps = Callable[[str], tuple[Tensor, list[float]]]
"""The CLIP map of each crop size of a view ``[L, h, w, D]``, and their sides as fractions of the image's width."""


@dataclass(frozen=True)
class LerfConfig:
    """Settings of `fit_lerf`.

    Args:
        scales: Number of physical scales.
        neighbors: Neighbors a Gaussian is averaged with; 0 leaves DINO out.
        sharpness: How fast a neighbor's weight falls with the DINO cosine: exp(sharpness (cos - 1)).
    """

    scales: int = 4
    neighbors: int = 8
    sharpness: float = 10.0

    def __post_init__(self) -> None:
        if self.scales < 1 or self.neighbors < 0:
            raise ValueError("scales must be positive, neighbors not negative")


class ScaledFeatures:
    """Features on every Gaussian at several scales.

    Args:
        features: ``[S, N, D]``.
        scales: The scales ``[S]`` in world units.
    """

    method = "lerf"

    def __init__(self, features: Tensor, scales: Tensor) -> None:
        self.features, self.scales = features, scales

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]``, each at the scale where it is highest."""
        positives, negatives = unit_texts(question.positives, question.negatives)
        best: Tensor | None = None
        for features in self.features:
            cosines, alpha = render_cosines(gaussians, camera, features, torch.cat([positives, negatives]))
            split = len(positives)
            found = pairwise_relevancy(
                cosines[..., :split], cosines[..., split:], question.config.temperature
            )
            maps = (found * alpha[..., None]).permute(2, 0, 1)
            best = maps if best is None else torch.where(_higher(maps, best)[:, None, None], maps, best)
        if best is None:
            raise ValueError("there is no scale")
        return best.contiguous()

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]``, each at the scale where it is highest."""
        scores = torch.stack([feature_scores(f, question) for f in self.features])
        chosen = scores.amax(-1).argmax(0)
        return scores[chosen, torch.arange(scores.shape[1], device=scores.device)]

    def tensors(self) -> dict[str, Tensor]:
        """The features in half precision, and the scales."""
        return {"features": self.features.half(), "scales": self.scales}


def _higher(maps: Tensor, best: Tensor) -> Tensor:
    return maps.flatten(1).amax(1) > best.flatten(1).amax(1)


def fit_lerf(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    maps: Mapping[str, FeatureMap],
    level_maps: LevelMaps,
    config: LerfConfig | None = None,
    *,
    memory_bytes: int = 1 << 30,
    listener: Listener = silent,
) -> ScaledFeatures:
    """Average CLIP at each scale over the training views, then over neighbors that look alike.

    Args:
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        maps: Dense features by view name; their DINO part regularizes.
        level_maps: Features of each crop size.
        config: Settings.
        memory_bytes: Bound for projections of views kept between steps; results do not depend on it.
        listener: Hears of stage "lerf".
    """
    config = config or LerfConfig()

    def cells(name: str) -> tuple[int, int]:
        rows, cols = maps[name].clip.shape[:2]
        return cols, rows

    views = TrainingViews(gaussians, cameras, cells, memory_bytes=memory_bytes)
    scales = physical_scales(views, level_maps, config.scales)
    total = (config.scales + 1) * len(views.names)
    found = []
    for index, scale in enumerate(scales.tolist()):
        offset = index * len(views.names)
        features, _ = average_features(
            views,
            lambda name, camera, scale=scale: _map_at_scale(views, name, camera, level_maps, scale),  # type: ignore[misc]
            tell=lambda done, offset=offset: listener(Event("lerf", offset + done, total)),  # type: ignore[misc]
        )
        found.append(features)
    stacked = torch.stack(found)
    del found, features
    with_dino = maps[views.names[0]].dino is not None
    if config.neighbors and with_dino and len(gaussians) > 1:
        dino, _ = average_features(
            views,
            lambda name, camera: resized_map(_dino(maps[name]), camera),
            tell=lambda done: listener(Event("lerf", total - len(views.names) + done, total)),
        )
        stacked = smooth_alike(gaussians.means, dino, stacked, config)
    listener(Event("lerf", total, total))
    return ScaledFeatures(stacked, scales)


def _dino(found: FeatureMap) -> Tensor:
    if found.dino is None:
        raise ValueError("some views have DINO features and some have none")
    return found.dino


def physical_scales(views: TrainingViews, level_maps: LevelMaps, count: int) -> Tensor:
    """Widths ``[S]`` in world units, evenly spaced in their logarithm over what the crops of the views span."""
    smallest, largest = [], []
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


def _map_at_scale(
    views: TrainingViews, name: str, camera: Camera, level_maps: LevelMaps, scale: float
) -> Tensor:
    """The map ``[H, W, D]`` of crops that are ``scale`` wide at the depth of each pixel."""
    levels, sides = level_maps(name)
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


def smooth_alike(means: Tensor, dino: Tensor, features: Tensor, config: LerfConfig) -> Tensor:
    """Every Gaussian's mean with its nearest neighbors, weighted by how alike their DINO features are.

    Args:
        means: Centers ``[N, 3]``.
        dino: DINO features ``[N, E]``; a zero row (never seen) has no say and is filled in by its neighbors.
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
        alike = torch.exp(config.sharpness * ((unit * unit[other]).sum(-1) - 1))
        # Nothing is known of what was never seen, so its neighbors count alike.
        weight = torch.where(seen > 0, alike, torch.ones_like(alike)) * seen[other]
        for scale, values in enumerate(features):  # one scale at a time: what is gathered is a copy
            total[scale] += weight[:, None] * values[other]
        weights += weight
    return total / weights.clamp_min(1e-12)[:, None]
