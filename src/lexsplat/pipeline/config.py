"""All settings of a build; each stage documents its own part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from lexsplat.captures.readers.video import DEFAULT_FRAMES
from lexsplat.captures.sfm.photos import PoseConfig
from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureConfig
from lexsplat.features.clip import patch_grid
from lexsplat.features.encoders import DEFAULT_CLIP, DEFAULT_DINO
from lexsplat.features.hub import present_name
from lexsplat.geometry.world import World, parse_vector
from lexsplat.language.methods import JOINT_METHODS, METHODS, LanguageMethod, MethodName
from lexsplat.language.methods.averaged import AveragedConfig
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.reconstruction import ReconstructionConfig
from lexsplat.reconstruction.blocks import number_of_blocks
from lexsplat.runtime.device import check_seed, choose_encoder_device
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.workers import check_spec

CPU_PIXELS = 80_000
"""Pixels of the working images on a CPU if no downscale is given: about 320x240."""
CUDA_PIXELS = 2_000_000
"""Pixels of the working images on CUDA if no downscale is given: 1600 wide at 4:3, as in 3DGS."""
CPU_ITERATIONS = 2_000
"""Reconstruction steps on a CPU if none are given."""
BLOCKS_ITERATIONS = 3_000
"""The same for a reconstruction in blocks, which replaces no Gaussians: fewer steps were not measured there."""
SIGHTINGS, BUNDLED_SIGHTINGS = 8, 4
"""Sightings of a Gaussian (`AveragedConfig.sightings`) if none are given: of any encoder, and of the bundled ones.

