"""The ways to the Gaussians of a build, each an object: in one piece, in blocks, jointly with language, or given.

They are the work of the stage "reconstruct". `way_to_geometry` chooses one by the settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lexsplat.captures import Capture
from lexsplat.captures.sfm.triangulation import InitialPoints
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import World, parse_vector
from lexsplat.language.methods import JOINT_METHODS, FitRun, JointMethod, TrainingViews
from lexsplat.language.methods.joint import JointTrainer
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.splats import check_agreement, existing_splats, splats_hash, with_filter_of_photos
from lexsplat.pipeline.viewpoints import splats_of_capture
from lexsplat.reconstruction import Reconstructor, check_gaussians, compile_kernels, reconstruct, tell_time
from lexsplat.reconstruction.block_training import BlockRun, reconstruct_blocks
from lexsplat.reconstruction.blocks import number_of_blocks
from lexsplat.reconstruction.few_photos import has_few_photos, starting_points, warn_of_few_photos
from lexsplat.runtime.progress import uncounted
from lexsplat.scenes.folder import SceneFolder


@dataclass(frozen=True)
class GeometryRun:
    """Inputs of a `Geometry` in addition to the settings.

    Args:
        capture: The capture at the size to work at.
        folder: The scene folder; the way does not write its Gaussians.
        device: Device to compute on.
        fit: Seed, memory, workers, checkpoint and listener.
        key: Fingerprint of everything that the Gaussians depend on.
        codes: Reads the training views with index maps and codebook, if the stage "codebook" came before.
    """

    capture: Capture
    folder: SceneFolder
    device: str
    fit: FitRun
    key: str
    codes: Callable[[], TrainingViews]

    @property
    def checkpoints(self) -> Path:
        """Folder of the files from which the next run resumes."""
        return self.folder.root / "checkpoints"

    def initial_points(self) -> InitialPoints:
        """The points from which Gaussians start, kept for the next run."""
        fit, cache = self.fit, self.checkpoints / "points"
        return starting_points(
            self.capture, seed=fit.seed, cache_dir=cache, memory=fit.memory, listener=fit.listener
        )


class Geometry:
    """A way to the Gaussians of a build: one reconstruction of the whole capture, where no other is asked for."""

    def inputs(self, config: BuildConfig, device: str) -> list[Any]:
        """Inputs of the Gaussians other than photos and cameras. The name of a stage stands for its inputs."""
        fit = config.reconstruction
        rates = [fit.scale_of_rates] if fit.cooled_share else []  # a default that no setting holds
        return [fit, *rates, config.seed, device]

    def outputs(self, checkpoints: Path) -> list[Path]:
        """Files that it writes in addition to the Gaussians."""
        return []

    def make(self, config: BuildConfig, run: GeometryRun) -> tuple[Gaussians, dict[str, Any]]:
        """The Gaussians, and facts for the record of the stage."""
        gaussians = reconstruct(
            run.capture,
            config.reconstruction,
            device=run.device,
            seed=config.seed,
            cache_dir=run.checkpoints / "points",
            memory=run.fit.memory,
            checkpoint=run.fit.checkpoint,
            listener=run.fit.listener,
        )
        return gaussians, {}


@dataclass(frozen=True)
class _InBlocks(Geometry):
    """A reconstruction of one block after the other, or of several on workers."""

    blocks: int

    def inputs(self, config: BuildConfig, device: str) -> list[Any]:
        return [config.reconstruction, config.seed, device, f"{self.blocks} blocks", config.up]

    def make(self, config: BuildConfig, run: GeometryRun) -> tuple[Gaussians, dict[str, Any]]:
        points, fit = run.initial_points(), run.fit
        folder = run.checkpoints / "blocks"
        visits = BlockRun(run.device, config.seed, fit.memory, folder, run.key, fit.workers, fit.listener)
        world = World.of_cameras(view.camera for view in run.capture.train_views)
        if config.up is not None:
            world = world.with_up(parse_vector(config.up))
        gaussians = reconstruct_blocks(
            run.capture, config.reconstruction, points, world.up, self.blocks, visits
        )
        return gaussians, {"blocks": self.blocks}


@dataclass(frozen=True)
class _WithLanguage(Geometry):
    """A reconstruction whose every step is followed by one of the language."""

    method: JointMethod

    def inputs(self, config: BuildConfig, device: str) -> list[Any]:
        return [*super().inputs(config, device), *self.method.geometry_inputs(config)]

    def outputs(self, checkpoints: Path) -> list[Path]:
        return self.method.geometry_outputs(checkpoints)

    def make(self, config: BuildConfig, run: GeometryRun) -> tuple[Gaussians, dict[str, Any]]:
        training = joint_training(self.method, config, run)
        gaussians = self.method.fit_geometry(training, run.fit)
        if has_few_photos(run.capture):
            warn_of_few_photos(run.capture, gaussians)
        return gaussians, {"joint": True}


def joint_training(method: JointMethod, config: BuildConfig, run: GeometryRun) -> JointTrainer:
    """A training of geometry and language that is ready for its first step; logs how long it will take.

    The seed of the geometry is that of ``run.fit``, the seed of the language that of ``config``.
    """
    points, memory = run.initial_points(), run.fit.memory
    check_gaussians(config.reconstruction, run.device, memory)
    start = (run.capture, config.reconstruction, points)
    options: dict[str, Any] = {"device": run.device, "memory": memory}
    views = run.codes()

    def joined(reconstructor: Reconstructor) -> JointTrainer:
        return method.joined(reconstructor, views, config, config.seed)

    compile_kernels(run.device, run.fit.listener)
    tell_time(*start, **options, listener=run.fit.listener, joined=joined)
    return joined(Reconstructor(*start, **options, seed=run.fit.seed))


@dataclass(frozen=True)
class _Given(Geometry):
    """The Gaussians of another program, if their renders agree with the photos."""

    path: Path

    def inputs(self, config: BuildConfig, device: str) -> list[Any]:
        return [splats_hash(self.path)]

    def make(self, config: BuildConfig, run: GeometryRun) -> tuple[Gaussians, dict[str, Any]]:
        splats = existing_splats(self.path)
        with uncounted(run.fit.listener, "splats", f"beside photos {self.path.resolve()}"):
            gaussians = splats_of_capture(splats, run.capture, run.folder)
            views = list(run.capture.train_views)
            check_agreement(gaussians, views, splats)
            if run.capture.root != run.folder.root / "poses":  # chosen views have no photos
                gaussians = with_filter_of_photos(gaussians, views, splats)
        return gaussians, {"splats": str(splats.resolve())}


def way_to_geometry(config: BuildConfig, device: str, splats: Path | None) -> Geometry:
    """The way that the settings select; given splats take precedence."""
    if splats is not None:
        return _Given(splats)
    if config.joint:
        return _WithLanguage(JOINT_METHODS[config.method])
    blocks = number_of_blocks(config.blocks, config.reconstruction, device, config.memory_bytes)
    return _InBlocks(blocks) if blocks > 1 else Geometry()
