"""From a capture to a scene: the stages in order, each done once and kept.

A stage is repeated only when something it depends on has changed: its record in ``scene.json`` holds a fingerprint of
the photos, the cameras, its settings and the stages before it.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Any

from lexsplat.captures import Capture, View, load_annotations
from lexsplat.codebook import Codebook, assign_code_maps, code_usage, fit_codebook, tell_codebook
from lexsplat.features import FeatureMaps, read_external_features
from lexsplat.language.code_maps import MaskedCodeMaps, mark_masked_cells
from lexsplat.language.methods import FitRun, TrainingViews
from lexsplat.pipeline.chosen_views import choice_path, kept_choice, views_to_read
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.distribution import extract_on_workers
from lexsplat.pipeline.encoding import Encoders, check_encoders, check_given, feature_maps, fetch_clip
from lexsplat.pipeline.geometry import GeometryRun, way_to_geometry
from lexsplat.pipeline.inputs import (
    PhotoSurvey,
    check_given_maps,
    check_photos,
    prepare_capture,
    refuse_output_in_capture,
    refuse_without_cameras,
    survey_photos,
)
from lexsplat.pipeline.provenance import (
    features_identity,
    hash_capture,
    model_place,
    record_warnings,
    with_full_paths,
    write_provenance,
)
from lexsplat.pipeline.splats import existing_splats
from lexsplat.pipeline.viewpoints import capture_of_splats
from lexsplat.pipeline.viewpoints.choosing import SIZE
from lexsplat.rendering.backends import require_gsplat
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import choose_device, choose_encoder_device
from lexsplat.runtime.errors import (
    BackendError,
    CaptureError,
    FileFormatError,
    MemoryBudgetError,
    ModelError,
)
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.progress import Event, Listener, kept_warnings, silent, warn_again
from lexsplat.runtime.training import Checkpoint
from lexsplat.runtime.workers import IN_PROCESS, SharedFolder, Workers, open_workers
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.foreign import warnings_once
from lexsplat.scenes.kept import keep_for
from lexsplat.scenes.previous import drop_previous
from lexsplat.scenes.unsaved import refuse_to_lose_steps

log = logging.getLogger("lexsplat")

STAGES = ("reconstruct", "features", "codebook", "language")
"""Names of all stages; the method has those of a build and their order (`LanguageMethod.stages`)."""


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
        ValueError: If ``until`` is not a stage, ``splats`` are given where the settings make their own Gaussians, or
            there is neither a source nor ``splats``.
    """
    source, config = None if source is None else Path(source), (config or BuildConfig()).spelled_out()
    _check_request(source, splats, until, config)
    if config.workers != "none":  # workers may have another working folder
        output, config = Path(output).absolute(), with_full_paths(config)
        source, splats = (None if path is None else path.absolute() for path in (source, splats))
    device = choose_device(config.device)
    config = replace(config, encoder_device=choose_encoder_device(config.encoder_device, device))  # type: ignore[arg-type]
    if device == "cuda":
        require_gsplat("--device cpu --encoder-device cuda")  # before anything that takes time
    folder = _output_folder(source, Path(output))
    existed = folder.root.exists()
    is_new = not existed or not any(folder.root.iterdir())
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
                check_given(config, photos.capture, checked)
            if source is None:
                capture = capture_of_splats(splats, folder, config, device, listener)
            else:
                capture = prepare_capture(source, folder, config, test_names, listener)
            load_annotations(capture)
            sizes = [view.capture_size for view in capture.views.values()]
            config = config.resolved(device, max(sizes, key=lambda size: size[0] * size[1]))
            capture = capture.downscaled(config.downscale or 1.0)
            check_photos(capture, config.memory_bytes)
            check_given_maps(config, capture)
            builder = _Builder(capture, folder, config, device, listener, splats)
            builder.encoders, builder.workers = checked, workers
            SharedFolder.forget_marks(folder.root / "checkpoints")
            workers.require((capture.root,))
            return builder.run(until)
        except (BackendError, CaptureError, FileFormatError, ModelError, MemoryBudgetError, OSError):
            if is_new:  # the lock is held, so nobody else uses the folder
                folder.withdraw(above, keep_root=existed)
            raise


def _output_folder(source: Path | None, output: Path) -> SceneFolder:
    """The folder of a build; one of a capture, of other files or of a saved edit is refused."""
    if source is not None:
        refuse_output_in_capture(source, output)
    folder = SceneFolder(output)
    folder.refuse_foreign_files()
    folder.refuse_edited()
    return folder


def _check_request(source: Path | None, splats: Path | None, until: str, config: BuildConfig) -> None:
    """Refuse what cannot be built, before anything is written; the errors are those of `build`."""
    if until not in STAGES:
        raise ValueError(f"until must be one of {', '.join(STAGES)}, got {until!r}")
    if source is None and splats is None:
        raise ValueError("a build needs a capture or splats")
    if splats is not None:
        config.refuse_beside_splats()
        existing_splats(splats)
        if source is not None:
            refuse_without_cameras(source)


