"""A built scene on disk: plain files, each written completely or not at all.

::

    scene.json            format_version, config, provenance, fingerprint of each finished stage, checksums
    cameras.json          views, intrinsics, poses, split
    gaussians.ply         the standard 3DGS PLY
    language.safetensors  the language field with its codebook
    codes/NAME.png        8-bit code index maps of the training views, for methods that use them
    checkpoints/          what resuming needs: codebook, features

A stage is finished when ``scene.json`` lists it; the record is written after the stage's files. The
*fingerprint* of a stage is a hash of everything its result depends on, so a later build knows what it can keep.
"""

from __future__ import annotations

import contextlib
import io
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import FileFormatError, SceneFolderError
from lexsplat.runtime.files import atomic_path, locked, read_json, read_tensors, to_json, write_json
from lexsplat.runtime.fingerprints import file_checksum
from lexsplat.scenes.records import FORMAT_VERSION, read_record
from lexsplat.scenes.views import PhotoLens, StoredView, stored_view

SCENE_FILES = ("scene.json", "cameras.json", "gaussians.ply", "language.safetensors")
"""The files of a finished scene."""

BUNDLED_SCENE = Path(__file__).resolve().parents[1] / "demo" / "scene"
"""The bundled demo scene: the word ``demo`` stands for it wherever a scene folder is expected."""


