"""DFF: the raw features distilled into the scene by rendering them in full dimension, in channel chunks.

Kobayashi et al. 2022 fit a feature field with the squared error between rendered and extracted features. Here the
field is a vector on every Gaussian. The fit starts from the average of what each Gaussian shows and goes on by Adam,
one training view a step, `CHANNELS` channels at a time: memory does not grow with the dimension but for the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.evaluation.baselines.feature_rendering import (
    TrainingViews,
    average_features,
    chunks,
    render_cosines,
    resized_map,
    unit_texts,
)
from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import Question, pairwise_relevancy
from lexsplat.runtime.progress import Event, Listener, silent


@dataclass(frozen=True)
class DffConfig:
    """Settings of `distill`.

    Args:
        steps: Gradient steps for each chunk of channels after the average; 0 keeps the average.
        learning_rate: Of Adam on the features, which are of unit length or below.
        scale: Pixels rendered for each cell of a feature map along a side.
    """

    steps: int = 120
    learning_rate: float = 0.01
    scale: int = 2

    def __post_init__(self) -> None:
        if self.steps < 0 or self.scale < 1 or self.learning_rate <= 0:
            raise ValueError("steps must not be negative, scale and learning_rate must be positive")


class DistilledFeatures:
    """A feature on every Gaussian.

    Args:
        features: ``[N, D]``; 0 for a Gaussian that no training view shows.
        method: Name of the row.
    """

    def __init__(self, features: Tensor, *, method: str = "dff") -> None:
        self.features, self.method = features, method

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]``: LERF's relevancy of the rendered feature, times how much is covered."""
        positives, negatives = unit_texts(question.positives, question.negatives)
        cosines, alpha = render_cosines(gaussians, camera, self.features, torch.cat([positives, negatives]))
        split = len(positives)
        found = pairwise_relevancy(cosines[..., :split], cosines[..., split:], question.config.temperature)
        return (found * alpha[..., None]).permute(2, 0, 1).contiguous()

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]``, 0 for a Gaussian that was never seen."""
        return feature_scores(self.features, question)

    def tensors(self) -> dict[str, Tensor]:
        """The features, in half precision."""
        return {"features": self.features.half()}


def feature_scores(features: Tensor, question: Question) -> Tensor:
    """LERF's relevancy of features ``[N, D]``: ``[P, N]``, 0 for zero features."""
    positives, negatives = (
        text.to(features.device) for text in unit_texts(question.positives, question.negatives)
    )
    lengths = features.norm(dim=1, keepdim=True)
    unit = features / lengths.clamp_min(1e-12)
    found = pairwise_relevancy(unit @ positives.T, unit @ negatives.T, question.config.temperature)
    return (found * (lengths > 0)).T.contiguous()


def distill(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    maps: Mapping[str, FeatureMap],
    config: DffConfig | None = None,
    *,
    seed: int = 0,
    memory_bytes: int = 1 << 30,
    listener: Listener = silent,
) -> DistilledFeatures:
    """Fit CLIP features to the Gaussians.

    Args:
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        maps: Dense features by view name.
        config: Settings.
        seed: Of the order of the views.
        memory_bytes: Bound for projections of views kept between steps; results do not depend on it.
        listener: Hears of stage "dff".
    """
    config = config or DffConfig()

    def cells(name: str) -> tuple[int, int]:
        rows, cols = maps[name].clip.shape[:2]
        return cols, rows

    views = TrainingViews(gaussians, cameras, cells, scale=config.scale, memory_bytes=memory_bytes)
    dimensions = maps[views.names[0]].clip.shape[-1]
    ranges = chunks(dimensions)
    total = len(views.names) + config.steps * len(ranges)
    features, weights = average_features(
        views,
        lambda name, camera: resized_map(maps[name].clip, camera),
        tell=lambda done: listener(Event("dff", done, total)),
    )
    seen = (weights > 0)[:, None]
    generator = torch.Generator().manual_seed(seed)
    done = len(views.names)
    for columns in ranges:
        part = features[:, columns].clone().requires_grad_()
        optimizer = torch.optim.Adam([part], lr=config.learning_rate)
        for step, name in enumerate(views.order(config.steps, generator)):
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * 0.1 ** (step / config.steps)
            rendered = views.render(name, part)
            target = resized_map(maps[name].clip[..., columns].to(part.device), views.prepared(name)[0])
            loss = (rendered - target).square().sum(-1).mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            done += 1
            if done % 20 == 0 or done == total:
                listener(Event("dff", done, total, {"loss": float(loss.detach())}))
        features[:, columns] = torch.where(seen, part.detach(), 0.0)
    return DistilledFeatures(features)
