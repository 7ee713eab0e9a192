"""The capture of a build, with structure from motion where needed, and the same capture reloaded later.

A capture is a folder with cameras, a folder of photos alone, or a video. For the latter two structure from motion
writes ``poses/`` in the scene folder: ``sparse/0``, upright copies or frames in ``images/``, and masks.
"""

from __future__ import annotations

import logging
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.captures import (
    Capture,
    Lens,
    View,
    is_photo_folder,
    load_annotations,
    load_capture,
    poses_from_photos,
)
from lexsplat.captures.ground_truth.layouts import annotated_names
from lexsplat.captures.images.listing import images_below, is_image_file
from lexsplat.captures.images.reading import transparency_of
from lexsplat.captures.loading import check_capture
from lexsplat.captures.readers.video import is_video, require_video, sample_video
from lexsplat.captures.sfm.preparation import (
    checked_photos,
    find_photos,
    mask_places,
    photo_folder,
    upright_size,
)
from lexsplat.captures.sfm.remarks import copies_of
from lexsplat.captures.splits import choose_test_names
from lexsplat.features import check_external_features
from lexsplat.features.segments2d import check_segments
from lexsplat.geometry.cameras import Camera
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError, SceneFolderError
from lexsplat.runtime.fingerprints import file_sample, fingerprint
from lexsplat.runtime.progress import NOTE, Listener, kept_warnings, warn_again
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.unsaved import refuse_to_lose_steps

log = logging.getLogger("lexsplat")

_VIDEO_SIZE = (1920, 1080)


def refuse_output_in_capture(source: Path, output: Path) -> None:
    """Refuse to mix the files of a scene into a capture; a new folder within the capture is welcome.

    Raises:
        CaptureError: If the output is the folder of the capture, or one in it that holds images.
    """
    place, capture = output.resolve(), source.resolve()
    if source.suffix == ".json":  # a transforms.json in place of its folder
        capture = capture.parent
    if not place.is_dir() or not place.is_relative_to(capture):
        return
    if place == capture or any(map(is_image_file, place.iterdir())):
        raise CaptureError(
            output,
            expected="an output folder of its own",
            found=f"a folder of the capture {source}",
            remedy="give another --output",
        )


def prepare_capture(
    source: Path,
    folder: SceneFolder,
    config: BuildConfig,
    test_names: list[str] | None,
    listener: Listener,
) -> Capture:
    """Load the capture of a build; photos without cameras and videos get cameras from structure from motion.

    Args:
        source: Folder or video that the user gave.
        folder: The scene folder, where cameras from structure from motion are kept in ``poses/``.
        config: Settings of the build.
        test_names: Names of the held-out views; None takes those of the capture, or else every n-th view.
        listener: Receives progress events.

    Raises:
        CaptureError: If there is no usable capture.
    """
    if not is_photo_folder(source):
        folder.record.pop("images", None)
        return load_capture(source, test_every=config.test_every, test_names=test_names)
    poses = folder.root / "poses"
    photos = _frames_folder(folder.root) if is_video(source) else photo_folder(source)
    images = _registered_images(source, photos, folder, config, listener)
    folder.record["images"] = images
    folder.record["capture"] = str(source.resolve())
    return load_capture(
        poses,
        images=folder.root / images,
        beside=source if source.is_dir() else poses,
        test_every=config.test_every,
        test_names=test_names,
    )


def _frames_folder(output: Path) -> Path:
    """Folder of the frames of a video, in a scene folder."""
    return output / "poses" / "images"


@dataclass(frozen=True)
class PhotoSurvey:
    """Number and size of the training photos of a capture.

    Args:
        count: Number of training photos, or of frames to sample from a video.
        size: Width and height of the largest, upright; a guess for a video.
        capture: The photos, without cameras; None for a video.
    """

    count: int
    size: tuple[int, int]
    capture: Capture | None = None


