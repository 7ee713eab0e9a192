"""Method "trained", the paper's: Eq. 8 to 15 (section 3.4), one random training view a step, geometry frozen."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import check_views
from lexsplat.language.fields import TrainedField
from lexsplat.language.methods.method import FitRun, TrainingViews, Variant
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.rendering import PreparedView, prepare
from lexsplat.runtime.divergence import KEEP_EVERY, Guard
from lexsplat.runtime.memory import DEFAULT_MEMORY
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.runtime.checkpoints import Checkpoint

REPORT_EVERY = 25
"""Steps between two events. The loss is checked as often."""

MAX_STORE = 1 << 30
"""Bytes that kept projections may take at most, however much memory there is."""


class Trained:
    """The method as an object (`lexsplat.language.methods.LanguageMethod`)."""

    name = "trained"
    settings = ("codebook", "trained")
    needs = ("features", "codebook")
    uses_dino = True
    trains_jointly = True
    variants: Mapping[str, Variant] = {  # the rows of the paper's Table 2, in its order
        "w/o DINO": {"codebook": {"use_dino": False}},
        "w/o L_lb": {"codebook": {"load_balancing": False}},
        "w/o u_G": {"trained": {"use_uncertainty": False}},
        "w/o MLP": {"trained": {"use_smoothing": False}},
        "w/o u_G & MLP": {"trained": {"use_uncertainty": False, "use_smoothing": False}},
        "full": {},
    }

    def fit(self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> TrainedField:
        """Train the paper's field on the index maps of the training views."""
        code_maps, codebook = views.require_codes()
        return train_field(
            gaussians,
            views.cameras,
            code_maps,
            codebook,
            config.trained,
            seed=run.seed,
            memory=run.memory,
            checkpoint=run.checkpoint,
            listener=run.listener,
        )


# Beside its inputs: the options of a run, and a trainer to continue.
def train_field(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    code_maps: Mapping[str, NDArray[np.integer]],
    codebook: Codebook,
    config: TrainedConfig,
    *,
    seed: int = 0,
    listener: Listener = silent,
    memory: int = DEFAULT_MEMORY,
    trainer: FieldTrainer | None = None,
    checkpoint: Checkpoint | None = None,
) -> TrainedField:
    """Train the paper's language field on frozen Gaussians.

    Args:
        gaussians: The geometry, which is not changed.
        cameras: Cameras of the training views by name.
        code_maps: Index maps by view name; other views are ignored.
        codebook: The discrete feature space S.
        config: Settings.
        seed: Seed of the initial field, the order of views and the samples.
        listener: Receives events of stage "language" with the losses.
        memory: Host memory in bytes, a quarter of which projections kept between steps may take (at most
            `MAX_STORE`). The result does not depend on it.
        trainer: A trainer to continue; None starts a new one.
        checkpoint: Where the training is saved and resumed from; None saves nothing.

    Raises:
        ValueError: If there is no view, or a view has no index map.
        TrainingError: If the training diverges again and again.
    """
    names = sorted(cameras)
    check_views(names, code_maps)
    trainer = trainer or FieldTrainer(gaussians, codebook, config, seed=seed)
    if checkpoint is not None:
        checkpoint.resume(trainer)
    views = _prepare_views(trainer.gaussians, cameras, config, memory)
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
    gaussians: Gaussians, cameras: Mapping[str, Camera], config: TrainedConfig, memory: int
) -> dict[str, tuple[Camera, PreparedView | None]]:
    """Cameras at the size to render, each with its projection as long as memory lasts (geometry is fixed)."""
    left = min(MAX_STORE, memory // 4)
    views: dict[str, tuple[Camera, PreparedView | None]] = {}
    for name, camera in cameras.items():
        resized = camera.downscaled(config.render_downscale)
        prepared = prepare(gaussians, resized) if left > 0 else None
        left -= prepared.nbytes if prepared is not None else 0
        views[name] = (resized, prepared)
    return views
