"""Full-dimensional features on Gaussians: back-projected from views, rendered a few channels at a time.

With A the blending weights of a view (pixels by Gaussians), the rendered features are A F. The transpose of A
back-projects a feature map to the Gaussians; the sum over views divided by the weights is the mean feature of each
Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import Question, pairwise_relevancy
from lexsplat.rendering import PreparedView, accumulate_weights, back_project, prepare, render
from lexsplat.runtime.memory import DEFAULT_MEMORY, kept_bytes

CHANNELS = 32
"""Feature channels rendered in one pass."""

MIN_WEIGHT = 0.01
"""A Gaussian with less weight than this over all views, in pixels, counts as never seen."""

LevelMaps = Callable[[str], tuple[Tensor, list[float]]]
"""The CLIP map of each crop size of a view ``[L, h, w, D]``, and their sides as fractions of the image's width."""


@dataclass(frozen=True)
class TrainingData:
    """Training data of the compared methods.

    Args:
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        maps: Dense features by view name.
        level_maps: Features of each crop size; for `lerf` and `ovs3d`.
    """

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    maps: Mapping[str, FeatureMap]
    level_maps: LevelMaps


class TrainingViews:
    """Training views at the resolution of their feature maps; projections are kept as far as memory allows.

    Args:
        data: Geometry, cameras and maps.
        scale: Rendered pixels per cell along a side; never more than the camera has.
        memory: Memory budget in bytes, `kept_bytes` of it for projections; results do not depend on it.
    """

    def __init__(self, data: TrainingData, *, scale: int = 1, memory: int = DEFAULT_MEMORY) -> None:
        self.gaussians = data.gaussians.detach()
        self.names = sorted(data.cameras)
        self._cameras, self._maps, self._scale = data.cameras, data.maps, scale
        self._limit, self._kept = kept_bytes(memory), dict[str, PreparedView]()

    def prepared(self, name: str) -> tuple[Camera, PreparedView]:
        """Camera and projection of a view at the rendered size."""
        if name in self._kept:
            return self._kept[name].camera, self._kept[name]
        full, (rows, cols) = self._cameras[name], self._maps[name].clip.shape[:2]
        width, height = min(full.width, cols * self._scale), min(full.height, rows * self._scale)
        camera = full.resized(width, height)
        view = prepare(self.gaussians, camera)
        if sum(kept.nbytes for kept in self._kept.values()) + view.nbytes <= self._limit:
            self._kept[name] = view
        return camera, view

    def render(self, name: str, features: Tensor) -> Tensor:
        """Channels ``[N, C]`` rendered to ``[H, W, C]``, with gradients to the channels."""
        camera, view = self.prepared(name)
        return render(self.gaussians, camera, features=features, color=False, prepared=view).features

    def order(self, steps: int, generator: torch.Generator) -> Iterator[str]:
        """Names for a number of steps: all views in random order, repeated."""
        queue: list[int] = []
        for _ in range(steps):
            if not queue:
                queue = torch.randperm(len(self.names), generator=generator).tolist()
            yield self.names[queue.pop()]


