"""Training the language field (section 3.4): Eq. 8 to 15, one random training view a step, geometry frozen."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MASKED_CODE, check_views, codes_at_pixels
from lexsplat.language.fields import TrainedField
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.rendering import PreparedView, prepare
from lexsplat.runtime.divergence import KEEP_EVERY, Guard
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.runtime.checkpoints import Checkpoint

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
    if checkpoint is not None:
        checkpoint.resume(trainer)
    views = _prepare_views(trainer.gaussians, cameras, config)
    guard = Guard(trainer, "language field", every=KEEP_EVERY[gaussians.device.type])
    with nullcontext() if checkpoint is None else checkpoint.guarding():
        while trainer.iteration < config.iterations:
            with guard:
                name = trainer.view_of_step(names)
                camera, prepared = views[name]
                losses = trainer.step(camera, code_maps[name], prepared=prepared)
                done = trainer.iteration
                if done % REPORT_EVERY == 0 or done == config.iterations:
                    metrics = {key: float(value) for key, value in losses.items()}
                    trainer.check_loss(metrics["loss"])
                    listener(Event("language", done, config.iterations, metrics))
                guard.after_step(done == config.iterations)
                if checkpoint is not None:
                    checkpoint.after_step(trainer)
    return trainer.field


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