def preview_capture(
    source: Path, output: Path, config: BuildConfig, test_names: list[str] | None = None
) -> Capture | None:
    """The capture of a build before structure from motion, for checks; only headers of photos are read.

    Args:
        source: Folder or video that the user gave.
        output: The scene folder, where it may lie among the photos.
        config: Settings of the build.
        test_names: Names of the held-out views; None takes those of the capture, or else every n-th view.

    Returns:
        The capture, without points and with unknown cameras if it has none. None for a video.

    Raises:
        CaptureError: If a photo is no image, or a held-out name or a camera belongs to no photo.
    """
    if is_video(source):
        return None
    if not is_photo_folder(source):
        return load_capture(source, test_every=config.test_every, test_names=test_names)
    photos = photo_folder(source)
    views = {name: _unposed_view(name, photos / name) for name in checked_photos(photos, output)}
    annotated = annotated_names(source, views)
    chosen, _ = choose_test_names(
        list(views),
        root=source,
        test_names=test_names,
        listed=None,
        annotated=annotated,
        test_every=config.test_every,
    )
    training = tuple(name for name in views if name not in chosen)
    return Capture(source, views, training, chosen)


def survey_photos(
    source: Path, output: Path, config: BuildConfig, test_names: list[str] | None
) -> PhotoSurvey | None:
    """Survey photos without cameras, and features and segments made of them elsewhere; None if there are cameras.

    That is ground truth, 2D segments, and features of another program.

    Masks are checked by structure from motion before it searches features.

    Raises:
        BackendError: If a video cannot be read here.
        CaptureError: As `preview_capture`, if there is neither a camera, a photo nor a video, or if ground truth
            belongs to no photo or does not fit it.
        FileFormatError: If features of another program or 2D segments do not fit the photos.
        ModelError: If 2D segments come from nothing known.
    """
    check_capture(source)
    if not is_photo_folder(source):
        return None
    capture = preview_capture(source, output, config, test_names)
    if capture is None:
        require_video(source, _frames_folder(output))
        return PhotoSurvey(config.frames, _VIDEO_SIZE)
    load_annotations(capture)
    check_given_maps(config, capture)
    largest = _largest(capture)
    if config.downscale is not None:
        _check_size(source, round(largest[0] / config.downscale), round(largest[1] / config.downscale))
    return PhotoSurvey(len(capture.train_names), largest, capture)


def check_given_maps(config: BuildConfig, capture: Capture) -> None:
    """Refuse features of another program and 2D segments that do not fit the photos.

    Raises:
        LexsplatError: As `check_external_features` and `check_segments`.
    """
    if config.features_from is not None:
        check_external_features(config.features_from, capture)
    check_segments(config.features, capture)


def count_photos(source: Path, config: BuildConfig) -> PhotoSurvey:
    """Number and size of the training photos of a capture, with or without cameras.

    Raises:
        CaptureError: If there is no usable capture.
    """
    capture = preview_capture(source, source, config)
    if capture is None:
        return PhotoSurvey(config.frames, _VIDEO_SIZE)
    return PhotoSurvey(len(capture.train_names), _largest(capture))


def _largest(capture: Capture) -> tuple[int, int]:
    sizes = (view.capture_size for view in capture.views.values())
    return max(sizes, key=math.prod, default=_VIDEO_SIZE)


