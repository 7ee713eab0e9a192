"""`CameraFiles`, the result of every reader of camera files: photos with lenses and poses, sizes not checked yet."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.images.undistortion import Lens
from lexsplat.runtime.errors import CaptureError

MAX_COORDINATE = 1e7
"""Largest coordinate of a camera or point in world units; beyond it, float32 is too coarse for a scene."""


@dataclass(frozen=True)
class Photo:
    """An image and its camera, as stated by the camera files.

    Args:
        name: Path relative to the image folder, with "/".
        path: The image file.
        lens: The lens, at the size that the camera files state.
        viewmat: World to camera ``[4, 4]``, OpenCV axes.
        ignore_path: Mask of ignored pixels, which are black, or None.
    """

    name: str
    path: Path
    lens: Lens
    viewmat: NDArray[np.float64]
    ignore_path: Path | None = None


@dataclass(frozen=True)
class CameraFiles:
    """The content of a capture's camera files.

    Args:
        root: The capture folder.
        origin: The file or folder of the cameras, for messages.
        photos: The photos whose file exists.
        points: Points ``[P, 3]`` float32, world.
        point_colors: Their colors ``[P, 3]`` float32 in 0..1.
        missing: Names of images that have a camera but no file.
        test_names: The split that the files prescribe, or None.
        background: Color behind transparent pixels.
        is_cut_out: Whether transparent pixels show the background, so that nothing is there; else they are ignored.
        warnings: Skipped content and the reasons.
    """

    root: Path
    origin: Path
    photos: list[Photo]
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    point_colors: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    missing: list[str] = field(default_factory=list)
    test_names: list[str] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_cut_out: bool = False
    warnings: list[str] = field(default_factory=list)


def checked_name(name: str, origin: Path) -> str:
    """An image name as a plain relative path with "/".

    Raises:
        CaptureError: If the name is empty, absolute, points outside the capture, or is not a valid file name.
    """
    plain = name.replace("\\", "/")
    parts = PurePosixPath(plain).parts
    drive = bool(parts) and len(parts[0]) == 2 and parts[0][1] == ":"
    if not _can_be_a_file(parts) or plain.startswith("/") or drive or ".." in parts:
        raise CaptureError(
            origin,
            expected="image names inside the capture folder",
            found=repr(name)[:100],
            remedy="move the images into the capture and name them relative to it",
        )
    return "/".join(parts)


def _can_be_a_file(parts: tuple[str, ...]) -> bool:
    """Whether a path is valid on a file system: no control characters or lone surrogates, not too long."""
    lengths = [len(part.encode("utf-8", "replace")) for part in parts]
    odd = any(unicodedata.category(letter) in ("Cc", "Cs") for part in parts for letter in part)
    return bool(parts) and max(lengths) <= 250 and sum(lengths) < 3000 and not odd


def checked_lens(model: str, size: tuple[int, int], params: Iterable[float], name: str, origin: Path) -> Lens:
    """The lens of a camera.

    Args:
        model: Name of the model in COLMAP.
        size: Width and height of its images in pixels.
        params: The parameters of the model.
        name: The camera in the message.
        origin: The file in the message.

    Raises:
        CaptureError: If the parameters are not those of a perspective camera.
    """
    try:
        return Lens(model, *size, tuple(float(value) for value in params))
    except ValueError as error:
        raise CaptureError(
            origin,
            expected=f"a perspective camera {name}",
            found=str(error),
            remedy="correct the camera in the file, or estimate it again with another camera model",
        ) from error


def checked_pose(viewmat: NDArray[np.float64], name: str, origin: Path) -> NDArray[np.float64]:
    """A world-to-camera matrix ``[4, 4]``, checked.

    Raises:
        CaptureError: If a number is not finite, or larger than `MAX_COORDINATE`.
    """
    if not np.isfinite(viewmat).all():
        raise CaptureError(
            origin,
            expected=f"a finite pose for image {name}",
            found="NaN or infinity",
            remedy="remove the image from the file or estimate its pose again",
        )
    if np.abs(viewmat).max() > MAX_COORDINATE:
        raise CaptureError(
            origin,
            expected=f"a pose for image {name} within {MAX_COORDINATE:g} units of the origin",
            found=f"{np.abs(viewmat).max():g}",
            remedy="remove the image from the file, or scale the scene",
        )
    return viewmat
