"""The interface of a method: its inputs, its ablations, and how it makes a language field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.capture import View
from lexsplat.codebook import Codebook
from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.runtime.memory import DEFAULT_MEMORY
from lexsplat.runtime.progress import Listener, silent
from lexsplat.runtime.workers import IN_PROCESS, Workers

if TYPE_CHECKING:
    from torch import Tensor

    from lexsplat.language.methods.joint import JointTrainer
    from lexsplat.reconstruction import Reconstructor
    from lexsplat.runtime.training import Checkpoint

Variant = Mapping[str, Mapping[str, Any]]
"""Changes of settings by part of `lexsplat.pipeline.config.BuildConfig`: ``{"codebook": {"use_dino": False}}``."""


@dataclass(frozen=True)
class TrainingViews:
    """The training views of a capture, with what the stages before "language" made of them.

    Args:
        views: The views by name, with cameras and masks. Held-out views are not among them.
        features: Dense features by view name, for methods that need the stage "features" only.
        code_maps: Index maps ``[h, w]`` by view name, for methods that need the stage "codebook".
        codebook: The discrete feature space S of the index maps.
        shares: Share of each Gaussian's weight over all training views that these have ``[N]``, where they are chosen
            (`LanguageMethod.views_to_read`); None if nothing was chosen yet.
    """

    views: Mapping[str, View]
    features: Mapping[str, FeatureMap] | None = None
    code_maps: Mapping[str, NDArray[np.integer]] | None = None
    codebook: Codebook | None = None
    shares: Tensor | None = None

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras by view name."""
        return {name: view.camera for name, view in self.views.items()}

    def require_features(self) -> Mapping[str, FeatureMap]:
        """The features.

        Raises:
            ValueError: If there are none.
        """
        if self.features is None:
            raise ValueError("the method needs features of the training views")
        return self.features

    def require_codes(self) -> tuple[Mapping[str, NDArray[np.integer]], Codebook]:
        """The index maps and their codebook.

        Raises:
            ValueError: If either is missing.
        """
        if self.code_maps is None or self.codebook is None:
            raise ValueError("the method needs a codebook and index maps of the training views")
        return self.code_maps, self.codebook


@dataclass(frozen=True)
class FitRun:
    """How one fit runs.

    Args:
        seed: Seed of all randomness.
        memory: Host memory that the fit may take, in bytes.
        scratch: Folder for temporary files; None takes the system's.
        workers: Workers that compute sums over views.
        checkpoint: Checkpoint to save to and resume from; None saves nothing.
        listener: Receives progress events.
    """

    seed: int = 0
    memory: int = DEFAULT_MEMORY
    scratch: Path | None = None
    workers: Workers = IN_PROCESS
    checkpoint: Checkpoint | None = None
    listener: Listener = silent


class LanguageMethod(Protocol):
    """A way from Gaussians and training views to a language field."""

    @property
    def name(self) -> str:
        """Name in settings, tables and stored fields."""

    @property
    def settings(self) -> tuple[str, ...]:
        """Parts of the build settings that the result of `fit` depends on, in addition to the seed."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Stages before "language" that it needs in addition to the Gaussians, in order."""

    @property
    def stages(self) -> tuple[str, ...]:
        """All stages of a build, in the order in which they run."""

    def uses_dino(self, config: Any) -> bool:
        """Whether a build of these settings uses DINO features."""

    def feature_inputs(self, config: Any) -> list[Any]:
        """Inputs of the features in addition to photos and encoders; the name of a stage stands for its inputs."""

    def views_to_read(
        self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun
    ) -> TrainingViews:
        """Those of the training views whose features `fit` needs."""

    @property
    def variants(self) -> Mapping[str, Variant]:
        """Its ablations by name, in the order of the table; "full" changes nothing."""

    def fit(self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> LanguageField:
        """Make the language field. Builds and tables set its ``method`` to `name`.

        Args:
            gaussians: The geometry, on the device to compute on. It is not changed.
            views: The training views, with what the stages in `needs` made of them.
            config: The build settings (`lexsplat.pipeline.config.BuildConfig`), of which `settings` are read.
            run: Seed, memory, checkpoint and listener.
        """


class JointMethod(LanguageMethod, Protocol):
    """A method that trains the geometry, too (``--joint``). Its `fit` takes the language that `fit_geometry` kept."""

    def geometry_inputs(self, config: Any) -> list[Any]:
        """Inputs of its Gaussians in addition to the reconstruction's; the name of a stage stands for its inputs."""

    def geometry_outputs(self, scratch: Path) -> list[Path]:
        """Files in which `fit_geometry` keeps the language."""

    def joined(
        self, reconstructor: Reconstructor, views: TrainingViews, config: Any, seed: int
    ) -> JointTrainer:
        """The training of both, before its first step and that of the reconstruction."""

    def fit_geometry(self, training: JointTrainer, run: FitRun) -> Gaussians:
        """Run the training; returns the Gaussians and keeps the language in ``run.scratch``."""
