"""From a capture to a scene: the stages in order, each done once and kept.

A stage is repeated only when something it depends on has changed: its record in ``scene.json`` holds a fingerprint of
the photos, the cameras, its settings and the stages before it.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from lexsplat.captures import Capture, View, load_annotations
from lexsplat.captures.sfm.triangulation import InitialPoints, initial_points
from lexsplat.codebook import Codebook, assign_code_maps, code_usage, fit_codebook, tell_codebook
from lexsplat.features import FeatureMaps
from lexsplat.geometry.world import World, parse_vector
from lexsplat.language.code_maps import MaskedCodeMaps, mark_masked_cells
from lexsplat.language.methods import METHODS, FitRun, TrainingViews
from lexsplat.language.methods.joint import JointTrainer
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.distribution import extract_on_workers
from lexsplat.pipeline.encoding import Encoders, check_encoders, feature_maps, fetch_clip
from lexsplat.pipeline.inputs import (
    PhotoSurvey,
    check_given_maps,
    check_photos,
    prepare_capture,
    refuse_without_cameras,
    survey_photos,
)
from lexsplat.pipeline.provenance import features_identity, model_place, with_full_paths, write_provenance
from lexsplat.pipeline.splats import check_agreement, existing_splats, splats_hash
from lexsplat.pipeline.viewpoints import capture_of_splats, splats_of_capture
from lexsplat.pipeline.viewpoints.choosing import SIZE
from lexsplat.reconstruction import Reconstructor, check_gaussians, reconstruct, tell_time
from lexsplat.reconstruction.block_training import BlockRun, reconstruct_blocks
from lexsplat.reconstruction.blocks import number_of_blocks
from lexsplat.rendering.backends import require_gsplat
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import choose_device, choose_encoder_device
from lexsplat.runtime.errors import (
    CaptureError,
    FileFormatError,
    MemoryBudgetError,
    ModelError,
)
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Event, Listener, silent, uncounted
from lexsplat.runtime.training import Checkpoint
from lexsplat.runtime.workers import IN_PROCESS, SharedFolder, Workers, open_workers
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.foreign import warnings_once
from lexsplat.scenes.kept import keep_for
from lexsplat.scenes.previous import drop_previous

STAGES = ("reconstruct", "features", "codebook", "language")
"""Names of all stages. A method may not need the codebook, and joint training reconstructs after it."""


def build(
    source: str | Path | None,
    output: str | Path,
    config: BuildConfig | None = None,
    *,
    until: str = "language",
    test_names: list[str] | None = None,
    splats: Path | None = None,
    listener: Listener = silent,
) -> SceneFolder:
    """Make a scene from a capture, or resume an earlier build.

    Args:
        source: Folder with photos and cameras (COLMAP or ``transforms.json``) or with photos alone, or a video. None
            chooses views of ``splats`` and renders them.
        output: Scene folder to make or to resume.
        config: Settings; open ones are chosen to suit the device. None takes the defaults.
        until: Last stage to run, one of `STAGES`.
        test_names: Names of the held-out views; None takes those of the capture, or else every n-th view.
        splats: File of Gaussians that replace the reconstruction.
        listener: Receives progress events of every stage.

    Raises:
        LexsplatError: If anything in the capture, the models or the output folder is wrong, or the device cannot be
            used.
        ValueError: If ``until`` is not a stage, ``splats`` are given for joint training, or there is neither a source
            nor ``splats``.
    """
    source, config = None if source is None else Path(source), (config or BuildConfig()).spelled_out()
    _check_request(source, splats, until, config)
    if config.workers != "none":  # workers may have another working folder
        output, config = Path(output).absolute(), with_full_paths(config)
        source, splats = (None if path is None else path.absolute() for path in (source, splats))
    device = choose_device(config.device)
    config = replace(config, encoder_device=choose_encoder_device(config.encoder_device, device))  # type: ignore[arg-type]
    if device == "cuda":
        require_gsplat()  # before anything that takes time
    folder = SceneFolder(Path(output))
    folder.refuse_foreign_files()
    is_new = not folder.root.exists()
    above = [place for place in folder.root.absolute().parents if not place.exists()]
    given = (source,) if source is not None and source.is_dir() else ()  # of a video workers get the frames
    with open_workers(config.workers, given) as workers, folder.locked(), warnings_once():
        try:
            # Errors in ground truth and encoders are reported before structure from motion, not after it.
            photos: PhotoSurvey | None = PhotoSurvey(0, SIZE)
            if source is not None:
                photos = survey_photos(source, folder.root, config, test_names)
            encodes = until != "reconstruct" and "features" not in folder.record["stages"]
            another = folder.record.get("config", {}).get("clip") != model_place(config.clip)
            if encodes or (another and until != "reconstruct"):  # its architecture decides settings
                fetch_clip(config)
            checked: Encoders | None = None
            if photos is not None and encodes:
                sized = config.resolved(device, photos.size)
                checked = check_encoders(sized, source or splats, photos.count, photos.size, listener)
            if source is None:
                capture = capture_of_splats(splats, folder, config, device, listener)
            else:
                capture = prepare_capture(source, folder, config, test_names, listener)
            load_annotations(capture)
            sizes = [view.capture_size for view in capture.views.values()]
            config = config.resolved(device, max(sizes, key=lambda size: size[0] * size[1]))
            capture = capture.downscaled(config.downscale or 1.0)
            check_photos(capture, parse_bytes(config.memory))
            check_given_maps(config, capture)
            builder = _Builder(capture, folder, config, device, listener, splats)
            builder.encoders, builder.workers = checked, workers
            SharedFolder.forget_marks(folder.root / "checkpoints")
            workers.require((capture.root,))
            return builder.run(until)
        except (CaptureError, FileFormatError, ModelError, MemoryBudgetError, OSError):
            if is_new:  # the lock is held, so nobody else uses the folder
                folder.withdraw(above)
            raise


def _check_request(source: Path | None, splats: Path | None, until: str, config: BuildConfig) -> None:
    """Refuse what cannot be built, before anything is written; the errors are those of `build`."""
    if until not in STAGES:
        raise ValueError(f"until must be one of {', '.join(STAGES)}, got {until!r}")
    if source is None and splats is None:
        raise ValueError("a build needs a capture or splats")
    if config.joint and splats is not None:
        raise ValueError("joint training makes its own Gaussians: leave --splats out")
    if splats is not None:
        existing_splats(splats)
        if source is not None:
            refuse_without_cameras(source)


@dataclass(frozen=True)
class _Stage:
    """One stage of a build.

    Args:
        inputs: Everything its result depends on. The name of an earlier stage stands for all inputs of that stage.
        work: Does it; returns facts for its record.
        outputs: What it writes.
    """

    inputs: list[Any]
    work: Callable[[], dict[str, Any]]
    outputs: list[Path]


class _Builder:
    """The stages of one build. ``fingerprints`` holds those of the stages done so far."""

    def __init__(
        self,
        capture: Capture,
        folder: SceneFolder,
        config: BuildConfig,
        device: str,
        listener: Listener,
        splats: Path | None = None,
    ) -> None:
        self.capture, self.folder, self.config = capture, folder, config
        self.device, self.listener, self.splats = device, listener, splats
        self.workers: Workers = IN_PROCESS
        self.encoders: Encoders | None = None
        self.method = METHODS[config.method]
        self.memory = parse_bytes(config.memory)
        self.blocks = number_of_blocks(config.blocks, config.reconstruction, device, self.memory)
        self.fingerprints: dict[str, str] = {}
        self.checkpoint: Checkpoint | None = None
        self._maps: FeatureMaps | None = None
        self._clip_hash = ""

    def run(self, until: str) -> SceneFolder:
        """Run the stages of the method up to ``until``; of a stage the method does not have, those before it."""
        stages = self._stages(write_provenance(self.folder, self.capture, self.config))
        order = list(stages)
        wanted = order[: order.index(until if until in stages else "features") + 1]
        encodes = "features" in wanted and self.encoders is None
        if encodes and not self._is_finished("features", stages["features"]):
            sizes = [view.capture_size for view in self._training_views.values()]
            source = self.capture.root
            self.encoders = check_encoders(self.config, source, len(sizes), max(sizes), self.listener)
        for name in wanted:
            self._run_stage(name, stages[name])
        if until == "language":
            self.folder.record.pop("building", None)
            self.folder.save()
            drop_previous(self.folder)
            keep_for(self.folder, self.device, self.listener, self.encoders.text if self.encoders else None)
        return self.folder

    def _stages(self, capture_hash: str) -> dict[str, _Stage]:
        """The stages of the method, in the order in which they run."""
        config, folder = self.config.result_settings(), self.folder
        method_settings = [config.method, *(getattr(config, part) for part in self.method.settings)]
        features = [capture_hash, *features_identity(config, self.capture)]
        own_features = [] if config.features_from is not None else [folder.features_path]
        language = ["reconstruct", self.method.needs[-1], method_settings, config.seed]
        stages = {
            "reconstruct": self._geometry(capture_hash, config),
            "features": _Stage(features, self._extract_features, own_features),
            "codebook": _Stage(
                ["features", config.codebook, config.seed], self._fit_codebook, self._code_paths()
            ),
            "language": _Stage(language, self._fit_language, [folder.language_path]),
        }
        order = ("reconstruct", *self.method.needs, "language")
        if config.joint:  # language is trained with the geometry, so its inputs come first
            geometry = [*stages["reconstruct"].inputs, "codebook", config.trained]
            outputs = [folder.gaussians_path, self._joint_path]
            stages["reconstruct"] = _Stage(geometry, self._train_jointly, outputs)
            stages["language"] = _Stage(
                ["reconstruct", method_settings], self._take_joint_language, [folder.language_path]
            )
            order = (*self.method.needs, "reconstruct", "language")
        return {name: stages[name] for name in order}

    def _geometry(self, capture_hash: str, config: BuildConfig) -> _Stage:
        outputs = [self.folder.gaussians_path]
        if self.splats is not None:
            return _Stage([capture_hash, splats_hash(self.splats)], self._take_splats, outputs)
        inputs = [capture_hash, config.reconstruction, config.seed, self.device]
        if self.blocks > 1:
            inputs += [f"{self.blocks} blocks", self.config.up]
        return _Stage(inputs, self._reconstruct, outputs)

    def _fingerprint(self, stage: _Stage) -> str:
        return fingerprint([
            self.fingerprints.get(value, value) if isinstance(value, str) else value for value in stage.inputs
        ])  # fmt: skip

    def _is_finished(self, name: str, stage: _Stage) -> bool:
        return self.folder.is_finished(name, self._fingerprint(stage)) and all(
            path.exists() for path in stage.outputs
        )

    def _run_stage(self, name: str, stage: _Stage) -> None:
        key = self.fingerprints[name] = self._fingerprint(stage)
        if self._is_finished(name, stage):
            self.listener(Event(name, 1, 1, {"kept": 1.0}))
            return
        self.folder.reopen(name)
        start = time.perf_counter()
        path = self._checkpoints / f"{name}.training.safetensors"
        self.checkpoint = Checkpoint(path, key, every=self.config.checkpoint_seconds)
        facts = stage.work()
        seconds = self.checkpoint.seconds_before + time.perf_counter() - start
        self.folder.finish(name, key, seconds, **facts)
        self.checkpoint.remove()
        if name == "reconstruct":  # also visits of an earlier command with other --blocks
            shutil.rmtree(self._checkpoints / "blocks", ignore_errors=True)
        if self._maps is not None:
            self._maps.forget()  # the next stage needs the memory of the features kept so far
        budget.give_back_freed()

    # -- the work of each stage

    def _reconstruct(self) -> dict[str, Any]:
        if self.blocks > 1:
            return self._reconstruct_blocks()
        gaussians = reconstruct(
            self.capture,
            self.config.reconstruction,
            device=self.device,
            seed=self.config.seed,
            cache_dir=self._checkpoints / "points",
            memory=self.memory,
            checkpoint=self.checkpoint,
            listener=self.listener,
        )
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians)}

    def _reconstruct_blocks(self) -> dict[str, Any]:
        config, folder = self.config, self._checkpoints / "blocks"
        points = self._initial_points()
        key = self.fingerprints["reconstruct"]
        run = BlockRun(self.device, config.seed, self.memory, folder, key, self.workers, self.listener)
        world = World.of_cameras(view.camera for view in self.capture.train_views)
        if config.up is not None:
            world = world.with_up(parse_vector(config.up))
        gaussians = reconstruct_blocks(
            self.capture, config.reconstruction, points, world.up, self.blocks, run
        )
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians), "blocks": self.blocks}

    def _take_splats(self) -> dict[str, Any]:
        splats = existing_splats(self.splats)
        with uncounted(self.listener, "splats"):
            gaussians = splats_of_capture(splats, self.capture, self.folder)
            check_agreement(gaussians, list(self._training_views.values()), splats)
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians), "splats": str(splats.resolve())}

    def _train_jointly(self) -> dict[str, Any]:
        config, seed, memory = self.config, self.config.seed, self.memory
        points = self._initial_points()
        check_gaussians(config.reconstruction, self.device, memory)
        options: dict[str, Any] = {"device": self.device, "memory": memory}
        views = self._views_with_codes()
        code_maps, codebook = views.require_codes()
        joined = partial(
            JointTrainer,
            cameras=views.cameras,
            code_maps=code_maps,
            codebook=codebook,
            config=config.trained,
            seed=seed,
        )
        start = (self.capture, config.reconstruction, points)
        tell_time(*start, **options, listener=self.listener, joined=joined)
        trainer = joined(Reconstructor(*start, **options, seed=seed))
        trainer.run(self.listener, self.checkpoint)
        gaussians, field = trainer.result()
        self.folder.write_gaussians(gaussians)
        write_tensors(self._joint_path, field.tensors(), field.metadata())
        return {"gaussians": len(gaussians)}

    def _extract_features(self) -> dict[str, Any]:
        maps = self._feature_maps()
        if self.config.features_from is not None:
            for done, name in enumerate(maps, start=1):
                _ = maps[name]  # reading checks them, before anything is made of them
                self.listener(Event("features", done, len(maps)))
        return {"views": len(maps), "clip_hash": self._clip_hash, "dino": self.config.uses_dino}

    def _fit_codebook(self) -> dict[str, Any]:
        maps, names = self._feature_maps(), self.capture.train_names
        seed, memory, listener = self.config.seed, self.memory, self.listener
        tell_codebook(maps, names, self.config.codebook, listener)
        codebook = fit_codebook(
            maps, names, self.config.codebook, seed=seed, memory=memory, listener=listener
        )
        code_maps = assign_code_maps(maps, codebook, names, listener=self.listener)
        for name, code_map in code_maps.items():
            code_maps[name] = mark_masked_cells(code_map, self.capture.views[name], codebook.num_codes)
            self.folder.write_code_map(name, code_maps[name])
        write_tensors(self.folder.codebook_path, codebook.tensors(), {})
        return code_usage(code_maps.values(), codebook.num_codes).facts()

    def _fit_language(self) -> dict[str, Any]:
        gaussians = self.folder.read_gaussians().to(self.device)
        if "codebook" in self.method.needs:
            views = self._views_with_codes()
        else:
            views = TrainingViews(self._training_views, features=self._feature_maps())
        run = FitRun(
            seed=self.config.seed,
            memory=self.memory,
            scratch=self._checkpoints,
            workers=self.workers,
            checkpoint=self.checkpoint,
            listener=self.listener,
        )
        field = self.method.fit(gaussians, views, self.config, run)
        self._write_language(field.tensors(), field.metadata())
        facts: dict[str, Any] = {"method": field.method, **field.facts()}
        if field.segments is not None:
            facts["segments"] = field.segments.levels.shape[1]
        return facts

    def _take_joint_language(self) -> dict[str, Any]:
        self._write_language(*read_tensors(self._joint_path))
        return {"method": self.method.name, "joint": True}

    # -- what the stages share

    def _write_language(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
        metadata = {**metadata, "reconstruction": self.fingerprints["reconstruct"]}
        write_tensors(self.folder.language_path, dict(tensors), metadata)

    def _feature_maps(self) -> FeatureMaps:
        """Features of the training views. What encodes photos is freed when all features are stored."""
        if self._maps is None:
            config = self.config
            encoders = self.encoders = self.encoders or Encoders.of(config)
            cache = self.folder.features_path
            training = replace(self.capture, views=self._training_views, test_names=())
            if self.workers.distributed and config.features_from is None:
                extract_on_workers(training, config, encoders, cache, self.workers, self.listener)
            self._maps = feature_maps(training, config, encoders, cache, self.listener)
            self._clip_hash = encoders.clip.content_hash
            encoders.keep_text(self.device)
        return self._maps

    def _initial_points(self) -> InitialPoints:
        cache, seed = self._checkpoints / "points", self.config.seed
        return initial_points(
            self.capture, seed=seed, cache_dir=cache, memory=self.memory, listener=self.listener
        )

    @property
    def _training_views(self) -> dict[str, View]:
        return {name: self.capture.views[name] for name in self.capture.train_names}

    def _views_with_codes(self) -> TrainingViews:
        views = self._training_views
        stored = {name: self.folder.read_code_map(name) for name in views}
        codebook = Codebook.from_tensors(read_tensors(self.folder.codebook_path)[0]).to(self.device)
        return TrainingViews(views, code_maps=MaskedCodeMaps(stored, views), codebook=codebook)

    @property
    def _checkpoints(self) -> Path:
        return self.folder.root / "checkpoints"

    @property
    def _joint_path(self) -> Path:
        return self._checkpoints / "joint_language.safetensors"

    def _code_paths(self) -> list[Path]:
        names = self.capture.train_names
        return [self.folder.codebook_path, *(self.folder.code_map_path(name) for name in names)]
