"""Language trained together with geometry from the first step, as in the paper (Fig. 2, section 4) and its code.

By default language is trained on finished geometry. In joint training every geometry step on a view is followed by a
language step on the same view. The geometry is detached in both. When density control copies,
splits or removes a Gaussian, its language is copied or removed with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import check_views
from lexsplat.language.fields import TrainedField
from lexsplat.language.methods.method import FitRun, TrainingViews
from lexsplat.language.methods.trained import Trained
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.reconstruction import EVENT_EVERY, STAGE, Reconstructor
from lexsplat.reconstruction.optimizers import below_prefix, with_prefix
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.progress import Listener, silent
from lexsplat.runtime.training import Checkpoint, run_training


class TrainedJointly(Trained):
    """The method as an object (`lexsplat.language.methods.JointMethod`)."""

    stages = (*Trained.needs, "reconstruct", "language")

    def geometry_inputs(self, config: Any) -> list[Any]:
        """Inputs of the language, which is trained together with the geometry."""
        return ["codebook", config.trained]

    def geometry_outputs(self, scratch: Path) -> list[Path]:
        """The field."""
        return [scratch / "joint_language.safetensors"]

    def joined(
        self, reconstructor: Reconstructor, views: TrainingViews, config: Any, seed: int
    ) -> JointTrainer:
        """A `JointTrainer` with the index maps of the training views."""
        return JointTrainer(reconstructor, views.cameras, *views.require_codes(), config.trained, seed=seed)

    def fit_geometry(self, training: JointTrainer, run: FitRun) -> Gaussians:
        """Train both and keep the field.

        Raises:
            ValueError: If there is no scratch folder.
        """
        training.run(run.listener, run.checkpoint)
        gaussians, field = training.result()
        write_tensors(self._kept(run), field.tensors(), field.metadata())
        return gaussians

    def fit(self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> TrainedField:
        """The field that `fit_geometry` kept."""
        return TrainedField.from_tensors(*read_tensors(self._kept(run)))

    def _kept(self, run: FitRun) -> Path:
        if run.scratch is None:
            raise ValueError("joint training needs a scratch folder that lasts")
        return self.geometry_outputs(run.scratch)[0]


class JointTrainer:
    """A reconstruction and the training of its language, step by step.

    Args:
        reconstructor: The reconstruction, before its first step.
        cameras: Cameras of the training views by name.
        code_maps: Index maps by view name.
        codebook: The discrete feature space S.
        config: Settings of the language; the number of steps is that of the reconstruction.
        seed: Seed of the initial field and of all samples.

    Raises:
        ValueError: If there is no view, or a view has no index map.
    """

    parameter_prefixes: tuple[str, ...] = (
        *(f"geometry/{prefix}" for prefix in Reconstructor.parameter_prefixes),
        *(f"language/{prefix}" for prefix in FieldTrainer.parameter_prefixes),
    )

    def __init__(
        self,
        reconstructor: Reconstructor,
        cameras: Mapping[str, Camera],
        code_maps: Mapping[str, NDArray[np.integer]],
        codebook: Codebook,
        config: TrainedConfig,
        *,
        seed: int = 0,
    ) -> None:
        check_views(sorted(cameras), code_maps)
        reconstructor.tracks_origins = True
        self.reconstructor, self.code_maps = reconstructor, code_maps
        self.codebook, self.seed = codebook, seed
        self.device, self.total_steps = reconstructor.device, reconstructor.total_steps
        self.config = replace(config, iterations=reconstructor.config.iterations)
        self.cameras = {name: camera.downscaled(config.render_downscale) for name, camera in cameras.items()}
        self.language = FieldTrainer(reconstructor.gaussians(), codebook, self.config, seed=seed)
        self._losses = {"loss": float("nan")}

    @property
    def steps_done(self) -> int:
        """Number of finished steps."""
        return self.reconstructor.steps_done

    @property
    def metrics(self) -> dict[str, float]:
        """Those of the reconstruction, and the loss of the language."""
        return {**self.reconstructor.metrics, "language": self._losses["loss"]}

    def step(self) -> dict[str, float]:
        """One iteration of both on one view; returns the losses of the language, on a GPU those that were read last.

        Raises:
            TrainingError: If a loss is no longer finite.
        """
        self.reconstructor.step()
        gaussians = self.reconstructor.gaussians()
        if self.reconstructor.origins is not None:
            self.language.replace_gaussians(gaussians, self.reconstructor.origins)
        self.language.gaussians = gaussians
        name = self.reconstructor.last_view
        losses = self.language.step(self.cameras[name], self.code_maps[name])
        done = self.reconstructor.steps_done
        if self.reconstructor.reads_loss(done):
            self._losses = {key: float(value) for key, value in losses.items()}
            self.language.check_loss(self._losses["loss"])
        return self._losses

    @property
    def rate_factor(self) -> float:
        """Factor of all learning rates (`lexsplat.runtime.training`)."""
        return self.reconstructor.rate_factor

    @rate_factor.setter
    def rate_factor(self, factor: float) -> None:
        self.reconstructor.rate_factor = self.language.rate_factor = factor

    def find_invalid(self) -> str:
        """The first defect of the parameters; empty if there is none."""
        return self.reconstructor.find_invalid() or self.language.find_invalid()

    def run(self, listener: Listener = silent, checkpoint: Checkpoint | None = None) -> None:
        """Run the remaining steps; ``checkpoint`` resumes the training and saves it between steps."""
        run_training(
            self,
            stage=STAGE,
            name="joint training",
            every=EVENT_EVERY,
            checkpoint=checkpoint,
            listener=listener,
        )

    def result(self) -> tuple[Gaussians, TrainedField]:
        """The current Gaussians and their language."""
        return self.reconstructor.gaussians(), self.language.field

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that an exact continuation needs."""
        geometry = with_prefix("geometry/", self.reconstructor.state_dict())
        return {**geometry, **with_prefix("language/", self.language.state_dict())}

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        """The inverse of `state_dict`, for a trainer made with the same inputs.

        Raises:
            ValueError: If the state does not fit.
        """
        self.reconstructor.load_state_dict(below_prefix("geometry/", state))
        gaussians = self.reconstructor.gaussians()
        self.language = FieldTrainer(gaussians, self.codebook, self.config, seed=self.seed)
        self.language.load_state_dict(below_prefix("language/", state))
