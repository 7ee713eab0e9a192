"""Reads ``transforms.json`` of nerfstudio, instant-ngp and NeRF-synthetic captures.

Poses are camera to world with OpenGL axes. Intrinsics are given at the top level, per frame, or both; those of the
frame take precedence.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.images.reading import IMAGE_SUFFIXES, image_size
from lexsplat.captures.images.undistortion import Lens
from lexsplat.captures.readers.camera_files import (
    CameraFiles,
    Photo,
    checked_lens,
    checked_name,
    checked_pose,
)
from lexsplat.geometry.cameras import OPENGL_TO_OPENCV
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import read_json

SPLIT_FILES = {"train": "transforms_train.json", "test": "transforms_test.json"}
"""The files of NeRF-synthetic; its validation views are not used."""

MAX_FRAMES = 1_000_000

_PERSPECTIVE = (
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "PERSPECTIVE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
)
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_MODELS = dict.fromkeys(_PERSPECTIVE, "FULL_OPENCV") | dict.fromkeys(_FISHEYE, "OPENCV_FISHEYE")
"""COLMAP model, with all distortion parameters, of each ``camera_model`` of nerfstudio."""

_UNSUPPORTED_LENSES = ("equirectangular", "is_equirectangular", "latlong", "ftheta_p0", "orthographic")


def find_transforms(root: Path) -> Path | None:
    """``transforms.json``, or NeRF-synthetic's ``transforms_train.json``, or None."""
    for name in ("transforms.json", SPLIT_FILES["train"]):
        if (root / name).is_file():
            return root / name
    return None


def read_transforms(file: Path) -> CameraFiles:
    """Read a ``transforms.json``, or NeRF-synthetic's files for train and test.

    Raises:
        FileFormatError: If a file is not JSON in this format.
        CaptureError: If a camera or pose cannot be used.
    """
    root = file.parent
    files = [file]
    if file.name == SPLIT_FILES["train"] and (root / SPLIT_FILES["test"]).is_file():
        files.append(root / SPLIT_FILES["test"])
    photos: list[Photo] = []
    missing: list[str] = []
    test_names: list[str] | None = None
    synthetic = False
    for part in files:
        document = read_json(part, remedy="copy the file again or correct it")
        reader = _Reader(part, document)
        found = [reader.photo(frame) for frame in reader.frames()]
        photos += [photo for photo, _ in found if photo is not None]
        missing += [name for photo, name in found if photo is None]
        names = [name for _, name in found]
        if part.name == SPLIT_FILES["test"]:
            test_names = names
        elif reader.listed_test_names() is not None:
            test_names = reader.listed_test_names()
        synthetic |= reader.sizes_come_from_images
    shared = _shared_folder([photo.name for photo in photos] + missing)
    if shared:
        photos = [replace(photo, name=photo.name.removeprefix(shared)) for photo in photos]
        missing = [name.removeprefix(shared) for name in missing]
        test_names = None if test_names is None else [name.removeprefix(shared) for name in test_names]
    return CameraFiles(
        root=root,
        origin=file,
        photos=photos,
        missing=missing,
        test_names=test_names,
        # NeRF-synthetic images are transparent where nothing is, and its benchmarks composite them on white.
        background=(1.0, 1.0, 1.0) if synthetic else (0.0, 0.0, 0.0),
        is_cut_out=synthetic,
    )


def _shared_folder(names: list[str]) -> str:
    """``"images/"`` if all names start with it, else ``""``: names are relative to the image folder."""
    heads = {name.split("/")[0] + "/" if "/" in name else "" for name in names}
    head = heads.pop() if len(heads) == 1 else ""
    return head if re.fullmatch(r"(images|rgb|input)(_\d+)?/", head) else ""