With more, neither gains; with 4, web-like encoders lose (docs/lab-notes/2026-11-language.md).
"""
PAPER_ITERATIONS = 30_000
"""Reconstruction steps of the paper."""
CUDA_ITERATIONS = PAPER_ITERATIONS
"""Reconstruction steps on CUDA if none are given, as in the paper."""


@dataclass(frozen=True)
class BuildConfig:
    """Settings of a build.

    Args:
        clip: Image-text encoder: a name on the Hugging Face Hub, a folder, or "bundled" (small, for scenes like the
            demo).
        dino: Dense encoder: a name, a folder, "bundled", or "none". Method "trained" uses it, and "averaged" where
            CLIP is read at class tokens alone (``features.crop_tokens``).
        device: Device to compute on; "auto" takes CUDA if there is a GPU.
        encoder_device: Device of the encoders; "auto" takes that of the rasterizer. With a CPU rasterizer, "cuda" or
            "mps" (the GPU of a Mac) speeds up the features.
        seed: Seed of all randomness.
        features_from: Folder with features of another program, one array a view (docs/captures.md). CLIP is then
            used for prompts only.
        memory: Host memory for photos, features and projections, such as "4GB". Libraries, encoders and Gaussians
            come on top (docs/conventions.md).
        workers: Workers for views and scenes: "none" is this process, "ray" the cluster of RAY_ADDRESS or the cores
            of this machine, "ray://HOST:PORT" a cluster (docs/scaling.md).
        blocks: Number of blocks in which the Gaussians and the photos are loaded one after the other, "auto" for as
            few as fit into the memory, or "none".
        checkpoint_seconds: Seconds between two checkpoints of a training.
        downscale: Factor by which photos are reduced for reconstruction and language; by default what suits the
            device.
        iterations: Reconstruction steps; by default 30,000 on CUDA and 2,000 on a CPU (3,000 with ``blocks``).
        frames: Number of frames sampled from a video.
        test_every: Every n-th view is held out if the capture neither lists held-out views nor has views with ground
            truth; 0 holds out none.
        up: Up direction in the axes of the cameras, as "x,y,z"; by default estimated from the cameras, or
            from splats without a capture.
        keep_floaters: Keep Gaussians that float free of all surfaces; splats without a capture lose them where there
            are many.
        views_from: From where splats without a capture are looked at: from "inside" a room, or from "around" an
            object; by default what they seem to be.
        method: "averaged" puts the features of views on each Gaussian and quantizes them there (the best in
            docs/results.md); "trained" optimizes the paper's losses. Without ``joint``, the geometry is finished
            first.
        joint: Train language together with geometry, as in the paper; needs method "trained".
        as_in_paper: Build and ask as the paper describes it (docs/paper.md): method "trained", jointly, 30,000 steps
            over full maps, random crops, rasterization without the mip filter, prompts relative to canonical phrases
            with a fixed threshold. Settings that are given otherwise are kept.
        poses: Structure from motion, for photos without cameras and for videos.
        reconstruction: Geometry and appearance.
        features: Dense CLIP and DINO features. Settings left at their default take the value that suits the encoder
            and the device; `scene.json` records it.
        codebook: Quantization.
        averaged: Method "averaged".
        trained: Method "trained".

    Raises:
        ValueError: If a value is out of range.
    """

    clip: str = DEFAULT_CLIP
    dino: str = DEFAULT_DINO
    device: Literal["auto", "cpu", "cuda"] = "auto"
    encoder_device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    seed: int = 0
    features_from: Path | None = None
    memory: str = "4GB"
    workers: str = "none"
    blocks: str = "none"
    checkpoint_seconds: float = 20.0
    downscale: float | None = None
    iterations: int | None = None
    frames: int = DEFAULT_FRAMES
    test_every: int = 8
    up: str | None = None
    keep_floaters: bool = False
    views_from: Literal["auto", "inside", "around"] = "auto"
    method: MethodName = "averaged"
    joint: bool = False
    as_in_paper: bool = False
    poses: PoseConfig = field(default_factory=PoseConfig)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    codebook: CodebookConfig = field(default_factory=CodebookConfig)
    averaged: AveragedConfig = field(default_factory=AveragedConfig)
    trained: TrainedConfig = field(default_factory=TrainedConfig)

    def __post_init__(self) -> None:
        for encoder in ("clip", "dino"):
            object.__setattr__(self, encoder, present_name(getattr(self, encoder)))
        if self.device not in ("auto", "cpu", "cuda"):
            raise ValueError(f"device must be auto, cpu or cuda, got {self.device!r}")
        if self.views_from not in ("auto", "inside", "around"):
            raise ValueError(f"views_from must be auto, inside or around, got {self.views_from!r}")
        if self.encoder_device not in ("auto", "cpu", "cuda", "mps"):
            raise ValueError(f"encoder_device must be auto, cpu, cuda or mps, got {self.encoder_device!r}")
        check_spec(self.workers)
        number_of_blocks(self.blocks, self.reconstruction, "cpu", self.memory_bytes)
        if self.joint and self.blocks != "none":
            raise ValueError("joint training takes the capture in one piece: leave --blocks out")
        check_seed(self.seed)
        if self.downscale is not None and not 0 < self.downscale < 1e6:
            raise ValueError(f"downscale must be positive, got {self.downscale:g}")
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {self.method!r}")
        if self.joint and self.method not in JOINT_METHODS:
            raise ValueError(f"joint training needs method {' or '.join(JOINT_METHODS)}, got {self.method!r}")
        if not self.checkpoint_seconds >= 0:
            raise ValueError(f"checkpoint_seconds must be at least 0, got {self.checkpoint_seconds:g}")
        if self.iterations is not None and self.iterations < 1:
            raise ValueError(f"iterations must be positive, got {self.iterations}")
        if self.features_from is not None and self.features.segments != "none":
            raise ValueError(
                "features of another program are used as they are: leave --features.segments out"
            )
        if self.features_from is not None and self.averaged.sightings:
            raise ValueError("features of another program are all read: leave --averaged.sightings out")
        if self.frames < 3:
            raise ValueError(f"frames must be at least 3, got {self.frames}")
        if self.up is not None:
            World.of_cameras([]).with_up(parse_vector(self.up))
        if self.test_every < 0 or self.test_every == 1:
            raise ValueError(f"test_every must be 0 (hold out nothing) or at least 2, got {self.test_every}")
        if self.as_in_paper and not (self.joint and self.features.mode == "random"):
            self.spelled_out()  # refuses what contradicts it

    def result_settings(self) -> BuildConfig:
        """These settings with everything that does not affect the result at its default, for fingerprints.

        Memory, workers, checkpoints, the device of the encoders, settings of methods that are not used, and features
        that take no part.
        """
        used = self.language_method.settings
        unused = {part for method in METHODS.values() for part in method.settings} - set(used)
        usual = BuildConfig()
        idle: dict[str, Any] = {
            name: getattr(usual, name)
            for name in unused | {"memory", "workers", "blocks", "checkpoint_seconds", "encoder_device"}
        }
        return replace(self, features=self.features.result_settings(use_dino=self.uses_dino), **idle)

    @cached_property
    def memory_bytes(self) -> int:
        """`memory` in bytes."""
        return parse_bytes(self.memory)

    @property
    def uses_dino(self) -> bool:
        """Whether DINO features take part."""
        return self.dino != "none" and self.language_method.uses_dino(self)

    @property
    def language_method(self) -> LanguageMethod:
        """The method as an object."""
        return (JOINT_METHODS if self.joint else METHODS)[self.method]

    def refuse_beside_splats(self) -> None:
        """Refuse settings of the reconstruction if Gaussians are given.

        Raises:
            ValueError: If there is such a setting.
        """
        if self.joint:
            raise ValueError("joint training makes its own Gaussians: leave --splats out, or --joint")

    def spelled_out(self) -> BuildConfig:
        """With `as_in_paper`, the settings that it stands for; otherwise the same."""
        if not self.as_in_paper:
            return self
        return replace(
            self,
            method="trained",
            joint=True,
            iterations=self.iterations or PAPER_ITERATIONS,
            reconstruction=replace(self.reconstruction, antialiased=False),
            features=replace(self.features, mode="random"),
            codebook=self.codebook.as_in_paper(),
            trained=self.trained.as_in_paper(),
        )

    def resolved(self, device: str, capture_size: tuple[int, int]) -> BuildConfig:
        """The same settings with every open choice made.

        What depends on the architecture of CLIP is chosen by its configuration, so the model has to be on this
        machine (`lexsplat.features.hub.model_folder`).

        Args:
            device: "cpu" or "cuda".
            capture_size: Width and height of the largest photo.

        Raises:
            BackendError: If the device of the encoders is not available.
        """
        encoder_device = choose_encoder_device(self.encoder_device, device)
        downscale = self.downscale
        if downscale is None:
            pixels = CPU_PIXELS if device == "cpu" else CUDA_PIXELS
            factor = math.sqrt(capture_size[0] * capture_size[1] / pixels)
            # Halves keep the numbers readable; never enlarge.
            downscale = max(1.0, round(factor * 2) / 2)
        features = self.features
        if self.clip == "bundled":
            features = features.on_top_of(FeatureConfig.bundled())
        else:
            reads_patches = features.mode == "grid" and features.crop_tokens != "class"
            patches = patch_grid(self.clip) if reads_patches else 0
            features = features.on_top_of(FeatureConfig.suited(patches, sparse=encoder_device != "cuda"))
        averaged = self.averaged
        if averaged.dino is None:
            with_dino = features.tokens == "class" and self.dino != "none" and self.features_from is None
            averaged = replace(averaged, dino=with_dino)
        if averaged.sightings is None:
            wanted = BUNDLED_SIGHTINGS if self.clip == "bundled" else SIGHTINGS
            averaged = replace(averaged, sightings=wanted if self.features_from is None else 0)
        iterations = self.iterations
        if iterations is None and self.reconstruction.iterations != ReconstructionConfig.iterations:
            iterations = self.reconstruction.iterations  # set from Python
        if iterations is None:
            steps = CPU_ITERATIONS if self.blocks == "none" else BLOCKS_ITERATIONS
            iterations = steps if device == "cpu" else CUDA_ITERATIONS
        return replace(
            self,
            device=device,  # type: ignore[arg-type]
            encoder_device=encoder_device,  # type: ignore[arg-type]
            downscale=downscale,
            iterations=iterations,
            features=features,
            averaged=averaged,
            reconstruction=replace(self.reconstruction, iterations=iterations),
        )
