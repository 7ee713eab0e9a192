"""The photos and cameras of a scene: for a build, with structure from motion where needed, and found again later.

A capture is a folder with cameras, a folder of photos alone, or a video. What structure from motion makes of the
latter two lies in ``poses/`` of the scene folder: ``sparse/0``, upright copies or frames in ``images/``, masks.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from lexsplat.captures import Capture, is_photo_folder, load_capture, poses_from_photos
from lexsplat.captures.readers.video import is_video, sample_video
from lexsplat.captures.sfm.preparation import find_photos, mask_places, photo_folder
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import CaptureError, SceneFolderError
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Listener
from lexsplat.scenes.folder import SceneFolder


def prepare_capture(
    capture: Path,
    folder: SceneFolder,
    config: BuildConfig,
    test_names: list[str] | None,
    listener: Listener,
) -> Capture:
    """The capture; photos without cameras, or a video, get them by structure from motion, kept in ``poses/``."""
    if not is_photo_folder(capture):
        folder.record.pop("images", None)
        return load_capture(capture, test_every=config.test_every, test_names=test_names)
    poses = folder.root / "poses"
    photos = poses / "images" if is_video(capture) else photo_folder(capture)
    if folder.root.resolve() in (photos.resolve(), capture.resolve()):
        raise CaptureError(
            folder.root,
            expected="an output folder of its own",
            found="the folder of the photos",
            remedy="give another --output",
        )
    made_from = _photos_fingerprint(capture, photos, folder.root, config)
    images = folder.record["stages"].get("poses", {}).get("images")
    kept = images is not None and (folder.root / images).is_dir() and (poses / "sparse" / "0").is_dir()
    if not (kept and folder.is_finished("poses", made_from)):
        start = time.perf_counter()
        folder.reopen("poses")
        if is_video(capture):
            sample_video(capture, photos, config.frames, memory=parse_bytes(config.memory), listener=listener)
        found = poses_from_photos(
            photos,
            poses,
            config.poses,
            seed=config.seed,
            memory=parse_bytes(config.memory),
            listener=listener,
        )
        log = logging.getLogger("lexsplat")
        for note in found.notes:
            log.warning(note)
        log.log(logging.INFO if found.is_complete else logging.WARNING, found.note)
        inside = found.images.resolve().is_relative_to(folder.root.resolve())
        images = "poses/images" if inside else str(found.images.resolve())
        facts = {
            "registered": len(found.registered),
            "unregistered": list(found.unregistered),
            "images": images,
        }
        folder.finish("poses", made_from, time.perf_counter() - start, **facts)
    folder.record["images"] = images
    folder.record["capture"] = str(capture.resolve())
    return load_capture(
        poses,
        images=folder.root / images,
        beside=capture if capture.is_dir() else poses,
        test_every=config.test_every,
        test_names=test_names,
    )


def _photos_fingerprint(capture: Path, photos: Path, output: Path, config: BuildConfig) -> str:
    """What estimated cameras depend on: photos by name and size, masks also by time, and the settings."""
    about: list[Any] = [config.poses, config.seed]
    if is_video(capture):
        if not capture.is_file():
            raise CaptureError(capture, expected="a video", found="no such file", remedy="check the path")
        return fingerprint(about, capture.name, capture.stat().st_size, config.frames)
    masks = [path for folder in mask_places(photos) for path in sorted(folder.rglob("*")) if path.is_file()]
    names = find_photos(photos, output)
    return fingerprint(
        about,
        [[name, (photos / name).stat().st_size] for name in names],
        [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in masks],
    )


def reload_capture(folder: SceneFolder, capture: Path | None = None) -> Capture:
    """The capture of a scene that was built, with the views, sizes and split of the build.

    Args:
        folder: The scene.
        capture: Where the photos are now, if they have moved.

    Raises:
        SceneFolderError: If they are not where the build found them.
        CaptureError: If they cannot be used.
    """
    record = folder.record
    held_out = [name for name, view in folder.read_cameras().items() if view.split == "test"]
    downscale = record.get("config", {}).get("downscale") or 1.0
    images = record.get("images")
    recorded = record.get("capture")
    place = capture or (Path(recorded) if recorded else None)
    owned = (
        images is not None and not Path(images).is_absolute()
    )  # copies or frames in the scene folder itself
    if not owned and (place is None or not place.exists()):
        raise SceneFolderError(
            place or "capture",
            expected="the photos the scene was made from",
            found="no such folder",
            remedy="say where they are with --capture",
        )
    if images is None or place is None:
        return load_capture(place or folder.root / "poses", downscale=downscale, test_names=held_out)
    poses = folder.root / "poses"
    return load_capture(
        poses,
        images=photo_folder(capture) if capture is not None and not owned else folder.root / images,
        beside=place if place.is_dir() else poses,
        downscale=downscale,
        test_names=held_out,
    )
