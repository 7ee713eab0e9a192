"""Method "trained": the paper's losses, Eq. 8 to 15 (section 3.4), on one random training view a step.

The geometry is finished first and frozen. With ``--joint``, both are trained together as in the paper
(`lexsplat.language.methods.joint`).
"""

from __future__ import annotations

from collections.abc import Mapping
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
from lexsplat.runtime.memory import DEFAULT_MEMORY, kept_bytes
from lexsplat.runtime.progress import Event, Listener, silent, tell
from lexsplat.runtime.sampling import evenly
from lexsplat.runtime.training import run_training, time_steps

if TYPE_CHECKING:
    from lexsplat.runtime.training import Checkpoint

REPORT_EVERY = 25
"""Steps between two events. The loss is checked as often."""

_TOLD_FROM = 200
"""Fewest iterations with a forecast."""
_FIRST, _STEPS = 2, 6
"""Steps of the calibration that are not timed, and that are."""


class Trained:
    """The method as an object (`lexsplat.language.methods.LanguageMethod`)."""

    name = "trained"
    settings = ("codebook", "trained")
    needs = ("features", "codebook")
    stages: tuple[str, ...] = ("reconstruct", *needs, "language")
    variants: Mapping[str, Variant] = {  # the rows of the paper's Table 2, in its order
        "w/o DINO": {"codebook": {"use_dino": False}},
        "w/o L_lb": {"codebook": {"load_balancing": False}},
        "w/o u_G": {"trained": {"use_uncertainty": False}},
        "w/o MLP": {"trained": {"use_smoothing": False}},
        "w/o u_G & MLP": {"trained": {"use_uncertainty": False, "use_smoothing": False}},
        "full": {},
    }

    def uses_dino(self, config: Any) -> bool:
        """Always: index maps are made with both halves."""
        return True

    def feature_inputs(self, config: Any) -> list[Any]:
        """None: the index maps of all views are needed."""
        return []

    def views_to_read(
        self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun
    ) -> TrainingViews:
        """All of them."""
        return views

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


# In addition to its inputs: the options of a run.
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
        memory: Host memory in bytes, `kept_bytes` of it for projections; the result does not depend on it.
        checkpoint: Checkpoint to save to and resume from; None saves nothing.

    Raises:
        ValueError: If there is no view, or a view has no index map.
        TrainingError: If the training diverges again and again.
    """
    check_views(sorted(cameras), code_maps)
    if config.iterations >= _TOLD_FROM:

        def report(done: int) -> None:
            listener(Event("calibrate", done, _FIRST + _STEPS))

        def of_few_views() -> _FrozenGeometryTraining:  # freed after its last step
            some = dict(evenly(sorted(cameras.items()), _FIRST + _STEPS))
            trainer = FieldTrainer(gaussians, codebook, config, seed=seed)
            views = _prepare_views(trainer.gaussians, some, config, memory)
            return _FrozenGeometryTraining(trainer, views, code_maps)

        report(0)
        seconds = config.iterations * time_steps(of_few_views(), _FIRST, _STEPS, report)
        tell("language", seconds, f"{config.iterations:,} iterations")
    trainer = FieldTrainer(gaussians, codebook, config, seed=seed)
    views = _prepare_views(trainer.gaussians, cameras, config, memory)
    run_training(
        _FrozenGeometryTraining(trainer, views, code_maps),
        stage="language",
        name="language field",
        every=REPORT_EVERY,
        checkpoint=checkpoint,
        listener=listener,
    )
    return trainer.field


class _FrozenGeometryTraining:
    """A `FieldTrainer` with its views, as `run_training` steps it."""

    parameter_prefixes: tuple[str, ...] = FieldTrainer.parameter_prefixes

    def __init__(
        self,
        trainer: FieldTrainer,
        views: Mapping[str, tuple[Camera, PreparedView | None]],
        code_maps: Mapping[str, NDArray[np.integer]],
    ) -> None:
        self.trainer, self._views, self._code_maps = trainer, views, code_maps
        self.device, self.total_steps = trainer.gaussians.device, trainer.config.iterations
        self.metrics: dict[str, float] = {}
        self.state_dict, self.load_state_dict = trainer.state_dict, trainer.load_state_dict
        self.find_invalid = trainer.find_invalid

    @property
    def steps_done(self) -> int:
        return self.trainer.iteration

    @property
    def rate_factor(self) -> float:
        return self.trainer.rate_factor

    @rate_factor.setter
    def rate_factor(self, factor: float) -> None:
        self.trainer.rate_factor = factor

    def step(self) -> None:
        name = self.trainer.view_of_step(sorted(self._views))
        camera, prepared = self._views[name]
        losses = self.trainer.step(camera, self._code_maps[name], prepared=prepared)
        done = self.trainer.iteration
        if done % REPORT_EVERY == 0 or done == self.total_steps:  # reading losses synchronizes a GPU
            self.metrics = {key: float(value) for key, value in losses.items()}
            self.trainer.check_loss(self.metrics["loss"])


def _prepare_views(
    gaussians: Gaussians, cameras: Mapping[str, Camera], config: TrainedConfig, memory: int
) -> dict[str, tuple[Camera, PreparedView | None]]:
    """Cameras at the size to render, each with its projection as long as memory lasts (geometry is fixed)."""
    left = kept_bytes(memory)
    views: dict[str, tuple[Camera, PreparedView | None]] = {}
    for name, camera in cameras.items():
        resized = camera.downscaled(config.render_downscale)
        prepared = prepare(gaussians, resized) if left > 0 else None
        left -= prepared.nbytes if prepared is not None else 0
        views[name] = (resized, prepared)
    return views