class _Reader:
    """One ``transforms.json``: converts frames to photos, with the file's defaults."""

    def __init__(self, file: Path, document: Any) -> None:
        self.file = file
        if not isinstance(document, Mapping) or not isinstance(document.get("frames"), list):
            raise FileFormatError(
                file,
                expected='an object with a list "frames"',
                found=type(document).__name__ if not isinstance(document, Mapping) else "no such list",
                remedy="export the capture again with nerfstudio or instant-ngp",
            )
        self.document = document
        places = [document, *(frame for frame in document["frames"] if isinstance(frame, Mapping))]
        self.sizes_come_from_images = not any("w" in place or "fl_x" in place for place in places)
        for key in _UNSUPPORTED_LENSES:
            if document.get(key):
                remedy = "cut the images into perspective views before building"
                raise self._wrong("perspective or fisheye images", f'"{key}"', remedy)

    def frames(self) -> list[Mapping[str, Any]]:
        """The frames, checked to be objects with a ``file_path``."""
        frames = self.document["frames"]
        if len(frames) > MAX_FRAMES:
            raise self._wrong(f"at most {MAX_FRAMES} frames", str(len(frames)))
        for index, frame in enumerate(frames):
            if not isinstance(frame, Mapping) or not isinstance(frame.get("file_path"), str):
                raise self._wrong(f'frame {index} with a "file_path"', repr(frame)[:60])
        return frames

    def listed_test_names(self) -> list[str] | None:
        """nerfstudio's split, or None."""
        names = self.document.get("test_filenames")
        if not isinstance(names, list) or not names:
            return None
        if not all(isinstance(name, str) for name in names):
            raise self._wrong('"test_filenames" to be strings', "other types")
        return [checked_name(name, self.file) for name in names]

    def photo(self, frame: Mapping[str, Any]) -> tuple[Photo | None, str]:
        """The photo of a frame, or None if its file does not exist, and its name."""
        name, path = self._find(checked_name(frame["file_path"], self.file))
        viewmat = self._viewmat(frame, name)
        if path is None:
            return None, name
        ignore = frame.get("mask_path")
        ignore_path = None
        if isinstance(ignore, str):
            ignore_path = self.file.parent / checked_name(ignore, self.file)
        return Photo(name, path, self._lens(frame, name, path), viewmat, ignore_path), name

    def _find(self, name: str) -> tuple[str, Path | None]:
        """The name with its suffix, which NeRF-synthetic omits, and the file if it exists."""
        for suffix in ("", *IMAGE_SUFFIXES, *(suffix.upper() for suffix in IMAGE_SUFFIXES)):
            path = self.file.parent / (name + suffix)
            if path.is_file():
                return name + suffix, path
        return name, None

    def _number(self, frame: Mapping[str, Any], key: str, default: float | None = None) -> float | None:
        value = frame.get(key, self.document.get(key, default))
        if value is None:
            return None
        if (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or not abs(value) <= sys.float_info.max
        ):
            remedy = "correct the file or export the capture again"
            raise self._wrong(f'a finite number for "{key}"', repr(value)[:60], remedy)
        return float(value)

    def _lens(self, frame: Mapping[str, Any], name: str, path: Path) -> Lens:
        width, height = self._number(frame, "w"), self._number(frame, "h")
        if width is None or height is None:
            width, height = image_size(path)
        focal_x = self._focal(frame, "fl_x", "camera_angle_x", width)
        focal_y = self._focal(frame, "fl_y", "camera_angle_y", height)
        focal_x, focal_y = focal_y if focal_x is None else focal_x, focal_x if focal_y is None else focal_y
        if focal_x is None or focal_y is None:
            expected = f'"fl_x" or "camera_angle_x" for image {name}'
            raise self._wrong(expected, "neither", "add the focal length in pixels as fl_x")
        center = (self._number(frame, "cx", width / 2), self._number(frame, "cy", height / 2))
        model = self._model(frame)
        k1, k2, k3, k4, k5, k6, p1, p2 = (
            self._number(frame, key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
        )
        if model == "OPENCV_FISHEYE":
            distortion: tuple[float | None, ...] = (k1, k2, k3, k4)
        else:
            # OpenCV's order: k4 to k6 are the coefficients of the denominator.
            distortion = (k1, k2, p1, p2, k3, k4, k5, k6)
            if not any(distortion):
                model, distortion = "PINHOLE", ()
        params = [p for p in (focal_x, focal_y, *center, *distortion) if p is not None]
        return checked_lens(model, (round(width), round(height)), params, f"for image {name}", self.file)

    def _focal(self, frame: Mapping[str, Any], key: str, angle_key: str, side: float) -> float | None:
        """Focal length in pixels from its own key or from the angle of view; keys of the frame take precedence."""
        if key not in frame and (angle_key in frame or key not in self.document):
            angle = self._number(frame, angle_key)
            if angle is None:
                return self._number(frame, key)
            if not 0 < angle < math.pi:
                raise self._wrong(f'"{angle_key}" between 0 and pi', f"{angle:g}")
            return 0.5 * side / math.tan(0.5 * angle)
        return self._number(frame, key)

    def _model(self, frame: Mapping[str, Any]) -> str:
        if frame.get("is_fisheye", self.document.get("is_fisheye")):
            return "OPENCV_FISHEYE"
        model = frame.get("camera_model", self.document.get("camera_model", "OPENCV"))
        if not isinstance(model, str) or model.upper() not in _MODELS:
            expected = f"a camera_model of {', '.join(sorted(_MODELS))}"
            raise self._wrong(expected, repr(model)[:60], "undistort the images to PINHOLE before building")
        return _MODELS[model.upper()]

    def _viewmat(self, frame: Mapping[str, Any], name: str) -> NDArray[np.float64]:
        """World to camera from ``transform_matrix``; its rotation is orthonormalized and its scale removed."""
        try:
            pose = np.array(frame.get("transform_matrix"), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        if pose.shape not in ((4, 4), (3, 4)):
            raise self._wrong(f"a 4x4 transform_matrix for image {name}", "another shape")
        checked_pose(pose, name, self.file)
        U, singular, Vt = np.linalg.svd(pose[:3, :3])
        rotation = U @ Vt
        if not singular[2] > 0.95 * singular[0] or np.linalg.det(rotation) < 0:
            scales = f"scales of {singular[0]:.3g} and {singular[2]:.3g}"
            found = f"{scales}, determinant {np.linalg.det(pose[:3, :3]):.3g}"
            expected = f"a rotation in the transform_matrix of image {name}"
            raise self._wrong(expected, found, "export the capture again")
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = rotation
        camera_to_world[:3, 3] = pose[:3, 3]
        return np.asarray(np.linalg.inv(camera_to_world @ OPENGL_TO_OPENCV), dtype=np.float64)

    def _wrong(self, expected: str, found: str, remedy: str = "correct the file") -> CaptureError:
        return CaptureError(self.file, expected=expected, found=found, remedy=remedy)