@dataclass(frozen=True)
class _Stage:
    """One stage of a build.

    Args:
        inputs: Everything its result depends on. The name of an earlier stage stands for all inputs of that stage.
        work: Does it; returns facts for its record.
        outputs: Paths that it writes.
    """

    inputs: list[Any]
    work: Callable[[], dict[str, Any]]
    outputs: list[Path]


class _Builder:
    """The stages of one build. ``fingerprints`` holds those of all of them, once it runs."""

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
        self.device, self.listener = device, listener
        self.workers: Workers = IN_PROCESS
        self.encoders: Encoders | None = None
        self.method = config.language_method
        self.geometry = way_to_geometry(config, device, splats)
        self.fingerprints: dict[str, str] = {}
        self._whole: dict[str, bool] = {}  # of the stages whose files were read
        self.checkpoint: Checkpoint | None = None
        self._maps: FeatureMaps | None = None
        self._clip_hash = ""

    def run(self, until: str) -> SceneFolder:
        """Run the stages of the method up to ``until``; of a stage the method does not have, those before it."""
        sources, capture_hash = hash_capture(self.capture)
        stages = self._stages(capture_hash)
        for name, stage in stages.items():
            self.fingerprints[name] = self._fingerprint(stage)
        if not self._is_finished("reconstruct", stages["reconstruct"]):
            refuse_to_lose_steps(self.folder)
        write_provenance(self.folder, self.capture, self.config, sources)
        order = list(stages)
        wanted = order[: order.index(until if until in stages else "features") + 1]
        encodes = "features" in wanted and self.encoders is None
        if encodes and not self._is_finished("features", stages["features"]):
            sizes = [view.capture_size for view in self._training_views.values()]
            source, cached = self.capture.root, any(self.folder.features_path.glob("*.safetensors"))
            count = 0 if cached else len(sizes)  # where some are stored, the time of the others is told later
            self.encoders = check_encoders(self.config, source, count, max(sizes), self.listener)
        if self.encoders is not None:
            check_given(self.config, self.capture, self.encoders)
        changes = not all(self._is_finished(name, stages[name]) for name in wanted)
        for name in wanted:
            self._run_stage(name, stages[name])
        if changes and (self.folder.root / "metrics.json").exists():
            log.warning(
                "%s: metrics.json, report.html and heatmaps are of the scene before this build;"
                " run: lexsplat evaluate %s",
                self.folder.root,
                quote(str(self.folder.root)),
            )
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
        features = [
            capture_hash,
            *features_identity(config, self.capture),
            *self.method.feature_inputs(config),
        ]
        own_features = [] if config.features_from is not None else [folder.features_path]
        own_features += [choice_path(folder)] if self.method.feature_inputs(config) else []
        language = ["reconstruct", self.method.needs[-1], method_settings, config.seed]
        geometry = [capture_hash, *self.geometry.inputs(config, self.device)]
        own_geometry = [folder.gaussians_path, *self.geometry.outputs(self._checkpoints)]
        stages = {
            "reconstruct": _Stage(geometry, self._make_geometry, own_geometry),
            "features": _Stage(features, self._extract_features, own_features),
            "codebook": _Stage(
                ["features", config.codebook, config.seed], self._fit_codebook, self._code_paths()
            ),
            "language": _Stage(language, self._fit_language, [folder.language_path]),
        }
        return {name: stages[name] for name in self.method.stages}

    def _fingerprint(self, stage: _Stage) -> str:
        return fingerprint([
            self.fingerprints.get(value, value) if isinstance(value, str) else value for value in stage.inputs
        ])  # fmt: skip

    def _is_finished(self, name: str, stage: _Stage) -> bool:
        """Whether the files of a stage are those that a build with these inputs makes, and whole."""
        if not self.folder.is_finished(name, self.fingerprints[name]):
            return False
        if not all(path.exists() for path in stage.outputs):
            return False
        if name not in self._whole:
            self._whole[name] = self._is_whole(name, stage)
        return self._whole[name]

    def _is_whole(self, name: str, stage: _Stage) -> bool:
        """Whether the files of a stage are whole. A warning names the first damaged one."""
        try:
            for path in stage.outputs:
                self.folder.check_file(path)
        except FileFormatError as error:
            log.warning("%s", error.with_remedy(f"the stage {name} runs again"))
            return False
        return True

    def _run_stage(self, name: str, stage: _Stage) -> None:
        key = self.fingerprints[name]
        if self._is_finished(name, stage):
            done = self.folder.record["stages"]
            done[name] = done.pop(name)  # in the order of the stages, whichever ran before
            warn_again(self.folder.record["stages"][name])
            self.listener(Event(name, 1, 1, {"kept": 1.0}))
            return
        self.folder.reopen(name)
        start = time.perf_counter()
        path = self._checkpoints / f"{name}.training.safetensors"
        self.checkpoint = Checkpoint(path, key, every=self.config.checkpoint_seconds)
        before = self.folder.record.get("checksums")
        facts, warnings = self._with_whole_features(stage.work)
        if name == "reconstruct" and self.folder.record.get("checksums") != before:
            for later in ("language", *(["features"] if self.method.feature_inputs(self.config) else [])):
                # Made for other Gaussians, even where all settings are the same.
                self.folder.record["stages"].pop(later, None)
            self.folder.save()
        seconds = self.checkpoint.seconds_before + time.perf_counter() - start
        self.folder.finish(name, key, seconds, **facts, **({"warnings": warnings} if warnings else {}))
        record_warnings(self.folder, self.capture)
        self.folder.save()
        self.checkpoint.remove()
        if name == "reconstruct":  # also visits of an earlier command with other --blocks
            shutil.rmtree(self._checkpoints / "blocks", ignore_errors=True)
        if self._maps is not None:
            self._maps.forget()  # the next stage needs the memory of the features kept so far
        budget.give_back_freed()

    def _with_whole_features(self, work: Callable[[], dict[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """Facts and warnings of the work of a stage; a damaged file of the feature cache is made again, once."""
        mended: set[Path] = set()
        while True:
            try:
                with kept_warnings() as warnings:
                    return work(), warnings
            except FileFormatError as error:
                damaged = Path(error.subject)
                if damaged.parent != self.folder.features_path or damaged in mended:
                    raise
                log.warning("%s", error.with_remedy("they are made again"))
                mended.add(damaged)
                damaged.unlink(missing_ok=True)
                self._maps = None  # made anew, it encodes the photos whose features are missing

    # -- the work of each stage

    def _make_geometry(self) -> dict[str, Any]:
        run = GeometryRun(
            self.capture,
            self.folder,
            self.device,
            fit=self._fit_run(),
            key=self.fingerprints["reconstruct"],
            codes=self._views_with_codes,
        )
        gaussians, facts = self.geometry.make(self.config, run)
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians), **facts}

    def _extract_features(self) -> dict[str, Any]:
        maps, given = self._feature_maps(), self.config.features_from
        if given is not None:
            read_external_features(maps, given, self.listener)  # before anything is made of them
        views = {"views": len(maps), "of": len(self._training_views)}
        return {**views, "clip_hash": self._clip_hash, "dino": self.config.uses_dino}

    def _fit_codebook(self) -> dict[str, Any]:
        maps, names = self._feature_maps(), self.capture.train_names
        seed, memory = self.config.seed, self.config.memory_bytes
        tell_codebook(maps, names, self.config.codebook, memory=memory, listener=self.listener)
        codebook = fit_codebook(
            maps, names, self.config.codebook, seed=seed, memory=memory, listener=self.listener
        )
        code_maps = assign_code_maps(maps, codebook, names, listener=self.listener)
        for name, code_map in code_maps.items():
            code_maps[name] = mark_masked_cells(code_map, self.capture.views[name], codebook.num_codes)
            self.folder.write_code_map(name, code_maps[name])
        write_tensors(self.folder.codebook_path, codebook.tensors(), {})
        return code_usage(code_maps.values(), codebook.num_codes).facts()

    def _fit_language(self) -> dict[str, Any]:
        if "codebook" in self.method.needs:
            views = self._views_with_codes()
        else:
            views = replace(self._views_to_read, features=self._feature_maps())
        gaussians = self.folder.read_gaussians().to(self.device)
        field = self.method.fit(gaussians, views, self.config, self._fit_run())
        field.method = self.method.name
        metadata = {**field.metadata(), "reconstruction": self.fingerprints["reconstruct"]}
        write_tensors(self.folder.language_path, field.tensors(), metadata)
        return {"method": field.method, **field.facts()}

    # -- what the stages share

    def _fit_run(self) -> FitRun:
        return FitRun(
            seed=self.config.seed,
            memory=self.config.memory_bytes,
            scratch=self._checkpoints,
            workers=self.workers,
            checkpoint=self.checkpoint,
            listener=self.listener,
        )

    def _feature_maps(self) -> FeatureMaps:
        """Features of the views to read. The image encoders are freed when all features are stored."""
        if self._maps is None:
            config = self.config
            encoders = self.encoders = self.encoders or Encoders.of(config)
            cache = self.folder.features_path
            views = dict(self._views_to_read.views)
            training = replace(self.capture, views=views, train_names=tuple(views), test_names=())
            if self.workers.distributed and config.features_from is None:
                extract_on_workers(training, config, encoders, cache, self.workers, self.listener)
            self._maps = feature_maps(training, config, encoders, cache, self.listener)
            self._clip_hash = encoders.clip.content_hash
            encoders.keep_text(self.device)
        return self._maps

    @cached_property
    def _views_to_read(self) -> TrainingViews:
        """The training views whose features the method needs: those of the stage "features" where it is finished."""
        views, method = self._training_views, self.method
        kept = None
        if method.feature_inputs(self.config) and "features" in self.folder.record["stages"]:
            kept = kept_choice(self.folder, views)
        return kept or views_to_read(method, self.folder, views, self.config, self.device, self._fit_run())

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

    def _code_paths(self) -> list[Path]:
        names = self.capture.train_names
        return [self.folder.codebook_path, *(self.folder.code_map_path(name) for name in names)]
