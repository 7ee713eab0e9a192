"""3D-OVS: a list of classes known in advance, fitted by relevancy distributions and feature distributions.

Liu et al. 2023 fit a feature field and, for each pixel, a choice among the scales of CLIP, with three losses: the
cosine with the chosen feature; the Jensen-Shannon divergence between the class distribution of the field and that of
the chosen relevancies (relevancy-distribution alignment); and, for pairs of pixels, a divergence between class
distributions that is small where DINO features are similar and large where they are not (feature-distribution
alignment). Here feature and choice are stored on the Gaussians. The classes are the prompts of the evaluation, known
in advance.

A prompt is scored against the other classes: at relevancy 0.5 it ties with the best other class, so the fixed
threshold is 3D-OVS's choice of the best class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.evaluation.baselines.baseline import BaselineRun
from lexsplat.evaluation.baselines.feature_rendering import (
    CHANNELS,
    TrainingData,
    TrainingViews,
    back_projected_mean,
    render_cosines,
    resized_map,
    unit_texts,
)
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import QueryConfig, Question
from lexsplat.runtime.adam import Adam
from lexsplat.runtime.progress import Event


@dataclass(frozen=True)
class Ovs3dConfig:
    """Settings of `Ovs3d`; weights follow the authors' configuration unless stated.

    Args:
        steps: Gradient steps, one training view each.
        learning_rate: Learning rate of Adam on features and choices.
        relevancy_weight: Weight of the relevancy-distribution alignment.
        similar_weight: Weight of pairs with similar DINO features. The authors' 200 makes all classes equal with the
            bundled DINO, to which a quarter of all pairs are similar (second scene: mIoU .20; .63 with 0.67).
        dissimilar_weight: Weight of pairs with dissimilar DINO features.
        shift: DINO cosine that separates similar from dissimilar pairs.
        temperature: Temperature of the class distributions in the feature-distribution alignment.
        pairs: Number of pixels of a step between which pairs are formed.
    """

    steps: int = 150
    learning_rate: float = 0.01
    relevancy_weight: float = 1.0
    similar_weight: float = 0.67
    dissimilar_weight: float = 0.22
    shift: float = 0.7
    temperature: float = 0.2
    pairs: int = 192


class ClassFeatures:
    """A feature on each Gaussian and the classes it was fitted to.

    Args:
        features: ``[N, D]``.
        classes: Unit text embeddings ``[K, D]`` of the classes.
    """

    method = "3dovs"

    def __init__(self, features: Tensor, classes: Tensor) -> None:
        self.features, self.classes = features, classes

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]``: each prompt against the best other class; the negatives have no part."""
        (positives,) = unit_texts(question.positives)
        texts = torch.cat([positives, self.classes.to(positives)])
        cosines, alpha = render_cosines(gaussians, camera, self.features, texts)
        found = self._against_others(cosines, positives, question.config) * alpha[..., None]
        return found.permute(2, 0, 1).contiguous()

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]``."""
        (positives,) = unit_texts(question.positives)
        lengths = self.features.norm(dim=1, keepdim=True)
        texts = torch.cat([positives, self.classes.to(positives)]).to(self.features.device)
        cosines = (self.features / lengths.clamp_min(1e-12)) @ texts.T
        return (self._against_others(cosines, positives, question.config) * (lengths > 0)).T.contiguous()

    def _against_others(self, cosines: Tensor, positives: Tensor, config: QueryConfig) -> Tensor:
        own, classes = cosines[..., : len(positives)], cosines[..., len(positives) :]
        same = (positives @ self.classes.to(positives).T) > 1 - 1e-5
        found = []
        for index in range(len(positives)):
            others = classes[..., ~same[index].to(classes.device)]
            rival = others.amax(-1) if others.shape[-1] else torch.zeros_like(own[..., index])
            found.append(torch.sigmoid(config.temperature * (own[..., index] - rival)))
        return torch.stack(found, dim=-1)

    def tensors(self) -> dict[str, Tensor]:
        """The features in half precision, and the classes."""
        return {"features": self.features.half(), "classes": self.classes}


def js_divergence(first: Tensor, second: Tensor) -> Tensor:
    """Jensen-Shannon divergence in nats between distributions ``[..., K]`` given by their logarithms: ``[...]``."""
    middle = torch.logaddexp(first, second) - 0.6931471805599453
    left = (first.exp() * (first - middle)).sum(-1)
    right = (second.exp() * (second - middle)).sum(-1)
    return (left + right) / 2


def alignment_loss(log_classes: Tensor, dino: Tensor, config: Ovs3dConfig) -> Tensor:
    """Feature-distribution alignment of M pixels.

    Args:
        log_classes: Logarithms of their class distributions ``[M, K]``.
        dino: Their DINO features ``[M, E]``.
        config: Weights and shift.
    """
    unit = F.normalize(dino, dim=-1)
    similarity = unit @ unit.T - config.shift
    divergence = js_divergence(log_classes[:, None], log_classes[None])
    off = ~torch.eye(len(unit), dtype=torch.bool, device=unit.device)
    loss = divergence.new_zeros(())
    for part, weight in (
        (similarity.clamp(min=0), config.similar_weight),
        (similarity.clamp(max=0), config.dissimilar_weight),
    ):
        count = int((part[off] != 0).sum())
        if count:
            loss = loss + weight * (part * divergence)[off].sum() / count
    return loss


class _Fit:
    """The optimized tensors and their loss."""

    def __init__(
        self, data: TrainingData, views: TrainingViews, start: Tensor, classes: Tensor, config: Ovs3dConfig
    ) -> None:
        self.views, self.maps, self.level_maps = views, data.maps, data.level_maps
        self.classes, self.config = classes, config
        self.features = start.clone().requires_grad_()
        levels = len(self.level_maps(views.names[0])[1])
        self.choices = torch.zeros(len(start), levels, device=start.device, requires_grad=True)

    def loss(self, name: str, generator: torch.Generator) -> Tensor:
        """The three losses of one training view; ``generator`` draws the pixels of the pairs."""
        config, dimension = self.config, self.features.shape[1]
        camera, _ = self.views.prepared(name)
        stored = torch.cat([self.features, self.choices], dim=1)
        rendered = torch.cat(
            [self.views.render(name, part) for part in stored.split(CHANNELS, dim=1)], dim=-1
        )
        image, select = rendered[..., :dimension], rendered[..., dimension:].softmax(-1)
        stack, _ = self.level_maps(name)
        targets = torch.stack([resized_map(level.to(image.device), camera) for level in stack])
        targets = F.normalize(targets, dim=-1)
        chosen = F.normalize((select.permute(2, 0, 1)[..., None] * targets).sum(0), dim=-1)
        loss = 1 - F.cosine_similarity(image, chosen, dim=-1).mean()

        relevancies = targets @ self.classes.T  # [L, H, W, K], stretched to 0..1 over the view as 3D-OVS does
        low, high = relevancies.amin((1, 2), keepdim=True), relevancies.amax((1, 2), keepdim=True)
        relevancies = (relevancies - low) / (high - low).clamp_min(1e-6)
        wanted = (select.permute(2, 0, 1)[..., None] * relevancies).sum(0).log_softmax(-1)
        cosines = F.normalize(image, dim=-1) @ self.classes.T
        loss = loss + config.relevancy_weight * js_divergence(cosines.log_softmax(-1), wanted).mean()

        features = self.maps[name]
        if features.dino is not None:
            pixels = torch.randperm(camera.height * camera.width, generator=generator)[: config.pairs]
            pixels = pixels.to(image.device)
            dino = resized_map(features.dino.to(image.device), camera).flatten(0, 1)[pixels]
            log_classes = (cosines.flatten(0, 1)[pixels] / config.temperature).log_softmax(-1)
            loss = loss + alignment_loss(log_classes, dino, config)
        return loss


@dataclass(frozen=True)
class Ovs3d:
    """The baseline."""

    settings: Ovs3dConfig = Ovs3dConfig()
    name: ClassVar[str] = "3dovs"
    knows_prompts: ClassVar[bool] = True
    needs_crop_sizes: ClassVar[bool] = True

    def fit(self, data: TrainingData, run: BaselineRun) -> ClassFeatures:
        """Fit features to the Gaussians with the prompts as classes; events are of stage "3dovs".

        The DINO part of the features, if there is one, enters the feature-distribution alignment.

        Raises:
            ValueError: If there are fewer than two prompts.
        """
        if run.classes is None or len(run.classes) < 2:
            found = 0 if run.classes is None else len(run.classes)
            raise ValueError(f"3dovs needs the prompts of the evaluation, at least two classes, got {found}")
        config = self.settings
        (classes,) = unit_texts(run.classes)
        views = TrainingViews(data, memory=run.memory)
        total = len(views.names) + config.steps
        start, weights = back_projected_mean(
            views,
            lambda name: data.maps[name].clip,
            listener=lambda done: run.listener(Event("3dovs", done, total)),
        )
        fit = _Fit(data, views, start, classes.to(start.device), config)
        optimizer = Adam([fit.features, fit.choices], lr=config.learning_rate)
        generator = torch.Generator().manual_seed(run.seed)
        for step, name in enumerate(views.order(config.steps, generator), start=1):
            loss = fit.loss(name, generator)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if step % 10 == 0 or step == config.steps:
                run.listener(Event("3dovs", len(views.names) + step, total, {"loss": float(loss.detach())}))
        fitted = torch.where((weights > 0)[:, None], fit.features.detach(), 0.0)
        return ClassFeatures(fitted, fit.classes)