def _unposed_view(name: str, path: Path) -> View:
    """A photo as a view of an unknown camera."""
    width, height = upright_size(path)
    focal = float(max(width, height))
    lens = Lens("PINHOLE", width, height, (focal, focal, width / 2, height / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View(name, path, Camera(width, height, K, np.eye(4)), (width, height), lens)


def refuse_without_cameras(source: Path) -> None:
    """Refuse photos without cameras, and videos, where Gaussians of another program are given.

    Raises:
        CaptureError: If the capture has no cameras.
    """
    if is_photo_folder(source):
        raise CaptureError(
            source,
            expected="the cameras with which the Gaussians of --splats were trained",
            found="a video" if is_video(source) else "photos without cameras",
            remedy="give the capture with these cameras, or leave --splats out",
        )


def _registered_images(
    source: Path, photos: Path, folder: SceneFolder, config: BuildConfig, listener: Listener
) -> str:
    """Run structure from motion unless its result is up to date; returns the folder of the images that have poses."""
    poses, memory = folder.root / "poses", config.memory_bytes
    key = _photos_fingerprint(source, photos, folder.root, config)
    images = folder.record["stages"].get("poses", {}).get("images")
    if images is not None and Path(images).is_absolute():
        images = str(photos.resolve())  # where they are now
    kept = images is not None and (folder.root / images).is_dir() and (poses / "sparse" / "0").is_dir()
    if kept and folder.is_finished("poses", key):
        warn_again(folder.record["stages"]["poses"])
        return str(images)
    refuse_to_lose_steps(folder)
    start = time.perf_counter()
    folder.reopen("poses")
    if is_video(source):
        sample_video(source, photos, config.frames, memory=memory, listener=listener)
    with kept_warnings() as warnings:
        found = poses_from_photos(
            photos, poses, config.poses, seed=config.seed, memory=memory, listener=listener
        )
        for note in found.notes:
            log.warning(note)
        log.log(NOTE if found.is_complete else logging.WARNING, found.note)
    inside = found.images.resolve().is_relative_to(folder.root.resolve())
    images = "poses/images" if inside else str(found.images.resolve())
    facts = {
        "registered": len(found.registered),
        "unregistered": list(found.unregistered),
        "mapper": found.mapper,
        "models": found.models,
        "note": found.note,
        "warnings": warnings,
        "images": images,
    }
    folder.finish("poses", key, time.perf_counter() - start, **facts)
    return images


def _photos_fingerprint(source: Path, photos: Path, output: Path, config: BuildConfig) -> str:
    """Fingerprint of the inputs of structure from motion: photos or a video, masks, settings.

    Of files their names and samples (`file_sample`): a copy of a capture has the cameras of the original.
    """
    settings: list[Any] = [config.poses, config.seed]
    if is_video(source):
        if not source.is_file():
            raise CaptureError(source, expected="a video", found="no such file", remedy="check the path")
        return fingerprint(settings, source.name, file_sample(source), config.frames)
    masks = [path for folder in mask_places(photos) for path in images_below(folder)[0]]
    names = find_photos(photos, output)
    copies = copies_of(photos, names)
    found = [photos / name for name in names if name not in copies]
    files = [[os.path.relpath(path, photos), file_sample(path)] for path in (*found, *masks)]
    # Poses that were made when transparent pixels were not ignored are made again.
    transparent = [os.path.relpath(path, photos) for path in found if transparency_of(path).hides]
    return fingerprint(settings, files, *filter(None, [transparent]))


def reload_capture(folder: SceneFolder, source: Path | None = None) -> Capture:
    """Load the capture of a built scene, with the views, sizes and split of the build.

    Args:
        folder: The scene folder.
        source: Folder of the capture if it has been moved since the build.

    Raises:
        SceneFolderError: If a photo is not where the build found it.
        CaptureError: If they cannot be used.
    """
    record = folder.record
    views = folder.read_cameras()
    held_out = [name for name, view in views.items() if view.split == "test"]
    downscale = record.get("config", {}).get("downscale") or 1.0
    images = record.get("images")
    recorded = record.get("capture")
    place = source or (Path(recorded) if recorded else None)
    owned = images is not None and not Path(images).is_absolute()  # images inside the scene folder
    if not owned and (place is None or not place.exists()):
        raise SceneFolderError(
            place or "capture",
            expected="the photos the scene was made from",
            found="no such folder",
            remedy="give their folder with --capture",
        )
    poses = folder.root / "poses"
    if images is None or place is None:
        found = load_capture(place or poses, downscale=downscale, test_names=held_out)
    else:
        found = load_capture(
            poses,
            images=photo_folder(source) if source is not None and not owned else folder.root / images,
            beside=place if place.is_dir() else poses,
            downscale=downscale,
            test_names=held_out,
        )
    if missing := set(views) - set(found.views):
        raise SceneFolderError(
            found.root,
            expected=f"the {len(views)} photos of the build",
            found=f"{len(missing)} missing, such as {min(missing)}",
            remedy="put them back or build again",
        )
    return found


def check_photos(capture: Capture, memory: int) -> None:
    """Refuse photos that are too small, or too large for the memory budget, before any work.

    Raises:
        CaptureError: If a photo is too small at the size to work at.
        MemoryBudgetError: If a photo does not fit.
    """
    for view in capture.views.values():
        width, height = view.camera.width, view.camera.height
        _check_size(view.image_path, width, height)
        budget.check_photo((view.lens.width, view.lens.height), memory, (width, height))


def _check_size(path: Path, width: int, height: int) -> None:
    """Refuse photos that are too small at the size to work at."""
    from lexsplat.reconstruction.image_losses import SMALLEST_SIDE

    if min(width, height) < SMALLEST_SIDE:
        raise CaptureError(
            path,
            expected=f"at least {SMALLEST_SIDE} pixels a side to work on",
            found=f"{width}x{height}",
            remedy="give a smaller --downscale, or larger photos",
        )