class GaussianFeatures:
    """Features on each Gaussian, at one or several physical scales; a prompt takes the scale that scores highest.

    Args:
        method: Name of the method.
        features: ``[S, N, D]``; 0 for a Gaussian that no training view shows.
        scales: The scales ``[S]`` in world units, where there are several.
    """

    def __init__(self, method: str, features: Tensor, scales: Tensor | None = None) -> None:
        self.method, self.features, self.scales = method, features, scales

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]``: LERF's relevancy of the rendered feature times the coverage."""
        positives, negatives = unit_texts(question.positives, question.negatives)
        texts, split = torch.cat([positives, negatives]), len(positives)
        maps = []
        for features in self.features:
            cosines, alpha = render_cosines(gaussians, camera, features, texts)
            found = pairwise_relevancy(
                cosines[..., :split], cosines[..., split:], question.config.temperature
            )
            maps.append((found * alpha[..., None]).permute(2, 0, 1))
        return _best_of_scales(torch.stack(maps))

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]``, 0 for a Gaussian that was never seen."""
        device = self.features.device
        positives, negatives = (
            text.to(device) for text in unit_texts(question.positives, question.negatives)
        )
        lengths = self.features.norm(dim=2, keepdim=True)
        unit = self.features / lengths.clamp_min(1e-12)
        found = pairwise_relevancy(unit @ positives.T, unit @ negatives.T, question.config.temperature)
        return _best_of_scales((found * (lengths > 0)).transpose(1, 2))

    def tensors(self) -> dict[str, Tensor]:
        """The features in half precision, and the scales."""
        scales = {} if self.scales is None else {"scales": self.scales}
        return {"features": self.features.half(), **scales}


def _best_of_scales(values: Tensor) -> Tensor:
    """Of scores or maps ``[S, P, ...]``, those of the scale at which each prompt has its highest value."""
    best = values.flatten(2).amax(2).argmax(0)
    return values[best, torch.arange(values.shape[1], device=values.device)].contiguous()


def resized_map(values: Tensor, camera: Camera) -> Tensor:
    """A map ``[h, w, C]`` at the size of a camera, bilinear, cell centers kept."""
    if values.shape[:2] == (camera.height, camera.width):
        return values
    planes = values.permute(2, 0, 1)[None]
    planes = F.interpolate(planes, (camera.height, camera.width), mode="bilinear", align_corners=False)
    return planes[0].permute(1, 2, 0)


def back_projected_mean(
    views: TrainingViews, map_of: Callable[[str], Tensor], *, listener: Callable[[int], None]
) -> tuple[Tensor, Tensor]:
    """Mean feature of each Gaussian over all training views, weighted by alpha T.

    Not the sum of `language.methods.averaged.average_features`: maps are resampled bilinearly to the rendered size
    instead of taking the nearest cell, masked pixels count, and the mean stays float32, because fits start from it.

    Args:
        views: The training views.
        map_of: The map ``[h, w, C]`` of a view; it is resampled to the size of the camera.
        listener: Receives the number of finished views.

    Returns:
        Features ``[N, C]``, 0 where never seen, and weights ``[N]`` in pixels.
    """
    total: Tensor | None = None
    weights = torch.zeros(len(views.gaussians), device=views.gaussians.device)
    for done, name in enumerate(views.names, start=1):
        camera, prepared = views.prepared(name)
        values = resized_map(map_of(name), camera).to(weights.device)
        found = back_project(views.gaussians, camera, values, prepared)
        total = found if total is None else total + found
        weights += accumulate_weights(views.gaussians, camera, prepared=prepared)
        listener(done)
    if total is None:
        raise ValueError("features need at least one training view")
    seen = weights >= MIN_WEIGHT
    return torch.where(seen[:, None], total / weights.clamp_min(MIN_WEIGHT)[:, None], 0.0), weights


@torch.no_grad()
def render_cosines(
    gaussians: Gaussians, camera: Camera, features: Tensor, texts: Tensor
) -> tuple[Tensor, Tensor]:
    """Cosines of rendered features with texts, without storing a feature map.

    Args:
        gaussians: The geometry.
        camera: The view.
        features: ``[N, D]``, rendered `CHANNELS` at a time.
        texts: Unit vectors ``[T, D]``.

    Returns:
        Cosines ``[H, W, T]``, 0 where nothing is rendered, and alpha ``[H, W]``.
    """
    prepared = prepare(gaussians, camera)
    device = gaussians.device
    products = torch.zeros(camera.height, camera.width, len(texts), device=device)
    squares = torch.zeros(camera.height, camera.width, 1, device=device)
    alpha = torch.zeros(camera.height, camera.width, device=device)
    texts = texts.to(device, torch.float32)
    for start in range(0, features.shape[1], CHANNELS):
        part = features[:, start : start + CHANNELS].contiguous()
        found = render(gaussians, camera, features=part, color=False, prepared=prepared)
        products += found.features @ texts[:, start : start + CHANNELS].T
        squares += found.features.square().sum(-1, keepdim=True)
        alpha = found.alpha
    return (products / squares.sqrt().clamp_min(1e-12)).clamp(-1, 1), alpha


def unit_texts(*texts: Tensor) -> list[Tensor]:
    """Text embeddings ``[T, D]`` with unit rows."""
    return [F.normalize(text.float(), dim=-1) for text in texts]
