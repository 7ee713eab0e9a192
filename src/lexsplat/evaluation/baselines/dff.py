"""DFF: features distilled into the scene by rendering them in full dimension.

Kobayashi et al. 2022 fit a feature field by the squared error between rendered and extracted features. Here the field
is a vector on each Gaussian. The fit starts from the back-projected mean and continues with Adam, one training view
per step, `CHANNELS` channels at a time, so that only the result grows with the dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.evaluation.baselines.feature_rendering import (
    TrainingData,
    back_projected_mean,
    chunks,
    render_cosines,
    resized_map,
    unit_texts,
)
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import Question, pairwise_relevancy
from lexsplat.runtime.memory import DEFAULT_MEMORY
from lexsplat.runtime.progress import Event, Listener, silent


@dataclass(frozen=True)
class DffConfig:
    """Settings of `distill`.

    Args:
        steps: Gradient steps per chunk of channels; 0 keeps the back-projected mean.
        learning_rate: Learning rate of Adam on the features, whose length is at most 1.
        scale: Rendered pixels per cell of a feature map along a side.
    """

    steps: int = 120
    learning_rate: float = 0.01
    scale: int = 2

    def __post_init__(self) -> None:
        if self.steps < 0 or self.scale < 1 or self.learning_rate <= 0:
            raise ValueError("steps must not be negative, scale and learning_rate must be positive")


class DistilledFeatures:
    """A feature on each Gaussian.

    Args:
        features: ``[N, D]``; 0 for a Gaussian that no training view shows.
        method: Name of the method.
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
    data: TrainingData,
    config: DffConfig | None = None,
    *,
    seed: int = 0,
    memory: int = DEFAULT_MEMORY,
    listener: Listener = silent,
) -> DistilledFeatures:
    """Fit CLIP features to the Gaussians.

    Args:
        data: Gaussians, training views and features.
        config: Settings.
        seed: Seed of the order of the views.
        memory: Memory budget in bytes; results do not depend on it.
        listener: Receives events of stage "dff".
    """
    config = config or DffConfig()
    maps, views = data.maps, data.views(memory, scale=config.scale)
    dimensions = maps[views.names[0]].clip.shape[-1]
    ranges = chunks(dimensions)
    total = len(views.names) + config.steps * len(ranges)
    features, weights = back_projected_mean(
        views,
        lambda name, camera: resized_map(maps[name].clip, camera),
        listener=lambda done: listener(Event("dff", done, total)),
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
