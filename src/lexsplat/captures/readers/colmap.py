"""Reads COLMAP models, binary and text.

pycolmap defines the camera models but does not read the files: of 184 damaged models of four images, 11 (all with a
damaged ``points3D.bin``) keep ``pycolmap.Reconstruction`` 4.2.1 busy for more than 4 s, with up to 1.3 GB of memory.
This reader checks each count against the bytes that remain before using it. Tests compare it with pycolmap on valid
models.

Format: https://colmap.github.io/format.html (cameras, images, points3D). The rigs and frames of newer versions are
not needed, because images still contain their full pose.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.images.undistortion import Lens
from lexsplat.captures.readers.camera_files import (
    MAX_COORDINATE,
    CameraFiles,
    Photo,
    checked_lens,
    checked_name,
    checked_pose,
)
from lexsplat.geometry.rotations import matrix_from_quaternion
from lexsplat.runtime.errors import FileFormatError

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0", ".")
"""Folders of a capture that are searched for a model, in this order."""

IMAGE_FOLDERS = ("images", "input", "image", "rgb", "images_2", "images_4", "images_8", ".")
"""Folders of a capture that are searched for photos, in this order."""


def find_model(root: Path) -> Path | None:
    """The folder of a capture that holds a COLMAP model, or None."""
    for name in MODEL_FOLDERS:
        folder = root / name
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_colmap(root: Path, model: Path, images: Path | None = None) -> CameraFiles:
    """Read a COLMAP model.

    Args:
        root: The capture folder, which holds the photos.
        model: The folder with ``cameras``, ``images`` and (optionally) ``points3D``, ``.bin`` or ``.txt``.
        images: The folder of the photos; None searches ``root`` (`IMAGE_FOLDERS`).

    Raises:
        FileFormatError: If a file is truncated or damaged.
        CaptureError: If a camera or pose cannot be used, or no image has a file.
    """
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    lenses = _lenses_by_id(model / f"cameras{suffix}")
    images_file = model / f"images{suffix}"
    if not images_file.is_file():
        raise _damaged(images_file, "the model's images", "no such file")
    entries = list(_read_images(images_file))
    names = [checked_name(name, images_file) for name, _, _ in entries]
    folder = _image_folder(root, names) if images is None else images
    photos, missing = [], []
    for name, (_, camera_id, pose) in zip(names, entries):
        if camera_id not in lenses:
            expected = f"camera {camera_id} of image {name} in cameras{suffix}"
            raise _damaged(images_file, expected, f"cameras {sorted(lenses)[:8]}")
        viewmat = _viewmat(pose, name, images_file)
        if (folder / name).is_file():
            photos.append(Photo(name, folder / name, lenses[camera_id], viewmat))
        else:
            missing.append(name)
    found = CameraFiles(root=root, origin=model, photos=photos, missing=missing)
    points_file = model / f"points3D{suffix}"
    if not points_file.is_file():
        return found
    points, colors, dropped = _read_points(points_file)
    warning = f"{points_file}: {dropped} points with NaN, infinity or huge coordinates dropped"
    return replace(found, points=points, point_colors=colors, warnings=[warning] if dropped else [])


def _lenses_by_id(file: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for camera_id, lens in _read_cameras(file):
        if camera_id in lenses:
            raise _damaged(file, "every camera once", f"camera {camera_id} twice")
        lenses[camera_id] = lens
    return lenses


def _image_folder(root: Path, names: list[str]) -> Path:
    """The folder with most of the images; on a tie, the first one."""
    folders = [root / name for name in IMAGE_FOLDERS if (root / name).is_dir()]
    return max(folders, key=lambda folder: sum((folder / name).is_file() for name in names))


def _viewmat(pose: tuple[float, ...], name: str, origin: Path) -> NDArray[np.float64]:
    """World to camera ``[4, 4]`` from COLMAP's quaternion (wxyz, normalized here) and translation."""
    viewmat = np.eye(4)
    with np.errstate(all="ignore"):  # damaged numbers overflow here; the check below names the image
        viewmat[:3, :3] = matrix_from_quaternion(np.array(pose[:4]))
    viewmat[:3, 3] = pose[4:]
    return checked_pose(viewmat, name, origin)


