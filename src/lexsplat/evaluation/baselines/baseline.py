"""The protocol of compared methods, `Baseline`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from lexsplat.evaluation.baselines.feature_rendering import TrainingData
from lexsplat.evaluation.methods import Method
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.memory import DEFAULT_MEMORY
from lexsplat.runtime.progress import Listener, silent


@dataclass(frozen=True)
class BaselineRun:
    """How one fit runs.

    Args:
        cameras: The cameras of all views by name, held-out ones too.
        classes: Text embeddings ``[K, D]`` of the prompts of the evaluation, for a baseline that knows them.
        seed: Seed of all randomness.
        memory: Memory budget in bytes; results do not depend on it.
        listener: Receives progress events.
    """

    cameras: Mapping[str, Camera]
    classes: Tensor | None = None
    seed: int = 0
    memory: int = DEFAULT_MEMORY
    listener: Listener = silent


class Baseline(Protocol):
    """A method of another paper on our Gaussians and features."""

    @property
    def name(self) -> str:
        """Name in tables and options."""

    @property
    def settings(self) -> Any:
        """Everything except the seed that the result of `fit` depends on; None if nothing."""

    @property
    def knows_prompts(self) -> bool:
        """Whether the prompts of the evaluation are known to it in advance, as classes."""

    @property
    def needs_crop_sizes(self) -> bool:
        """Whether it reads features of several crop sizes (`TrainingData.level_maps`)."""

    def fit(self, data: TrainingData, run: BaselineRun) -> Method:
        """Make the object that answers prompts."""
