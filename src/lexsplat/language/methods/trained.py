"""Training the language field (section 3.4): Eq. 8 to 15, one random training view a step, geometry frozen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MASKED_CODE, check_views, codes_at_pixels
from lexsplat.language.fields import TrainedField
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.rendering import PreparedView, prepare
from lexsplat.runtime.progress import Listener, silent
from lexsplat.runtime.training import run_training

if TYPE_CHECKING:
    from lexsplat.runtime.training import Checkpoint

__all__ = [
    "MASKED_CODE",
    "REPORT_EVERY",
    "FieldTrainer",
    "TrainedConfig",
    "check_views",
    "codes_at_pixels",
    "train_field",
]

REPORT_EVERY = 25
"""Steps between two events, which is also how often the loss is checked."""


def train_field(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    code_maps: Mapping[str, NDArray[np.uint8]],
    codebook: Codebook,
    config: TrainedConfig,
    *,
    seed: int = 0,
    listener: Listener = silent,
    trainer: FieldTrainer | None = None,
    checkpoint: Checkpoint | None = None,
) -> TrainedField:
    """Train the paper's language field on frozen Gaussians.

    Args:
        gaussians: The geometry; it comes out bit for bit as it went in.
        cameras: The training views by name, and only these.
        code_maps: Index maps by view name; further views are not looked at.
        codebook: The discrete feature space S.
        config: Settings.
        seed: Of the initial field, the order of views and the samples.
        listener: Hears of stage "language" with the losses.
        trainer: One that was begun, to go on with.
        checkpoint: Where the training is saved on the way, and goes on from.

    Raises:
        ValueError: If there is no view, or a view has no index map.
        TrainingError: If the training diverges again and again.
    """
    names = sorted(cameras)
    check_views(names, code_maps)
    trainer = trainer or FieldTrainer(gaussians, codebook, config, seed=seed)
    views = _prepare_views(trainer.gaussians, cameras, config)
    run_training(
        _FrozenGeometryTraining(trainer, names, views, code_maps),
        stage="language",
        name="language field",
        every=REPORT_EVERY,
        checkpoint=checkpoint,
        listener=listener,
    )
    return trainer.field


class _FrozenGeometryTraining:
    """A `FieldTrainer` with its views, as `run_training` steps it."""

    parameter_prefixes = FieldTrainer.parameter_prefixes

    def __init__(
        self,
        trainer: FieldTrainer,
        names: list[str],
        views: Mapping[str, tuple[Camera, PreparedView | None]],
        code_maps: Mapping[str, NDArray[np.uint8]],
    ) -> None:
        self.trainer, self._names, self._views, self._code_maps = trainer, names, views, code_maps
        self.metrics: dict[str, float] = {}

    @property
    def device(self) -> torch.device:
        return self.trainer.gaussians.device

    @property
    def steps_done(self) -> int:
        return self.trainer.iteration

    @property
    def total_steps(self) -> int:
        return self.trainer.config.iterations

    @property
    def rate_factor(self) -> float:
        return self.trainer.rate_factor

    @rate_factor.setter
    def rate_factor(self, factor: float) -> None:
        self.trainer.rate_factor = factor

    def step(self) -> None:
        name = self.trainer.view_of_step(self._names)
        camera, prepared = self._views[name]
        losses = self.trainer.step(camera, self._code_maps[name], prepared=prepared)
        done = self.trainer.iteration
        if done % REPORT_EVERY == 0 or done == self.total_steps:  # reading losses synchronizes a GPU
            self.metrics = {key: float(value) for key, value in losses.items()}
            self.trainer.check_loss(self.metrics["loss"])

    def state_dict(self) -> dict[str, Tensor]:
        return self.trainer.state_dict()

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        self.trainer.load_state_dict(state)

    def find_invalid(self) -> str:
        return self.trainer.find_invalid()


def _prepare_views(
    gaussians: Gaussians, cameras: Mapping[str, Camera], config: TrainedConfig
) -> dict[str, tuple[Camera, PreparedView | None]]:
    """Cameras at the size to render, with their projections as far as memory allows (geometry is fixed)."""
    left = config.memory_bytes
    views: dict[str, tuple[Camera, PreparedView | None]] = {}
    for name, camera in cameras.items():
        resized = camera.downscaled(config.render_downscale)
        prepared = prepare(gaussians, resized) if left > 0 else None
        left -= prepared.nbytes if prepared is not None else 0
        views[name] = (resized, prepared)
    return views
