"""All settings of a build in one place; each stage owns and documents its part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from lexsplat.captures.readers.video import DEFAULT_FRAMES
from lexsplat.captures.sfm.photos import PoseConfig
from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureConfig
from lexsplat.features.encoders import DEFAULT_CLIP, DEFAULT_DINO
from lexsplat.geometry.world import World, parse_vector
from lexsplat.language.methods.averaged import AveragedConfig
from lexsplat.language.methods.lifted import LiftedConfig, TuningConfig
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.reconstruction import ReconstructionConfig
from lexsplat.runtime.device import check_seed
from lexsplat.runtime.memory import parse_bytes

CPU_PIXELS = 80_000
"""Working image size on a CPU when no downscale is given: about 320x240."""
CUDA_PIXELS = 2_000_000
"""Working image size on CUDA when no downscale is given: 1600 pixels wide at 4:3, as 3DGS does."""
CPU_ITERATIONS = 3_000
"""Reconstruction steps on a CPU when none are given."""
CUDA_ITERATIONS = 30_000
"""Reconstruction steps on CUDA when none are given: the paper's number."""


LanguageMethod = Literal["averaged", "trained", "lifted", "lifted+tuned"]
"""Ways to language on the Gaussians."""


@dataclass(frozen=True)
class BuildConfig:
    """Everything that decides what a build makes.

    Args:
        clip: Image-text encoder: a name on the Hugging Face Hub, a folder, or "bundled" (small, made by us,
            knows only scenes like the demo).
        dino: Dense encoder, in the same way, or "none" (the paper's ablation without DINO).
        device: "auto" takes CUDA where there is a GPU.
        seed: Seed of all randomness.
        features_from: Folder with features made by another program, one array a view, in place of our own
            (docs/captures.md); of the encoders only the words of `clip` are used then.
        memory: Host memory that photos, features and projections kept by any stage may take, such as "4GB"; beside
            it comes what the libraries, the encoders and the Gaussians themselves need (docs/conventions.md).
        checkpoint_seconds: Seconds between two savings of a training that is under way.
        downscale: Factor by which photos are made smaller for reconstruction and language; none chooses one
            that suits the device.
        iterations: Reconstruction steps; none means 30,000 on CUDA and 3,000 on a CPU.
        frames: How many frames a video is sampled to.
        test_every: Every n-th view is held out where the capture does not say which (0 holds out none).
        up: Direction away from the ground in the cameras' axes, as "x,y,z"; none takes it from how the cameras were
            held.
        method: "averaged" puts the features of all views on each Gaussian and quantizes them there: the best by our
            measurements (docs/results.md). "lifted" computes each Gaussian's codes from those of the views, as fast.
            "trained" is the paper's optimization, "lifted+tuned" starts the paper's field from the lifted one.
        joint: Train language together with geometry from the first step, as the authors' code does (with
            method "trained"; its steps are then those of the reconstruction).
        poses: Structure from motion, for photos without cameras and videos.
        reconstruction: Geometry and appearance.
        features: Dense CLIP and DINO features. What is left at its default takes the value that suits the encoder and
            the device; `scene.json` has the values that were taken.
        codebook: Quantization.
        averaged: Features of all views on the Gaussians, and codes for them.
        trained: Training of the language field.
        lifted: Computing the language field from the codes of the views.
        tuning: From the lifted field to the paper's form.

    Raises:
        ValueError: If a number makes no sense.
    """

    clip: str = DEFAULT_CLIP
    dino: str = DEFAULT_DINO
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    features_from: Path | None = None
    memory: str = "4GB"
    checkpoint_seconds: float = 20.0
    downscale: float | None = None
    iterations: int | None = None
    frames: int = DEFAULT_FRAMES
    test_every: int = 8
    up: str | None = None
    method: LanguageMethod = "averaged"
    joint: bool = False
    poses: PoseConfig = field(default_factory=PoseConfig)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    codebook: CodebookConfig = field(default_factory=CodebookConfig)
    averaged: AveragedConfig = field(default_factory=AveragedConfig)
    trained: TrainedConfig = field(default_factory=TrainedConfig)
    lifted: LiftedConfig = field(default_factory=LiftedConfig)
    tuning: TuningConfig = field(default_factory=TuningConfig)

    def __post_init__(self) -> None:
        for encoder in ("clip", "dino"):
            if getattr(self, encoder) == "embedded":  # the word before "bundled"
                object.__setattr__(self, encoder, "bundled")
        parse_bytes(self.memory)
        check_seed(self.seed)
        if self.downscale is not None and not 0 < self.downscale < 1e6:
            raise ValueError(f"downscale must be positive, got {self.downscale:g}")
        if self.joint and self.method != "trained":
            raise ValueError(f'joint training needs method "trained", got {self.method!r}')
        if not self.checkpoint_seconds >= 0:
            raise ValueError(f"checkpoint_seconds must be at least 0, got {self.checkpoint_seconds:g}")
        if self.iterations is not None and self.iterations < 1:
            raise ValueError(f"iterations must be positive, got {self.iterations}")
        if self.frames < 3:
            raise ValueError(f"frames must be at least 3, got {self.frames}")
        if self.up is not None:
            World.of_cameras([]).with_up(parse_vector(self.up))
        if self.test_every < 0 or self.test_every == 1:
            raise ValueError(f"test_every must be 0 (hold out nothing) or at least 2, got {self.test_every}")

    def within_memory(self) -> BuildConfig:
        """The same settings with the store of every stage bounded by a quarter of `memory`.

        What does not fit is read or computed again when it is needed: results do not depend on the bound.
        """
        whole = parse_bytes(self.memory)
        projections = min(self.trained.memory_bytes, whole // 4)
        histogram = max(1, min(self.lifted.memory_bytes, whole // 4))
        return replace(
            self,
            trained=replace(self.trained, memory_bytes=projections),
            averaged=replace(self.averaged, memory_bytes=max(1, min(self.averaged.memory_bytes, whole // 4))),
            lifted=replace(self.lifted, memory_bytes=histogram),
        )

    def decisive(self) -> BuildConfig:
        """What fingerprints hold: these settings, with those at their defaults that decide nothing about the result.

        How much is kept in memory, the ways to the language that are not taken, the crops of the other mode.
        """
        kept = {
            "trained": {"memory_bytes": TrainedConfig.memory_bytes},
            "averaged": {"memory_bytes": AveragedConfig.memory_bytes},
            "lifted": {"memory_bytes": LiftedConfig.memory_bytes},
        }
        parts = {name: replace(getattr(self, name), **fields) for name, fields in kept.items()}
        unused: dict[str, dict[str, Any]] = {
            "averaged": {
                "trained": TrainedConfig(),
                "lifted": LiftedConfig(),
                "tuning": TuningConfig(),
            },
            "lifted": {
                "averaged": AveragedConfig(),
                "trained": TrainedConfig(),
                "tuning": TuningConfig(),
            },
            "trained": {"averaged": AveragedConfig(), "lifted": LiftedConfig(), "tuning": TuningConfig()},
            "lifted+tuned": {"averaged": AveragedConfig()},
        }
        parts |= unused[self.method]
        return replace(self, features=self.features.result_settings(use_dino=self.uses_dino), **parts)

    @property
    def uses_dino(self) -> bool:
        """Whether the language is made of dense features too: averaged features are quantized without."""
        return self.dino != "none" and self.method != "averaged"

    def resolved(self, device: str, capture_size: tuple[int, int]) -> BuildConfig:
        """The same settings with nothing left open.

        Args:
            device: "cpu" or "cuda".
            capture_size: Width and height of the largest photo.
        """
        downscale = self.downscale
        if downscale is None:
            pixels = CPU_PIXELS if device == "cpu" else CUDA_PIXELS
            factor = math.sqrt(capture_size[0] * capture_size[1] / pixels)
            # Halves keep the numbers readable; never enlarge.
            downscale = max(1.0, round(factor * 2) / 2)
        features = self.features
        if self.clip == "bundled" or device == "cpu":
            suited = FeatureConfig.bundled() if self.clip == "bundled" else FeatureConfig.sparse()
            features = features.on_top_of(suited)
        iterations = self.iterations
        if iterations is None and self.reconstruction.iterations != ReconstructionConfig.iterations:
            iterations = self.reconstruction.iterations  # set from Python
        if iterations is None:
            iterations = CPU_ITERATIONS if device == "cpu" else CUDA_ITERATIONS
        return replace(
            self,
            device=device,  # type: ignore[arg-type]
            downscale=downscale,
            iterations=iterations,
            features=features,
            reconstruction=replace(self.reconstruction, iterations=iterations),
        )
