"""What a built scene is on disk: plain files, each written whole or not at all.

::

    scene.json            format_version, config, provenance, what each finished stage was made from
    cameras.json          views, intrinsics, poses, split
    gaussians.ply         the standard 3DGS PLY
    language.safetensors  the language field with its codebook
    codes/NAME.png        8-bit code index maps of the training views
    checkpoints/          what going on needs: codebook, features

A stage is finished when ``scene.json`` says so; the record is written after the stage's files. Its
*fingerprint* is a hash of everything the result depends on, so a later build can tell what it may keep.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lexsplat.captures.images.undistortion import MAX_SIDE
from lexsplat.captures.readers.camera_files import MAX_COORDINATE, checked_name
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError, SceneFolderError
from lexsplat.runtime.files import atomic_path, read_json, remove_left_overs, to_json, write_json

FORMAT_VERSION = 1
"""Raised when a reader of the old layout would misread the new one."""

SCENE_FILES = ("scene.json", "cameras.json", "gaussians.ply", "language.safetensors")
"""What a scene is made of."""


BUNDLED_SCENE = Path(__file__).resolve().parents[1] / "demo" / "scene"
"""The finished demo scene: what the word ``demo`` means where a scene folder is asked for."""


@dataclasses.dataclass(frozen=True)
class StoredView:
    """A view as the scene folder remembers it: enough to render, without the photo."""

    name: str
    camera: Camera
    split: str


def _checked_record(record: Any, path: Path) -> dict[str, Any]:
    """The content of ``scene.json``, of the types that the rest relies on.

    Raises:
        SceneFolderError: If it is of another format version.
        FileFormatError: If an entry is of a wrong type.
    """
    version = record.get("format_version") if isinstance(record, dict) else None
    if version != FORMAT_VERSION or not isinstance(record.get("stages"), dict):
        raise SceneFolderError(
            path,
            expected=f"format_version {FORMAT_VERSION}",
            found=repr(version)[:60],
            remedy="build the scene again with this version of lexsplat",
        )
    config = record.get("config", {})
    scale = config.get("downscale") if isinstance(config, dict) else None
    stages = all(isinstance(stage, dict) for stage in record["stages"].values())
    encoder = record["stages"].get("features", {}).get("clip_hash") if stages else None
    sound = {
        "stages": stages,
        # It becomes part of a file name.
        "clip_hash": encoder is None or (isinstance(encoder, str) and re.fullmatch(r"[\w-]+", encoder)),
        "config": isinstance(config, dict) and isinstance(config.get("clip", ""), str),
        "downscale": scale is None or (isinstance(scale, (int, float)) and 0 < scale < 1e6),
        "provenance": isinstance(record.get("provenance", {}), dict),
        "warnings": isinstance(record.get("warnings", []), list),
        "capture": isinstance(record.get("capture"), (str, type(None))),
        "images": isinstance(record.get("images"), (str, type(None))),
    }
    wrong = [name for name, holds in sound.items() if not holds]
    if wrong:
        raise FileFormatError(
            path, expected=f"{wrong[0]} as a build writes it", found="something else", remedy="build again"
        )
    return record


_RENAMED_SETTINGS = {"averaging": "averaged", "embedding": "trained", "lifting": "lifted"}


def _in_todays_words(record: dict[str, Any]) -> dict[str, Any]:
    """A checked record whose stage, encoders, settings and scale have the names of today.

    Scene folders of format version 1 that were written before the renames say ``embed``, ``embedded`` and
    ``metres_per_unit``.
    """
    stages = {("language" if name == "embed" else name): facts for name, facts in record["stages"].items()}
    config = {_RENAMED_SETTINGS.get(name, name): value for name, value in record.get("config", {}).items()}
    for encoder in ("clip", "dino"):
        if config.get(encoder) == "embedded":
            config[encoder] = "bundled"
    renamed = {**record, "stages": stages, **({"config": config} if config else {})}
    world = record.get("world")
    if isinstance(world, dict) and "metres_per_unit" in world:
        renamed["world"] = {
            ("meters_per_unit" if name == "metres_per_unit" else name): value for name, value in world.items()
        }
    return renamed


def _stored_view(entry: Any, path: Path) -> StoredView:
    """A view of ``cameras.json``.

    Raises:
        CaptureError: If its name leads out of the folder.
        KeyError, TypeError, ValueError, OverflowError: If something is missing or makes no sense.
    """
    name, split, width, height = entry["name"], entry["split"], entry["width"], entry["height"]
    if not isinstance(name, str) or split not in ("train", "test"):
        raise ValueError(f"view {name!r} of split {split!r}"[:100])
    if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in (width, height)):
        raise ValueError(f"size {width!r} x {height!r}"[:100])
    camera = Camera(width, height, np.array(entry["K"], float), np.array(entry["viewmat"], float))
    if np.abs(camera.viewmat).max() > MAX_COORDINATE:
        raise ValueError(f"the pose of {name!r} is too far from the origin"[:100])
    turn = camera.viewmat[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise ValueError(f"the pose of {name!r} has no rotation"[:100])
    return StoredView(checked_name(name, path), camera, split)


class SceneFolder:
    """A scene folder, open for reading or being built.

    Args:
        root: The folder.
        content: Where record, cameras, Gaussians and language lie, if not there (`lexsplat.scenes.previous`).

    Raises:
        SceneFolderError: If there is a ``scene.json`` of another format version.
    """

    def __init__(self, root: Path, content: Path | None = None) -> None:
        self.root = Path(root)
        self.content = self.root if content is None else content
        self.record: dict[str, Any] = {"format_version": FORMAT_VERSION, "stages": {}}
        if self._record_path.exists():
            self.record = _in_todays_words(_checked_record(read_json(self._record_path), self._record_path))

    @classmethod
    def open(cls, root: Path) -> SceneFolder:
        """Open a folder that a build has made; the word ``demo`` is the scene that ships with the package.

        Raises:
            SceneFolderError: If it is not a scene folder.
        """
        if str(root) == "demo" and not Path(root).exists():
            root = BUNDLED_SCENE
        if not (Path(root) / "scene.json").is_file():
            found = "no such folder" if not Path(root).is_dir() else "no scene.json in it"
            raise SceneFolderError(
                root,
                expected="a scene folder",
                found=found,
                remedy="make one with: lexsplat build CAPTURE --output SCENE",
            )
        return cls(root)

    @property
    def is_bundled(self) -> bool:
        """Whether this is the scene that ships with the package: it is read, never written."""
        return self.root.resolve() == BUNDLED_SCENE

    @property
    def _record_path(self) -> Path:
        return self.content / "scene.json"

    @property
    def gaussians_path(self) -> Path:
        """``gaussians.ply``."""
        return self.content / "gaussians.ply"

    @property
    def language_path(self) -> Path:
        """``language.safetensors``."""
        return self.content / "language.safetensors"

    @property
    def codebook_path(self) -> Path:
        """``checkpoints/codebook.safetensors``."""
        return self.root / "checkpoints" / "codebook.safetensors"

    @property
    def features_path(self) -> Path:
        """``checkpoints/features/``: the feature cache."""
        return self.root / "checkpoints" / "features"

    def code_map_path(self, name: str) -> Path:
        """``codes/NAME.png`` for the view ``name``: its folders stay, its suffix becomes .png."""
        return self.root / "codes" / Path(name).with_suffix(".png")

    def refuse_own_file(self, path: Path) -> None:
        """Refuse to write what would take the place of a file that the scene is made of, or of its measurements.

        Raises:
            SceneFolderError: If ``path`` is one.
        """
        own = {self.root / name for name in (*SCENE_FILES, "metrics.json", "metrics.csv", "viewer.json")}
        if path.resolve() in {file.resolve() for file in own}:
            raise SceneFolderError(
                path,
                expected="a file beside the scene's own",
                found="one of them",
                remedy="give another name",
            )

    def refuse_foreign_files(self) -> None:
        """Refuse a folder in which a build would take the place of files that no build has made.

        Raises:
            SceneFolderError: If there are some: ``scene.json`` is the first file of a build.
        """
        there = [name for name in SCENE_FILES if (self.root / name).exists()]
        if there and "scene.json" not in there:
            raise SceneFolderError(
                self.root / there[0],
                expected="a new folder or one of an earlier build",
                found="a file of another program",
                remedy="give another --output",
            )

    # -- stages

    def is_finished(self, stage: str, made_from: str) -> bool:
        """Whether ``stage`` is finished and was made from the same things (see `fingerprint`)."""
        return self.record["stages"].get(stage, {}).get("fingerprint") == made_from

    def finish(self, stage: str, made_from: str, seconds: float, **facts: Any) -> None:
        """Record that the files of ``stage`` are complete."""
        self.record["stages"][stage] = {
            "fingerprint": made_from,
            "seconds": round(seconds, 3),
            **to_json(facts),
        }
        self.save()

    def reopen(self, stage: str) -> None:
        """Forget that ``stage`` was finished: its files are about to change."""
        if self.record["stages"].pop(stage, None) is not None:
            self.save()

    def stage_seconds(self) -> dict[str, float]:
        """Seconds each finished stage took."""
        return {name: stage.get("seconds", 0.0) for name, stage in self.record["stages"].items()}

    def save(self) -> None:
        """Write ``scene.json``."""
        write_json(self._record_path, self.record)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for one builder; the lock goes when the process does, however it ends.

        Raises:
            SceneFolderError: If another process builds here.
        """
        try:
            import fcntl
        except ImportError:  # Windows has no flock; two builders there are the user's care.
            yield
            return
        self.root.mkdir(parents=True, exist_ok=True)
        with open(self.root / ".lock", "a+", encoding="ascii") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                file.seek(0)
                holder = file.read(20).strip() or "another process"
                raise SceneFolderError(
                    self.root,
                    expected="a folder nobody builds in",
                    found=f"process {holder} at work",
                    remedy="wait for it or give another --output",
                ) from error
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            remove_left_overs(self.root)
            yield

    def withdraw(self) -> None:
        """Take back the record of a build that ended before anything was made; a folder that holds more stays."""
        files = [path for path in self.root.rglob("*") if not path.is_dir()]
        begun = {self.root / name for name in (".lock", "scene.json", "cameras.json")}
        if self.record["stages"] or not set(files) <= begun:
            return
        for path in files:
            path.unlink(missing_ok=True)
        folders = sorted(path for path in self.root.rglob("*") if path.is_dir())
        for path in [*reversed(folders), self.root]:
            with contextlib.suppress(OSError):
                path.rmdir()

    # -- content

    def write_cameras(self, views: Mapping[str, tuple[Camera, str]]) -> None:
        """Write ``cameras.json`` from ``{name: (camera, "train" | "test")}``."""
        entries = [
            {
                "name": name,
                "split": split,
                "width": c.width,
                "height": c.height,
                "K": c.K,
                "viewmat": c.viewmat,
            }
            for name, (c, split) in views.items()
        ]
        write_json(self.root / "cameras.json", {"format_version": FORMAT_VERSION, "views": entries})

    def read_cameras(self) -> dict[str, StoredView]:
        """The views by name.

        Raises:
            FileFormatError: If ``cameras.json`` is missing or malformed.
        """
        path = self.content / "cameras.json"
        content = read_json(path)
        try:
            views = [_stored_view(entry, path) for entry in content["views"]]
            if len({view.name for view in views}) < len(views):
                raise ValueError("a view twice")
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise FileFormatError(
                path,
                expected="views with name, split, size, K and viewmat",
                found=repr(error)[:200],
                remedy="build again",
            ) from error
        return {view.name: view for view in views}

    def write_gaussians(self, gaussians: Gaussians) -> None:
        """Write ``gaussians.ply``."""
        from lexsplat.scenes.formats.ply import write_ply

        with atomic_path(self.gaussians_path) as temporary:
            write_ply(gaussians, temporary)

    def read_gaussians(self) -> Gaussians:
        """Read ``gaussians.ply``."""
        from lexsplat.scenes.formats.ply import read_ply

        return read_ply(self.gaussians_path)

    def write_code_map(self, name: str, codes: np.ndarray) -> None:
        """Write one code index map, uint8 ``[h, w]``, as PNG."""
        with atomic_path(self.code_map_path(name)) as temporary:
            Image.fromarray(np.ascontiguousarray(codes, dtype=np.uint8)).save(temporary, format="PNG")

    def read_code_map(self, name: str) -> np.ndarray:
        """Read one code index map, uint8 ``[h, w]``.

        Raises:
            FileFormatError: If it is missing, damaged or not an 8-bit gray PNG.
        """
        path = self.code_map_path(name)
        try:
            content = path.read_bytes()
            with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
                if image.mode != "L":
                    raise FileFormatError(path, expected="an 8-bit gray PNG", found=f"mode {image.mode}")
                if len(_pixel_data(content, image.size)) != image.height * (image.width + 1):
                    raise FileFormatError(
                        path, expected=f"{image.width}x{image.height} codes", found="others"
                    )
                return np.array(image)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, zlib.error) as error:
            raise FileFormatError(path, expected="a code index map", found=str(error)) from error

    def bytes_on_disk(self, *paths: Path) -> int:
        """Bytes of the given files and folders (those that exist)."""
        total = 0
        for path in paths:
            files = path.rglob("*") if path.is_dir() else [path]
            total += sum(file.stat().st_size for file in files if file.is_file())
        return total


def _pixel_data(content: bytes, size: tuple[int, int]) -> bytes:
    """The unpacked pixels of an 8-bit gray PNG with the filter byte of each row; at most one byte too many.

    Pillow fills up with zeros what a PNG promises and does not hold, and zero is a code.
    """
    packed, place = [], 8
    while place + 8 <= len(content):
        length, kind = int.from_bytes(content[place : place + 4], "big"), content[place + 4 : place + 8]
        if kind == b"IDAT":
            packed.append(content[place + 8 : place + 8 + length])
        place += 12 + length
    return zlib.decompressobj().decompress(b"".join(packed), size[1] * (size[0] + 1) + 1)
