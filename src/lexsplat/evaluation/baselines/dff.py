"""DFF: features distilled into the scene by rendering them in full dimension.

Kobayashi et al. 2022 fit a feature field by the squared error between rendered and extracted features. Here the field
is a vector on each Gaussian. The fit starts from the back-projected mean and continues with Adam, one training view
per step, `CHANNELS` channels at a time, so that only the result grows with the dimension.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from lexsplat.evaluation.baselines.baseline import BaselineRun
from lexsplat.evaluation.baselines.feature_rendering import (
    CHANNELS,
    GaussianFeatures,
    TrainingData,
    TrainingViews,
    back_projected_mean,
    resized_map,
)
from lexsplat.runtime.adam import Adam
from lexsplat.runtime.progress import Event


@dataclass(frozen=True)
class DffConfig:
    """Settings of `Dff`.

    Args:
        steps: Gradient steps per chunk of channels; 0 keeps the back-projected mean.
        learning_rate: Learning rate of Adam on the features, whose length is at most 1.
        scale: Rendered pixels per cell of a feature map along a side.
    """

    steps: int = 120
    learning_rate: float = 0.01
    scale: int = 2


@dataclass(frozen=True)
class Dff:
    """The baseline."""

    settings: DffConfig = DffConfig()
    name: ClassVar[str] = "dff"
    knows_prompts: ClassVar[bool] = False
    needs_crop_sizes: ClassVar[bool] = False

    def fit(self, data: TrainingData, run: BaselineRun) -> GaussianFeatures:
        """Fit CLIP features to the Gaussians; events are of stage "dff"."""
        config = self.settings
        maps, views = data.maps, TrainingViews(data, scale=config.scale, memory=run.memory)
        dimensions = maps[views.names[0]].clip.shape[-1]
        ranges = [slice(start, start + CHANNELS) for start in range(0, dimensions, CHANNELS)]
        total = len(views.names) + config.steps * len(ranges)
        features, weights = back_projected_mean(
            views,
            lambda name: maps[name].clip,
            listener=lambda done: run.listener(Event("dff", done, total)),
        )
        seen = (weights > 0)[:, None]
        generator = torch.Generator().manual_seed(run.seed)
        done = len(views.names)
        for columns in ranges:
            part = features[:, columns].clone().requires_grad_()
            optimizer = Adam([part], lr=config.learning_rate)
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
                    run.listener(Event("dff", done, total, {"loss": float(loss.detach())}))
            features[:, columns] = torch.where(seen, part.detach(), 0.0)
        return GaussianFeatures("dff", features[None])
