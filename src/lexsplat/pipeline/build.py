"""From a capture to a searchable scene: the stages in order, each finished once and kept.

A stage is done again only when something it depends on has changed: its record in ``scene.json`` holds a
fingerprint of the photos, the cameras, the settings and the stages before it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lexsplat.captures import Capture, View, load_annotations
from lexsplat.captures.sfm.triangulation import initial_points
from lexsplat.codebook import MAX_CODES, Codebook, assign_code_maps, code_usage, fit_codebook
from lexsplat.features import (
    FeatureMap,
    FeatureMaps,
    external_identity,
    extract_features,
    load_external_features,
)
from lexsplat.features.clip import check_patches
from lexsplat.features.hub import model_folder
from lexsplat.features.masking import without_masked_cells
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MaskedCodeMaps, mark_masked_cells
from lexsplat.language.fields import LanguageField, LiftedField
from lexsplat.language.methods.averaged import average_features, field_from_means
from lexsplat.language.methods.joint import JointTrainer
from lexsplat.language.methods.lifted import lift, tune
from lexsplat.language.methods.trained import train_field
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import prepare_capture
from lexsplat.pipeline.provenance import model_identity, write_provenance
from lexsplat.reconstruction import Reconstructor, check_gaussians, reconstruct
from lexsplat.rendering import render
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.errors import CaptureError, FileFormatError, MemoryBudgetError, ModelError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import file_hash, fingerprint
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.training import Checkpoint
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.previous import drop_previous

log = logging.getLogger("lexsplat")

STAGES = ("reconstruct", "features", "codebook", "language")
"""Names of the stages in the order in which they run."""


def build(
    capture: Path,
    output: Path,
    config: BuildConfig,
    *,
    until: str = "language",
    test_names: list[str] | None = None,
    splats: Path | None = None,
    listener: Listener = silent,
) -> SceneFolder:
    """Make a searchable scene from a capture, going on where an earlier build stopped.

    Args:
        capture: Folder with photos and cameras (COLMAP or ``transforms.json``), or with photos alone; or a video.
        output: The scene folder to make or to go on with.
        config: Settings; open ones are chosen to suit the device.
        until: Last stage to run, one of `STAGES`.
        test_names: Names of held-out views; none takes what the capture says, else every n-th.
        splats: Gaussians of another program that are taken instead of reconstructing.
        listener: Told how far each stage is.

    Raises:
        LexsplatError: With one line that says what is wrong and what to do.
        ValueError: If ``until`` is not a stage.
    """
    if until not in STAGES:
        raise ValueError(f"until must be one of {', '.join(STAGES)}, got {until!r}")
    device = choose_device(config.device)
    parse_bytes(config.memory)
    folder = SceneFolder(output)
    folder.refuse_foreign_files()
    is_new = not folder.root.exists()
    with folder.locked():
        try:
            scene = prepare_capture(capture, folder, config, test_names, listener)
            load_annotations(scene)  # a mask that belongs to no view is told now, not after the training
            sizes = [view.capture_size for view in scene.views.values()]
            config = config.resolved(device, max(sizes, key=lambda size: size[0] * size[1]))
            scene = scene.downscaled(config.downscale or 1.0)
            _check_photos(scene, parse_bytes(config.memory))
            if config.features_from is not None:
                load_external_features(config.features_from, scene)  # that one is missing is told now, too
            return _Builder(scene, folder, config, device, listener, splats).run(until)
        except (CaptureError, FileFormatError, ModelError, MemoryBudgetError):
            if is_new:  # under the lock: nobody else has begun here
                folder.withdraw()
            raise


class _Builder:
    """One run of the stages. ``made_from`` holds the fingerprints of the stages run so far."""

    def __init__(
        self,
        scene: Capture,
        folder: SceneFolder,
        config: BuildConfig,
        device: str,
        listener: Listener,
        splats: Path | None = None,
    ) -> None:
        self.scene, self.folder, self.config = scene, folder, config
        # How much is kept in memory decides nothing about a result: stages use it, fingerprints (`decisive`) do not.
        self.bounded = config.within_memory()
        self.device, self.listener, self.splats = device, listener, splats
        self.made_from: dict[str, str] = {}
        self.clip_hash = ""
        self.checkpoint: Checkpoint | None = None

    def run(self, until: str) -> SceneFolder:
        capture_hash = write_provenance(self.folder, self.scene, self.config)
        config, folder = self.config.decisive(), self.folder
        dino = config.dino if config.uses_dino else "none"
        models = [model_identity(config.clip, "clip"), model_identity(dino, "dino")]
        features: list[Any] = [capture_hash, config.features, models]
        if config.features_from is not None:
            features = [capture_hash, external_identity(config.features_from, self.scene), models[0]]
        language = [config.method, config.averaged, config.trained, config.lifted, config.tuning]
        # What each stage is made from (a stage's name stands for all of its inputs), what it does, what it writes.
        stages: dict[str, tuple[list[Any], Callable[[], dict[str, Any]], list[Path]]] = {
            "reconstruct": (
                [capture_hash, config.reconstruction, config.seed, self.device],
                self._reconstruct,
                [folder.gaussians_path],
            ),
            "features": (
                features,
                self._extract_features,
                [] if config.features_from is not None else [folder.features_path],
            ),
            "codebook": (["features", config.codebook, config.seed], self._fit_codebook, self._code_paths()),
            "language": (
                ["reconstruct", "codebook", language, config.seed],
                self._embed,
                [folder.language_path],
            ),
        }
        if self.splats is not None:
            content = file_hash(existing_splats(self.splats))
            stages["reconstruct"] = ([capture_hash, content], self._take_splats, [folder.gaussians_path])
        order: tuple[str, ...] = STAGES
        if config.method == "averaged":  # finds its codes among the Gaussians, not in the views
            inputs = ["reconstruct", "features", config.codebook, language, config.seed]
            stages["language"] = (inputs, self._average, [folder.language_path])
            order = ("reconstruct", "features", "language")
        if config.joint:  # language needs its codes before geometry is trained
            if self.splats is not None:
                raise ValueError("joint training makes its own Gaussians: leave --splats out")
            inputs, _, outputs = stages["reconstruct"]
            inputs = [*inputs, "codebook", config.trained]
            stages["reconstruct"] = (inputs, self._train_jointly, [*outputs, self._joint_path])
            stages["language"] = (
                ["reconstruct", language],
                self._take_joint_language,
                [folder.language_path],
            )
            order = ("features", "codebook", "reconstruct", "language")
        until = until if until in order else "features"  # without a stage for the codes, what comes before it
        wanted = order[: order.index(until) + 1]
        if "features" in wanted and not folder.is_finished("features", fingerprint(stages["features"][0])):
            # What is wrong with a model is told now, not after the reconstruction.
            clip = model_folder(config.clip, "clip")
            if config.features.tokens != "class" and config.features_from is None:
                check_patches(clip, config.clip)
            if dino != "none" and config.features_from is None:
                model_folder(config.dino, "dino")
        for name in wanted:
            inputs, work, outputs = stages[name]
            self._run_stage(name, inputs, work, outputs)
        if until == "language":
            self.folder.record.pop("building", None)
            self.folder.save()
            drop_previous(self.folder)
        return self.folder

    def _run_stage(
        self, name: str, inputs: list[Any], work: Callable[[], dict[str, Any]], outputs: list[Path]
    ) -> None:
        made_from = fingerprint([self.made_from.get(p, p) if isinstance(p, str) else p for p in inputs])
        self.made_from[name] = made_from
        if self.folder.is_finished(name, made_from) and all(path.exists() for path in outputs):
            self.listener(Event(name, 1, 1, {"kept": 1.0}))
            return
        self.folder.reopen(name)
        start = time.perf_counter()
        path = self.folder.root / "checkpoints" / f"{name}.training.safetensors"
        every = self.config.checkpoint_seconds
        self.checkpoint = Checkpoint(path, made_from, every=every)
        facts = work()
        seconds = self.checkpoint.seconds_before + time.perf_counter() - start
        self.folder.finish(name, made_from, seconds, **facts)
        self.checkpoint.remove()

    # -- what a stage does

    def _reconstruct(self) -> dict[str, Any]:
        gaussians = reconstruct(
            self.scene,
            self.config.reconstruction,
            device=self.device,
            seed=self.config.seed,
            cache_dir=self.folder.root / "checkpoints" / "points",
            memory=parse_bytes(self.config.memory),
            checkpoint=self.checkpoint,
            listener=self.listener,
        )
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians)}

    def _train_jointly(self) -> dict[str, Any]:
        config, scene = self.bounded, self.scene
        cache = self.folder.root / "checkpoints" / "points"
        memory = parse_bytes(config.memory)
        points = initial_points(
            scene, seed=config.seed, cache_dir=cache, memory=memory, listener=self.listener
        )
        check_gaussians(config.reconstruction, self.device, memory)
        reconstructor = Reconstructor(
            scene, config.reconstruction, points, device=self.device, seed=config.seed, memory=memory
        )
        cameras, code_maps, codebook = self._lessons()
        trainer = JointTrainer(reconstructor, cameras, code_maps, codebook, config.trained, seed=config.seed)
        trainer.run(self.listener, self.checkpoint)
        gaussians, field = trainer.result()
        self.folder.write_gaussians(gaussians)
        write_tensors(self._joint_path, field.tensors(), field.metadata())
        return {"gaussians": len(gaussians)}

    def _take_joint_language(self) -> dict[str, Any]:
        tensors, metadata = read_tensors(self._joint_path)
        write_tensors(
            self.folder.language_path, tensors, {**metadata, "reconstruction": self.made_from["reconstruct"]}
        )
        return {"method": "trained", "joint": True}

    @property
    def _joint_path(self) -> Path:
        return self.folder.root / "checkpoints" / "joint_language.safetensors"

    def _take_splats(self) -> dict[str, Any]:
        splats = existing_splats(self.splats)
        gaussians = read_splats(splats)
        cameras = [self.scene.views[name].camera for name in self.scene.train_names]
        check_in_view(gaussians, cameras, splats)
        self.folder.write_gaussians(gaussians)
        return {"gaussians": len(gaussians), "splats": str(splats.resolve())}

    def _extract_features(self) -> dict[str, Any]:
        maps = self._feature_maps()
        if self.config.features_from is not None:
            for done, name in enumerate(maps, start=1):  # all are checked before anything is made of them
                _ = maps[name]
                self.listener(Event("features", done, len(maps)))
        return {"views": len(maps), "clip_hash": self.clip_hash}

    def _fit_codebook(self) -> dict[str, Any]:
        maps = self._feature_maps()
        names = self.scene.train_names
        codebook = fit_codebook(
            maps,
            names,
            self.config.codebook,
            seed=self.config.seed,
            memory=parse_bytes(self.config.memory),
            listener=self.listener,
        )
        code_maps = assign_code_maps(maps, codebook, names, listener=self.listener)
        for name, code_map in code_maps.items():
            code_maps[name] = mark_masked_cells(code_map, self.scene.views[name], codebook.num_codes)
            self.folder.write_code_map(name, code_maps[name])
        write_tensors(self.folder.codebook_path, codebook.tensors(), {})
        usage = code_usage(code_maps.values(), codebook.num_codes)
        return {
            "codes": codebook.num_codes,
            "codes_used": usage.used,
            "perplexity": round(usage.perplexity, 2),
        }

    def _embed(self) -> dict[str, Any]:
        gaussians = self.folder.read_gaussians().to(self.device)
        cameras, code_maps, codebook = self._lessons()
        field = make_field(
            gaussians, cameras, code_maps, codebook, self.bounded, self.listener, self.checkpoint
        )
        metadata = {**field.metadata(), "reconstruction": self.made_from["reconstruct"]}
        write_tensors(self.folder.language_path, field.tensors(), metadata)
        dropped = {"dropped": round(field.dropped, 6)} if isinstance(field, LiftedField) else {}
        return {"method": field.method, **dropped}

    def _average(self) -> dict[str, Any]:
        gaussians = self.folder.read_gaussians().to(self.device)
        views = {name: self.scene.views[name] for name in self.scene.train_names}
        maps = self._feature_maps()
        scratch = self.folder.root / "checkpoints"
        field = make_averaged_field(gaussians, views, maps, self.bounded, scratch, self.listener)
        metadata = {**field.metadata(), "reconstruction": self.made_from["reconstruct"]}
        write_tensors(self.folder.language_path, field.tensors(), metadata)
        usage = code_usage([field.codes[:, 0].cpu().numpy()], field.codebook.num_codes)
        return {
            "method": field.method,
            "codes": field.codebook.num_codes,
            "codes_used": usage.used,
            "perplexity": round(usage.perplexity, 2),
        }

    # -- what stages share

    def _feature_maps(self) -> FeatureMaps:
        config = self.config if self.config.uses_dino else replace(self.config, dino="none")
        maps, self.clip_hash = feature_maps(
            self.scene, config, self.folder.features_path, self.device, self.listener
        )
        return maps

    def _lessons(self) -> tuple[dict[str, Camera], MaskedCodeMaps, Codebook]:
        """What language is learned from: cameras and index maps of the training views, and the codebook."""
        views = self.scene.views
        cameras = {name: views[name].camera for name in self.scene.train_names}
        code_maps = MaskedCodeMaps({name: self.folder.read_code_map(name) for name in cameras}, views)
        codebook = Codebook.from_tensors(read_tensors(self.folder.codebook_path)[0]).to(self.device)
        return cameras, code_maps, codebook

    def _code_paths(self) -> list[Path]:
        return [self.folder.codebook_path, *(self.folder.code_map_path(n) for n in self.scene.train_names)]


def _check_photos(scene: Capture, memory: int) -> None:
    """Refuse photos that are too small, or do not fit into the budget one by one, before anything is done."""
    from lexsplat.reconstruction.image_losses import SMALLEST_SIDE

    for view in scene.views.values():
        made = (view.camera.width, view.camera.height)
        if min(made) < SMALLEST_SIDE:
            raise CaptureError(
                view.image_path,
                expected=f"at least {SMALLEST_SIDE} pixels a side to work on",
                found=f"{made[0]}x{made[1]}",
                remedy="give a smaller --downscale, or larger photos",
            )
        budget.check_photo((view.lens.width, view.lens.height), memory, made)


def existing_splats(path: Path | None) -> Path:
    """The file itself.

    Raises:
        FileFormatError: If there is none.
    """
    if path is None or not path.is_file():
        raise FileFormatError(path, expected="a file of Gaussians", found="no such file")
    return path


def check_in_view(gaussians: Gaussians, cameras: list[Camera], subject: Path) -> None:
    """Refuse Gaussians that the cameras do not see: they are of another scene, or in other axes or units.

    Raises:
        CaptureError: If less than a tenth of the pictures would show anything.
    """
    step = max(1, len(cameras) // 8)
    shares = []
    with torch.no_grad():
        for camera in cameras[::step]:
            small = camera.downscaled(max(1.0, max(camera.width, camera.height) / 96))
            shares.append(float(render(gaussians, small, color=True).alpha.mean()))
    if np.mean(shares) < 0.1:
        raise CaptureError(
            subject,
            expected="Gaussians in the same axes and units as the cameras",
            found=f"only {np.mean(shares):.0%} of the pictures show any",
            remedy="give the poses the Gaussians were trained with",
        )


def feature_maps(
    scene: Capture, config: BuildConfig, cache_dir: Path, device: str, listener: Listener = silent
) -> tuple[FeatureMaps, str]:
    """Features of every view, extracted where they are not in the cache, and the hash of the CLIP that made them.

    Those of another program are taken as they are; the hash is then that of the CLIP that embeds the words.
    """
    from lexsplat.features.encoders import load_clip, load_dino

    clip = load_clip(config.clip, device)
    if config.features_from is not None:
        if any(view.lens.distorts for view in scene.views.values()):
            log.warning("features are taken to be of undistorted photos, and these photos are distorted")
        maps = load_external_features(
            config.features_from,
            scene,
            memory=parse_bytes(config.memory),
            dimension=clip.dim,
            allow_holes=config.codebook.num_codes < MAX_CODES,
        )
        return without_masked_cells(maps, scene), clip.content_hash
    dino = None if config.dino == "none" else load_dino(config.dino, device)
    memory = parse_bytes(config.memory)
    maps = extract_features(
        scene, clip, dino, config.features, cache_dir=cache_dir, memory=memory, listener=listener
    )
    return without_masked_cells(maps, scene), clip.content_hash


def make_averaged_field(
    gaussians: Gaussians,
    views: Mapping[str, View],
    maps: Mapping[str, FeatureMap],
    config: BuildConfig,
    scratch: Path | None = None,
    listener: Listener = silent,
) -> LiftedField:
    """The language field of method "averaged": features on the Gaussians first, codes afterwards."""
    cameras = {name: view.camera for name, view in views.items()}

    def valid(name: str, size: tuple[int, int]) -> np.ndarray | None:
        return views[name].load_valid(size)

    found = average_features(
        gaussians, cameras, maps, config.averaged, valid=valid, scratch=scratch, listener=listener
    )
    memory = parse_bytes(config.memory)
    return field_from_means(found, config.codebook, config.averaged, seed=config.seed, memory=memory)


def make_field(
    gaussians: Gaussians,
    cameras: Mapping[str, Any],
    code_maps: Mapping[str, np.ndarray],
    codebook: Codebook,
    config: BuildConfig,
    listener: Listener = silent,
    checkpoint: Checkpoint | None = None,
) -> LanguageField:
    """The language field by the method the settings name, one that learns from the codes of the views."""
    if config.method == "trained":
        return train_field(
            gaussians, cameras, code_maps, codebook, config.trained,
            seed=config.seed, checkpoint=checkpoint, listener=listener,
        )  # fmt: skip
    lifted = lift(gaussians, cameras, code_maps, codebook, config.lifted, listener=listener)
    if config.method == "lifted":
        return lifted
    return tune(
        lifted, gaussians, cameras, code_maps, config.tuning, config.trained,
        seed=config.seed, checkpoint=checkpoint, listener=listener,
    )  # fmt: skip
