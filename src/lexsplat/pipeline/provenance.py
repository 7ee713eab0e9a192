"""Provenance of a scene: the record of its inputs, and fingerprints that detect changes."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.captures import Capture
from lexsplat.features import FeatureConfig, external_identity
from lexsplat.features.hub import content_hash, model_folder
from lexsplat.features.segments2d import SOURCES, sam2_name, segments_identity
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.world import parse_vector, stored_world, world_of
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.environment import versions
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.files import to_json
from lexsplat.runtime.fingerprints import file_hash, fingerprint
from lexsplat.scenes.facts import is_of_chosen_views
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import keep_previous
from lexsplat.scenes.scale import warn_of_stale_scale
from lexsplat.scenes.views import PhotoLens

log = logging.getLogger("lexsplat")


def hash_capture(capture: Capture) -> tuple[dict[str, str], str]:
    """Hashes of the photos by view, and a fingerprint of photos, masks, cameras and split."""
    sources = {name: file_hash(view.image_path) for name, view in capture.views.items()}
    masks = {n: file_hash(v.ignore_path) for n, v in capture.views.items() if v.ignore_path is not None}
    transparent = [name for name, view in capture.views.items() if view.ignores_transparent]
    splits = _cameras_with_split(capture).items()
    cameras = {n: [c.width, c.height, c.K.tolist(), c.viewmat.tolist(), split] for n, (c, split) in splits}
    return sources, fingerprint(sources, cameras, *filter(None, (masks, transparent)))


def _cameras_with_split(capture: Capture) -> dict[str, tuple[Camera, str]]:
    return {
        name: (view.camera, "test" if name in capture.test_names else "train")
        for name, view in capture.views.items()
    }


def write_provenance(
    folder: SceneFolder, capture: Capture, config: BuildConfig, sources: dict[str, str]
) -> None:
    """Record the capture, the hashes of its photos (`hash_capture`) and the settings of a build."""
    views = _cameras_with_split(capture)
    keep_previous(folder)
    folder.save()
    folder.write_cameras(views, {name: PhotoLens.of(view.lens) for name, view in capture.views.items()})
    _write_world(folder, config.up, {name: camera for name, (camera, _) in views.items()})
    if "images" not in folder.record:
        folder.record["capture"] = str(Path(capture.root).resolve())
    folder.record["config"] = {
        **to_json(config),
        "clip": model_place(config.clip),  # the scene may be opened from another working folder
        "dino": model_place(config.dino),
        "features": to_json(_with_full_paths(config.features)),
    }
    folder.record["provenance"] = {
        "lexsplat": version("lexsplat"),
        "versions": versions(),
        "seed": config.seed,
        "sources": sources,
    }
    record_warnings(folder, capture)
    folder.save()


def record_warnings(folder: SceneFolder, capture: Capture) -> None:
    """Gather the warnings of the capture and of the stages that are done; `SceneFolder.save` writes them."""
    stages = dict(folder.record["stages"])
    if not is_of_chosen_views(folder.record):
        stages.pop("views", None)  # of an earlier build
    of_stages = [warning for stage in stages.values() for warning in stage.get("warnings", ())]
    folder.record["warnings"] = list(dict.fromkeys([*capture.warnings, *of_stages]))


def _write_world(folder: SceneFolder, up: str | None, cameras: dict[str, Camera]) -> None:
    """Store the up direction, of the user, the cameras, or the splats from which views were chosen.

    Chosen views are level with the up direction assumed for the splats. An estimate from them would confirm that
    direction even if it is a guess. A scale stored for other cameras is dropped.
    """
    record = folder.record
    world = known = world_of(record, cameras)
    if up is not None:
        world = world.with_up(parse_vector(up))
        warn_of_stale_scale(known, world)
    elif world.source != "user" and is_of_chosen_views(record):
        found = record["stages"]["views"]["up"]
        world = replace(world, up=Up(np.array(found["direction"]), found["reliable"]), source="splats")
    before = record.get("world")
    if isinstance(before, dict) and before.get("meters_per_unit") and world.meters_per_unit is None:
        log.warning("the cameras have changed, so the scale no longer holds: run lexsplat scale again")
    record["world"] = stored_world(world, cameras)


def model_place(name: str) -> str:
    """The name of a model, or the full path of a model folder."""
    folder = Path(name).expanduser()
    return name if name in ("bundled", "none") or not folder.is_dir() else str(folder.resolve())


def with_full_paths(config: BuildConfig) -> BuildConfig:
    """The same settings for a process with another working folder."""
    features = config.features_from
    return replace(
        config,
        clip=model_place(config.clip),
        dino=model_place(config.dino),
        features_from=None if features is None else features.absolute(),
        features=_with_full_paths(config.features),
    )


def _with_full_paths(features: FeatureConfig) -> FeatureConfig:
    segments = features.segments
    return features if segments in SOURCES else replace(features, segments=model_place(segments))


def features_identity(config: BuildConfig, capture: Capture) -> list[Any]:
    """Identity of the features of a build: settings and models, or the files of another program."""
    clip = model_identity(config.clip, "clip")
    if config.features_from is not None:
        return [external_identity(config.features_from, capture), clip]
    dino = model_identity(config.dino if config.uses_dino else "none", "dino")
    return [*settings_identity(config.features, capture), [clip, dino]]


def settings_identity(features: FeatureConfig, capture: Capture) -> list[Any]:
    """Identity of the settings of features. Without segments it has no entry for them."""
    settings = to_json(features)
    name = settings.pop("segments")
    if name == "none":
        return [settings]
    model = sam2_name(name)
    segments = segments_identity(name, capture) if model is None else model_identity(model, "segments")
    return [settings, ["segments", *segments]]


def model_identity(name: str, kind: str) -> list[str]:
    """Identity of a model: its name; for a folder also sizes and times of its files; a hash if it is bundled."""
    if name == "bundled":  # its files differ between versions of lexsplat, and their times mean nothing
        return [name, content_hash(model_folder(name, kind), kind)]
    folder = Path(name).expanduser()
    if not folder.is_dir():
        return [name]
    files = sorted(file for file in folder.iterdir() if file.is_file())
    if not files:
        raise ModelError(name, expected="a model folder", found="an empty folder")
    return [model_place(name), *(f"{f.name} {f.stat().st_size} {f.stat().st_mtime_ns}" for f in files)]