class SceneFolder:
    """A scene folder, open for reading or being built.

    Args:
        root: The folder.
        content: Folder of record, cameras, Gaussians and language, if not ``root`` (`lexsplat.scenes.previous`).

    Raises:
        SceneFolderError: If there is a ``scene.json`` of another format version.
    """

    def __init__(self, root: Path, content: Path | None = None) -> None:
        self.root = Path(root)
        self.content = self.root if content is None else content
        self.record: dict[str, Any] = {"format_version": FORMAT_VERSION, "stages": {}}
        if self._record_path.exists():
            remedy = f"restore it from a copy, or delete {', '.join(SCENE_FILES)} and run the build again"
            self.record = read_record(read_json(self._record_path, remedy=remedy), self._record_path)

    @classmethod
    def open(cls, root: Path) -> SceneFolder:
        """Open a folder that a build has made; the word ``demo`` stands for the bundled scene.

        Raises:
            SceneFolderError: If it is not a scene folder.
        """
        if str(root) == "demo" and not (Path(root) / "scene.json").is_file():
            root = BUNDLED_SCENE
        if not (Path(root) / "scene.json").is_file():
            found = "no scene.json in it" if Path(root).is_dir() else "a file" if Path(root).exists() else ""
            from lexsplat.scenes.formats.reading import is_splats

            way = f"language --splats {quote(str(root))}" if is_splats(Path(root)) else "build CAPTURE"
            raise SceneFolderError(
                root,
                expected="a scene folder",
                found=found or "no such folder",
                remedy=f"make one with: lexsplat {way} --output SCENE",
            )
        return cls(root)

    @property
    def is_bundled(self) -> bool:
        """Whether this is the bundled scene, which is never written."""
        return self.root.resolve() == BUNDLED_SCENE

    def refuse_bundled(self) -> None:
        """Refuse to write into the bundled scene.

        Raises:
            SceneFolderError: If this is the bundled scene.
        """
        if self.is_bundled:
            raise SceneFolderError(
                "demo",
                expected="a scene folder of your own",
                found="the bundled scene",
                remedy="build a scene of the same photos with: lexsplat demo",
            )

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
        """``codes/NAME.png`` for the view ``name``: subfolders are kept, the suffix becomes .png."""
        return self.root / "codes" / Path(name).with_suffix(".png")

    def refuse_own_file(self, path: Path) -> None:
        """Refuse a path at which the scene keeps a file of its own.

        Raises:
            SceneFolderError: If ``path`` is a file of the scene, its measurements or its viewer.
        """
        own = {self.root / name for name in (*SCENE_FILES, "metrics.json", "metrics.csv", "viewer.json")}
        if path.resolve() in {file.resolve() for file in own}:
            raise SceneFolderError(
                path,
                expected="a path other than the scene's own files",
                found="one of them",
                remedy="give another name",
            )

    def refuse_foreign_files(self) -> None:
        """Refuse a folder in which a build would replace files of another program.

        Raises:
            SceneFolderError: If it has such files but no ``scene.json``, the first file of a build; or if it is the
                working directory, which an empty name means, and has any file but that.
        """
        if (self.root / "scene.json").exists():
            return
        if self.root.resolve() == Path.cwd() and any(path.name[0] != "." for path in self.root.iterdir()):
            raise SceneFolderError(
                "output",
                expected="a new folder or one of an earlier build",
                found=f"the working directory {self.root.resolve()}, which has other files",
                remedy="give --output a name",
            )
        there = [name for name in SCENE_FILES if (self.root / name).exists()]
        if there:
            raise SceneFolderError(
                self.root / there[0],
                expected="a new folder or one of an earlier build",
                found="a file of another program",
                remedy="give another --output",
            )

    def refuse_edited(self) -> None:
        """Refuse to build into a saved edit, whose photos are of the scene before its edits.

        Raises:
            SceneFolderError: If ``scene.json`` lists edits.
        """
        if edits := self.record.get("edits"):
            raise SceneFolderError(
                self.root,
                expected="a new folder or a scene without edits",
                found=f"a scene with {len(edits)} edit{'' if len(edits) == 1 else 's'}, which a build would undo",
                remedy="give another --output, and edit the scene that is built there",
            )

    # -- stages

    def is_finished(self, stage: str, fingerprint: str) -> bool:
        """Whether ``stage`` is finished with this fingerprint."""
        return self.record["stages"].get(stage, {}).get("fingerprint") == fingerprint

    def finish(self, stage: str, fingerprint: str, seconds: float, **facts: Any) -> None:
        """Record that the files of ``stage`` are complete."""
        self.record["stages"][stage] = {
            "fingerprint": fingerprint,
            "seconds": round(seconds, 3),
            **to_json(facts),
        }
        self.save()

    def reopen(self, stage: str) -> None:
        """Remove ``stage`` from the record: its files are about to change."""
        if self.record["stages"].pop(stage, None) is not None:
            self.save()

    def stage_seconds(self) -> dict[str, float]:
        """Duration of each finished stage in seconds."""
        return {name: stage.get("seconds", 0.0) for name, stage in self.record["stages"].items()}

    def save(self) -> None:
        """Write ``scene.json``."""
        write_json(self._record_path, self.record)

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """Lock the folder for one build; the lock ends with the process, however it ends.

        Raises:
            SceneFolderError: If another process holds the lock.
        """
        return locked(
            self.root,
            lambda holder: SceneFolderError(
                self.root,
                expected="a folder that no other process builds in",
                found=f"process {holder} at work",
                remedy="wait for it or give another --output",
            ),
        )

    def withdraw(self, made: Iterable[Path] = (), *, keep_root: bool = False) -> None:
        """Remove the record of a build that ended before its first stage; a folder with other files stays.

        Args:
            made: Folders above it that the build made, the nearest first; they go if they are empty.
            keep_root: Leave the empty folder, because it was there before.
        """
        files = [path for path in self.root.rglob("*") if not path.is_dir()]
        begun = {
            self.root / name for name in (".lock", "scene.json", "cameras.json", "poses/.poses/source.txt")
        }
        if self.record["stages"] or not set(files) <= begun:
            return
        for path in files:
            path.unlink(missing_ok=True)
        folders = sorted(path for path in self.root.rglob("*") if path.is_dir())
        for path in [*reversed(folders), *([] if keep_root else [self.root]), *made]:
            with contextlib.suppress(OSError):
                path.rmdir()

    # -- content

    def write_cameras(
        self, views: Mapping[str, tuple[Camera, str]], photos: Mapping[str, PhotoLens] | None = None
    ) -> None:
        """Write ``cameras.json`` from ``{name: (camera, "train" | "test")}``, and the lenses of photos by name."""
        lenses = photos or {}
        entries = [
            {
                "name": name,
                "split": split,
                "width": c.width,
                "height": c.height,
                "K": c.K,
                "viewmat": c.viewmat,
                **({"photo": to_json(lenses[name])} if name in lenses else {}),
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
        content = read_json(path, remedy="run the build again")
        try:
            views = [stored_view(entry, path) for entry in content["views"]]
            if len({view.name for view in views}) < len(views):
                raise ValueError("duplicate views")
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise FileFormatError(
                path,
                expected="views with name, split, size, K and viewmat",
                found=repr(error)[:200],
                remedy="build again",
            ) from error
        return {view.name: view for view in views}

    def write_gaussians(self, gaussians: Gaussians) -> None:
        """Write ``gaussians.ply``; the record receives its checksum, which `save` writes."""
        from lexsplat.scenes.formats.ply import write_ply

        with atomic_path(self.gaussians_path) as temporary:
            write_ply(gaussians, temporary)
            self.record["checksums"] = {self.gaussians_path.name: file_checksum(temporary)}

    def read_gaussians(self) -> Gaussians:
        """Read ``gaussians.ply``.

        Raises:
            FileFormatError: If it is missing or damaged, or another file than `write_gaussians` wrote.
        """
        from lexsplat.scenes.formats.ply import read_ply

        self._has_whole_gaussians()
        try:
            return read_ply(self.gaussians_path)
        except FileFormatError as error:  # whose advice is for a file of another program
            raise error.with_remedy("run the build again") from error

    def _has_whole_gaussians(self) -> bool:
        """Whether ``gaussians.ply`` is known to be as it was written.

        It is not known while it is being made, and in folders that were built without a checksum.

        Raises:
            FileFormatError: If it is known not to be.
        """
        path = self.gaussians_path
        known = self.record.get("checksums", {}).get(path.name)
        if known is None or "reconstruct" not in self.record["stages"]:
            return False
        try:
            found = file_checksum(path)
        except FileNotFoundError:  # a build may have moved it in the meantime; reading it tells
            return False
        if found != known:
            raise FileFormatError(
                path,
                expected="the Gaussians that were written",
                found="other content (the checksum differs)",
                remedy="run the build again; for Gaussians of another program: lexsplat language --splats FILE",
            )
        return True

    def check_file(self, path: Path) -> None:
        """Read a file of a finished stage as queries and later stages will; folders are not read.

        Raises:
            FileFormatError: If it is damaged.
        """
        if path == self.gaussians_path:
            _ = self._has_whole_gaussians() or self.read_gaussians()
        elif path.suffix == ".safetensors":
            read_tensors(path)
        elif path.suffix == ".png":
            self.read_code_map(path.relative_to(self.root / "codes").as_posix())

    def write_code_map(self, name: str, codes: np.ndarray) -> None:
        """Write one code index map, uint8 ``[h, w]``, as PNG."""
        from PIL import Image

        with atomic_path(self.code_map_path(name)) as temporary:
            Image.fromarray(np.ascontiguousarray(codes, dtype=np.uint8)).save(temporary, format="PNG")

    def read_code_map(self, name: str) -> np.ndarray:
        """Read one code index map, uint8 ``[h, w]``.

        Raises:
            FileFormatError: If it is missing, damaged or not an 8-bit gray PNG.
        """
        from PIL import Image

        path = self.code_map_path(name)
        try:
            content = path.read_bytes()
            with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
                if image.mode != "L":
                    raise FileFormatError(path, expected="an 8-bit gray PNG", found=f"mode {image.mode}")
                if len(_pixel_data(content, image.size)) != image.height * (image.width + 1):
                    raise FileFormatError(
                        path, expected=f"{image.width}x{image.height} codes", found="another number"
                    )
                return np.array(image)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, zlib.error) as error:
            raise FileFormatError(path, expected="a code index map", found=str(error)) from error

    def bytes_on_disk(self, path: Path) -> int:
        """Size in bytes of a file, or of all files in a folder; 0 if there is none."""
        files = path.rglob("*") if path.is_dir() else [path]
        return sum(file.stat().st_size for file in files if file.is_file())


def _pixel_data(content: bytes, size: tuple[int, int]) -> bytes:
    """The decompressed pixels of an 8-bit gray PNG with the filter byte of each row; at most one byte too many.

    Pillow fills the missing pixels of a truncated PNG with zeros, and zero is a code.
    """
    packed, place = [], 8
    while place + 8 <= len(content):
        length, kind = int.from_bytes(content[place : place + 4], "big"), content[place + 4 : place + 8]
        if kind == b"IDAT":
            packed.append(content[place + 8 : place + 8 + length])
        place += 12 + length
    return zlib.decompressobj().decompress(b"".join(packed), size[1] * (size[0] + 1) + 1)


def refuse_within_scene(path: Path) -> None:
    """Refuse to write a page or another scene into a scene folder, whose files are those of one scene.

    Raises:
        SceneFolderError: If a folder above is a scene.
    """
    if above := next((each for each in path.absolute().parents if (each / "scene.json").is_file()), None):
        raise SceneFolderError(
            path,
            expected="a place outside of scene folders",
            found=f"one in the scene {above}",
            remedy="give a folder beside it",
        )


def file_of(folder: SceneFolder | None, name: str) -> Path:
    """A file or folder that a command writes for a scene; the bundled one is never written to."""
    if folder is None or folder.is_bundled:
        return Path(f"demo_{name}")
    return folder.root / name
