"""Loads a capture folder: finds the camera files, checks every photo's header, chooses the split."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote

from lexsplat.captures.capture import Capture, View, stem_of
from lexsplat.captures.ground_truth.layouts import annotated_names
from lexsplat.captures.images.listing import images_below, is_image_file, some_of
from lexsplat.captures.images.masks import (
    IGNORE_FOLDER,
    INVERTED,
    blank_masks,
    find_ignore_masks,
    transparency_note,
)
from lexsplat.captures.images.reading import image_size, sizes_agree, transparency_of
from lexsplat.captures.images.undistortion import pinhole_of
from lexsplat.captures.readers.camera_files import CameraFiles, Photo
from lexsplat.captures.readers.colmap import find_model, read_colmap
from lexsplat.captures.readers.transforms_json import find_transforms, read_transforms
from lexsplat.captures.readers.video import is_video, videos_in
from lexsplat.captures.sfm.remarks import copies_of
from lexsplat.captures.splits import choose_test_names
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import CaptureError


def load_capture(
    path: str | Path,
    *,
    downscale: float = 1.0,
    test_every: int = 8,
    test_names: Sequence[str] | None = None,
    images: str | Path | None = None,
    beside: str | Path | None = None,
) -> Capture:
    """Load a capture: COLMAP (binary or text), ``transforms.json`` (nerfstudio, instant-ngp, NeRF-synthetic).

    Only the headers of photos are read. A COLMAP model takes precedence over a ``transforms.json``, because it also
    has points; give the JSON file as ``path`` to use that.

    Args:
        path: The capture folder, or its ``transforms.json``.
        downscale: Factor by which working images are smaller than the undistorted photos.
        test_every: Hold out every n-th view, counting from the first by name; 0 holds out nothing.
        test_names: Names or stems of the views to hold out; overrides every other rule.
        images: Folder of the photos of a COLMAP model, if not in the capture folder.
        beside: Folder with ``segmentations/`` and ``test_views.json``, if not that of the cameras: the folder of the
            photos if the cameras were estimated. Masks (``masks/``) always lie with the cameras.

    Raises:
        CaptureError: If there are no cameras or no photos, or one of them cannot be used.
        FileFormatError: If a camera file is damaged.
        ValueError: If ``downscale`` is not positive and finite, or ``test_every`` is negative or 1.
    """
    if not 0 < downscale < 1e6:
        raise ValueError(f"downscale must be positive, got {downscale:g}")
    files = _read_camera_files(Path(path), None if images is None else Path(images))
    warnings = [*files.warnings, *_missing_files(files)]
    named = [photo.name for photo in files.photos]
    masked, strays = find_ignore_masks([files.root / IGNORE_FOLDER], [*named, *_unposed(files)])
    # With estimated cameras, `prepare_photos` has reported them; masks of unregistered photos are no mistake.
    warnings += strays if beside is None else []
    views = {
        photo.name: _make_view(photo, files, downscale, masked.get(photo.name))
        for photo in sorted(files.photos, key=lambda photo: photo.name)
    }
    warnings += [*_transparent(views, files.root), *_blank(views, files.root), *_copies(files)]
    _check_names(named, files.origin)
    root = files.root if beside is None else Path(beside)
    chosen, split_warnings = choose_test_names(
        list(views),
        root=root,
        test_names=test_names,
        listed=files.test_names,
        annotated=annotated_names(root, views),
        test_every=test_every,
    )
    warnings += split_warnings
    for warning in warnings:
        logging.getLogger("lexsplat").warning(warning)
    return Capture(
        root=root,
        views=views,
        train_names=tuple(name for name in views if name not in set(chosen)),
        test_names=chosen,
        points=files.points,
        point_colors=files.point_colors,
        warnings=tuple(warnings),
        background=files.background,
    )


def _unposed(files: CameraFiles) -> list[str]:
    """Names of the photos in ``images/`` without a camera, whose masks are no mistake."""
    folder, posed = files.root / "images", {photo.path for photo in files.photos}
    if not folder.is_dir():
        return []
    return [path.relative_to(folder).as_posix() for path in images_below(folder)[0] if path not in posed]


def _copies(files: CameraFiles) -> list[str]:
    """A warning on photos that are byte for byte the same, if there are any."""
    copies = copies_of(Path(), [str(photo.path) for photo in files.photos])
    if not copies:
        return []
    copy, photo = min(copies.items())
    many = "1 photo is an exact copy" if len(copies) == 1 else f"{len(copies):,} photos are exact copies"
    told = f"{many} of another one, such as {Path(copy).name}, a copy of {Path(photo).name}"
    return [
        f"{files.origin}: {told}; one may be held out while the other is trained: remove it from the cameras"
    ]


def _transparent(views: Mapping[str, View], root: Path) -> list[str]:
    """A note that counts the photos of which transparent pixels are ignored, if there are any.

    Raises:
        CaptureError: If nothing but transparent pixels is there.
    """
    found = {
        name: transparency_of(view.image_path) for name, view in views.items() if view.ignores_transparent
    }
    hidden = [name for name, each in found.items() if each.hides]
    clear = [name for name in hidden if found[name].hides_all]
    if clear and len(clear) == len(views):
        remedy = "save the photos without an alpha channel"
        raise CaptureError(
            root, expected="photos that can be seen", found="only transparent ones", remedy=remedy
        )
    notes = [transparency_note(root, hidden)] if hidden else []
    if clear:
        notes.append(f"{root}: transparent throughout, so that they take no part: {some_of(clear)}")
    return notes


def _blank(views: Mapping[str, View], root: Path) -> list[str]:
    """A warning that counts the photos of which a mask leaves nothing, if there are any.

    Raises:
        CaptureError: If no other photo is left.
    """
    blank = blank_masks({name: view.ignore_path for name, view in views.items() if view.ignore_path})
    if blank and len(blank) == len(views):
        raise CaptureError(root, expected="masks with white pixels", found="only black ones", remedy=INVERTED)
    if not blank:
        return []
    told = (
        f"{len(blank)} of {len(views)} photos take no part, because their masks are black: {some_of(blank)}"
    )
    return [f"{root}: {told}; {INVERTED}"]


def _missing_files(files: CameraFiles) -> list[str]:
    """A warning that lists the images without a file, if there are any."""
    if not files.photos:
        raise CaptureError(
            files.origin,
            expected="images with files",
            found=f"{len(files.missing)} images without a file",
            remedy="put the images where the camera files name them, for COLMAP into images/",
        )
    if not files.missing:
        return []
    total = len(files.photos) + len(files.missing)
    names = ", ".join(sorted(files.missing))
    return [f"{files.origin}: {len(files.missing)} of {total} images have no file and are skipped: {names}"]


def _check_names(names: list[str], origin: Path) -> None:
    """Refuse duplicate images, and images whose names differ in their suffix only: index maps, masks and heatmaps are
    named after stems.
    """
    stems: dict[str, str] = {}
    for name in names:
        other = stems.get(stem_of(name))
        if other == name:
            raise CaptureError(
                origin,
                expected="every image once",
                found=f"{name} twice",
                remedy="remove one of the two from the file",
            )
        if other is not None:
            raise CaptureError(
                origin,
                expected="image names that differ in more than their suffix",
                found=f"{other} and {name}",
                remedy="rename or remove one of the two",
            )
        stems[stem_of(name)] = name


def _read_camera_files(path: Path, images: Path | None) -> CameraFiles:
    if path.is_file() and path.suffix == ".json":
        return read_transforms(path)
    if not path.is_dir():
        found = "a file" if path.exists() else "no such folder"
        raise CaptureError(path, expected="a capture folder", found=found, remedy="check the path")
    model = find_model(path)
    if model is not None:
        return read_colmap(path, model, images)
    transforms = find_transforms(path)
    if transforms is not None:
        return read_transforms(transforms)
    photos = _photos_of(path)
    if photos:
        raise CaptureError(
            path,
            expected="cameras (a COLMAP model in sparse/0, or transforms.json)",
            found=f"{len(photos)} photos without cameras",
            remedy=f"run: lexsplat poses {quote(str(path))}",
        )
    found, videos = "neither cameras nor photos", videos_in(path)
    raise CaptureError(
        path,
        expected="photos with a COLMAP model in sparse/0 or a transforms.json",
        found=f"{found}, but {videos[0]}" if videos else found if any(path.iterdir()) else "an empty folder",
        remedy=f"give {path / videos[0]}" if videos else "give the folder of a capture",
    )


def check_capture(path: Path) -> None:
    """Refuse a path that holds neither cameras nor photos; cameras are not read.

    Raises:
        CaptureError: With what is there instead.
    """
    if not (path.is_file() or is_photo_folder(path) or _has_cameras(path)):
        _read_camera_files(path, None)


def is_photo_folder(path: Path) -> bool:
    """Whether a folder holds photos but no cameras, so that cameras have to be estimated first.

    A video counts as such a folder of frames.
    """
    return is_video(path) or (path.is_dir() and not _has_cameras(path) and bool(_photos_of(path)))


def _has_cameras(path: Path) -> bool:
    return find_model(path) is not None or find_transforms(path) is not None


def _photos_of(path: Path) -> list[Path]:
    folders = [folder for folder in (path, path / "images") if folder.is_dir()]
    return sorted(f for folder in folders for f in folder.iterdir() if is_image_file(f))


def _make_view(photo: Photo, files: CameraFiles, downscale: float, mask: Path | None) -> View:
    """A view with a pinhole camera for the photo's actual size; ``mask`` is the file from ``masks/``, if any."""
    found = image_size(photo.path)
    stated = (photo.lens.width, photo.lens.height)
    # Photos scaled after the cameras were computed are common (images_4 of Mip-NeRF 360). Another aspect
    # means that the photo was cropped, rotated or replaced, and its camera is unknown.
    if not sizes_agree(found, stated):
        turned = " (rotated by 90 degrees)" if sizes_agree(found[::-1], stated) else ""
        raise CaptureError(
            photo.path,
            expected=f"{stated[0]}x{stated[1]} pixels as in {files.origin}, or scaled uniformly",
            found=f"{found[0]}x{found[1]}{turned}",
            remedy="use the photos the cameras were computed from, not cropped or rotated",
        )
    try:
        lens = photo.lens.resized(*found)
        width, height, K = pinhole_of(lens)
        camera = Camera(width, height, K, photo.viewmat)
    except ValueError as error:
        raise CaptureError(
            files.origin,
            expected=f"a usable camera for image {photo.name}",
            found=str(error),
            remedy="correct the camera, or run COLMAP again with a simpler camera model",
        ) from error
    view = View(
        name=photo.name,
        image_path=photo.path,
        camera=camera if downscale == 1 else camera.downscaled(downscale),
        capture_size=(width, height),
        lens=lens,
        background=files.background,
        ignore_path=photo.ignore_path or mask,
        ignores_transparent=not files.is_cut_out and transparency_of(photo.path).is_any,
    )
    if view.ignore_path is not None:
        view.check_mask(view.ignore_path)  # report a mask of the wrong size now, not during training
    return view