def _damaged(file: Path, expected: str, found: str) -> FileFormatError:
    remedy = "copy the file again, or run COLMAP again"
    return FileFormatError(file, expected=expected, found=found, remedy=remedy)


class _Bytes:
    """A binary file read sequentially; every length is checked before it is used."""

    def __init__(self, file: Path) -> None:
        self.file = file
        try:
            self.data = file.read_bytes()
        except OSError as error:
            raise _damaged(file, "a readable file", str(error.strerror)) from error
        self.position = 0

    def take(self, layout: struct.Struct, what: str) -> tuple:
        """The next record of a fixed layout."""
        self.need(layout.size, what)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def need(self, size: int, what: str) -> None:
        """Check that ``size`` bytes are left."""
        left = len(self.data) - self.position
        if size > left:
            raise _damaged(self.file, f"{size} bytes of {what} at byte {self.position}", f"{left} bytes left")

    def count(self, smallest: int, what: str) -> int:
        """Read a number of records of at least ``smallest`` bytes each, and check that they can fit."""
        (count,) = self.take(_COUNT, f"number of {what}")
        left = len(self.data) - self.position
        if count * smallest > left:
            raise _damaged(self.file, f"{count} {what} of at least {smallest} bytes", f"{left} bytes left")
        return count

    def skip(self, size: int, what: str) -> None:
        """Skip bytes."""
        self.need(size, what)
        self.position += size

    def text(self, what: str) -> str:
        """A zero-terminated string."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise _damaged(self.file, f"{what} at byte {self.position}", "the end of the file")
        raw = self.data[self.position : end]
        self.position = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise _damaged(self.file, f"{what} in UTF-8", repr(raw[:40])) from error

    def finish(self) -> None:
        """Check that the whole file has been read."""
        left = len(self.data) - self.position
        if left:
            raise _damaged(self.file, "the end of the file", f"{left} more bytes")


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I4d3dI")
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES = 24  # x, y, point id
_TRACK_BYTES = 8  # image id, observation index


_Image = tuple[str, int, tuple[float, ...]]
"""Name, camera and pose of an image: world to camera, quaternion (wxyz) and translation."""


def _read_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    if file.suffix == ".txt":
        for line in _records(file, _lines(file)):
            words = line.split()
            try:
                camera_id, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
                params = tuple(map(float, words[4:]))
            except (ValueError, IndexError) as error:
                raise _damaged(file, "ID MODEL WIDTH HEIGHT PARAMS", repr(line[:60])) from error
            yield camera_id, checked_lens(model, (width, height), params, str(camera_id), file)
        return
    models = {
        int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"
    }
    content = _Bytes(file)
    for _ in range(content.count(_CAMERA.size, "cameras")):
        camera_id, number, width, height = content.take(_CAMERA, "a camera")
        if number not in models:
            raise _damaged(file, "a camera model of COLMAP", f"model number {number}")
        model = models[number]
        count = len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2).params)
        params = content.take(struct.Struct(f"<{count}d"), f"{model} parameters")
        yield camera_id, checked_lens(model, (width, height), params, str(camera_id), file)
    content.finish()


def _read_images(file: Path) -> Iterator[_Image]:
    if file.suffix == ".txt":
        yield from _read_images_text(file)
        return
    content = _Bytes(file)
    for _ in range(content.count(_IMAGE.size + 1 + _COUNT.size, "images")):
        _, *pose, camera_id = content.take(_IMAGE, "an image")
        name = content.text("an image name")
        observations = content.count(_OBSERVATION_BYTES, f"observations of {name[:60]}")
        content.skip(observations * _OBSERVATION_BYTES, f"observations of {name[:60]}")
        yield name, camera_id, tuple(pose)
    content.finish()


def _read_images_text(file: Path) -> Iterator[_Image]:
    lines = _lines(file)
    for line in _records(file, lines):
        words = line.strip().split(maxsplit=9)
        try:
            pose = tuple(float(word) for word in words[1:8])
            camera_id, name = int(words[8]), words[9]
        except (ValueError, IndexError) as error:
            raise _damaged(file, "ID QW QX QY QZ TX TY TZ CAMERA NAME", repr(line[:60])) from error
        # The second line of every image lists its observations; it may be empty but not absent.
        observations = next(lines, None)
        if observations is None or not _are_observations(observations):
            instead = "the end of the file" if observations is None else repr(observations[:60])
            raise _damaged(file, f"a line of observations after image {name}", instead)
        yield name, camera_id, pose


def _are_observations(line: str) -> bool:
    """Whether a line consists of ``X Y POINT`` triples: checks their number and the last one."""
    words = line.split()
    try:
        float(words[-2]), int(words[-1])
    except (IndexError, ValueError):
        return not words
    return len(words) % 3 == 0


def _read_points(file: Path) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
    """Points, colors in 0..1, and the number of points dropped for numbers that are not finite."""
    numbers = array("d")  # 8 bytes per number; a list of tuples takes 50
    for row in _point_rows_text(file) if file.suffix == ".txt" else _point_rows_binary(file):
        numbers.extend(row)
    table = np.array(numbers, dtype=np.float64).reshape(-1, 6)
    keep = np.isfinite(table).all(1) & (np.abs(table[:, :3]) < MAX_COORDINATE).all(1)
    points, colors = table[keep, :3], np.clip(table[keep, 3:] / 255.0, 0.0, 1.0)
    return points.astype(np.float32), colors.astype(np.float32), int((~keep).sum())


def _point_rows_binary(file: Path) -> Iterator[tuple[float, ...]]:
    content = _Bytes(file)
    for _ in range(content.count(_POINT.size, "points")):
        _, x, y, z, red, green, blue, _, track = content.take(_POINT, "a point")
        content.skip(track * _TRACK_BYTES, "a track")
        yield x, y, z, red, green, blue
    content.finish()


def _point_rows_text(file: Path) -> Iterator[tuple[float, ...]]:
    for line in _records(file, _lines(file)):
        words = line.split(maxsplit=8)
        try:
            row = tuple(float(word) for word in words[1:7])
            if len(row) < 6 or len(words) < 8:
                raise ValueError("too few numbers")
        except ValueError as error:
            raise _damaged(file, "ID X Y Z R G B ERROR TRACK", repr(line[:60])) from error
        yield row


def _lines(file: Path) -> Iterator[str]:
    try:
        # Not str.splitlines, which also splits names at exotic separators.
        text = file.read_bytes().decode("utf-8")
    except OSError as error:
        raise _damaged(file, "a readable file", str(error.strerror)) from error
    except UnicodeDecodeError as error:
        raise _damaged(file, "text in UTF-8", f"invalid UTF-8 at byte {error.start}") from error
    if "\0" in text:
        raise _damaged(file, "text", "zero bytes")
    # Keeps the empty string after the last newline: the empty observation line that many writers omit.
    return iter(text.replace("\r\n", "\n").split("\n"))


def _records(file: Path, lines: Iterator[str]) -> Iterator[str]:
    """Lines with content. Raises at the end if a comment ``# Number of images: 12, ...`` announces more."""
    promised, found = 0, 0
    for line in lines:
        if line.startswith("#") or not line.strip():
            if match := re.match(r"# Number of [^:]*:\s*([0-9]{1,18})\s*(,|$)", line):
                promised = int(match[1])
            continue
        found += 1
        yield line
    # Only a shortfall is damage: people add lines by hand and leave the comment unchanged.
    if found < promised:
        raise _damaged(file, f"{promised} {file.stem}, as its header states", f"{found}")
