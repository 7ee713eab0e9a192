"""The record of a scene in a library: where the scene is, which version of it, and which files hold the rest.

A record is kept twice: in a file of its own, and in the header of the file of its codes, from which a damaged one is
recovered. Both carry a hash of its values.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_json, read_tensors, write_json
from lexsplat.runtime.fingerprints import file_stamp, fingerprint
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder

BUNDLED = "demo"
"""The path of the bundled scene, wherever it is installed."""
OWN_FILE = re.compile(r"([\w-]+)\.[0-9a-f]{24}(\.objects)?\.safetensors")
"""Names of files of tensors: the scene, and the hash of the content."""
REMOVED = ".removed"
"""Ending of the record of a scene that is being removed."""
_HASH = "hash"
"""Entry with the hash of the others; records of earlier libraries lack it."""


@dataclasses.dataclass(frozen=True)
class Record:
    """A scene of a library.

    Args:
        name: Its name in the library.
        path: Its folder; "demo" is the bundled scene.
        beside: Its folder relative to the library, for scenes that were moved together with it.
        state: Hash of its finished stages: another one after a build.
        encoder: Hash of its text encoder; "" if the build did not record it.
        clip: Name or folder of that encoder.
        content: Hash of its codes.
        codes: Number of codes K.
        gaussians: Number of Gaussians.
        views: Number of views.
        contents: Hash of what is kept of its segments and objects; "" if it has no segments.
        checksum: CRC-32 of its codes, eight times faster than the hash; "" in libraries that were made without.
        stamp: Size and modification time of its ``scene.json`` when it was added: while they are the same, so is
            its state. "" for the bundled scene and in libraries that were made without.
    """

    name: str
    path: str
    beside: str
    state: str
    encoder: str
    clip: str
    content: str
    codes: int
    gaussians: int
    views: int
    contents: str = ""
    checksum: str = ""
    stamp: str = ""

    @property
    def group(self) -> str:
        """Scenes of one group have the same text embeddings."""
        return self.encoder or f"name-{fingerprint(self.clip)}"

    @property
    def codes_file(self) -> str:
        """Name of the file of its codes."""
        return f"{self.name}.{self.content}.safetensors"

    @property
    def contents_file(self) -> str:
        """Name of the file of its segments and objects; "" if there is none."""
        return f"{self.name}.{self.contents}.objects.safetensors" if self.contents else ""

    @property
    def files(self) -> set[str]:
        """Names of its files of tensors."""
        return {self.codes_file, self.contents_file} - {""}

    def folder(self, root: Path) -> Path:
        """Where the scene is now: at its place relative to the library, as both may have moved, else at its path.

        Args:
            root: The library, without symbolic links.
        """
        if self.path == BUNDLED:
            return BUNDLED_SCENE
        together = os.path.normpath(os.path.join(root, self.beside))
        return Path(together if os.path.isfile(os.path.join(together, "scene.json")) else self.path)

    def sealed(self) -> dict[str, Any]:
        """Plain data with a hash of all values."""
        values = dataclasses.asdict(self)
        return {**values, _HASH: fingerprint(values)}


def state_of(folder: SceneFolder) -> str:
    """A hash that changes with every build and edit of a scene; its scale and its name do not matter."""
    record = folder.record
    edits = [record["edits"], record.get("edits_fingerprint")] if "edits" in record else []
    return fingerprint(record["stages"], *edits)


def stamp_of(folder: Path) -> str:
    """Size and modification time of the ``scene.json`` of a scene; "" for the bundled one, which is installed.

    Raises:
        OSError: If there is none.
    """
    return "" if folder == BUNDLED_SCENE else "-".join(map(str, file_stamp(folder / "scene.json")))


def write_record(record: Record, path: Path) -> None:
    """Write or replace a record."""
    write_json(path, record.sealed())


def read_record(path: Path) -> Record:
    """The record in a file.

    Raises:
        FileFormatError: If it is damaged.
    """
    try:
        return _checked(read_json(path), path)
    except FileFormatError as error:
        raise damaged(path, error.expected, error.found) from error


def _checked(content: Any, path: Path) -> Record:
    """A record from plain data, of which no entry is missing, of a wrong type or altered."""
    try:
        if not isinstance(content, dict):
            raise ValueError("other values")
        if _HASH in content and content[_HASH] != hash_of(content):
            raise ValueError("damaged content (the hash differs)")
        values: dict[str, Any] = {
            field.name: (int if field.type == "int" else str)(content[field.name])
            for field in dataclasses.fields(Record)
            if field.name in content or field.default is dataclasses.MISSING
        }
        hashes = values["content"], values.get("contents") or "0", values.get("checksum") or "0"
        hexadecimal = all(re.fullmatch("[0-9a-f]+", each) for each in hashes)
        named = values["name"] == path.name.split(".")[0] and re.fullmatch(r"[\w-]*", values["encoder"])
        if not (named and hexadecimal and values["codes"] > 0):
            raise ValueError("other values")
        return Record(**values)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        found = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise damaged(path, "the record of a scene", found[:80]) from error


def copy_of_record(path: Path) -> Record | None:
    """The copy of a record in the file of the codes; None if it is damaged."""
    try:
        _, metadata = read_tensors(path)
        return _checked(json.loads(metadata["record"]), path)
    except (FileFormatError, KeyError, ValueError, RecursionError):
        return None


def recovered_record(stage: Path, name: str) -> Record | None:
    """The record of a scene from the copy in the file of its codes; None if that is damaged as well."""
    copies = (copy_of_record(stage / file) for file, scene in _own_files(stage) if scene == name)
    return next((copy for copy in copies if copy is not None), None)


def scenes_without_record(stage: Path) -> set[str]:
    """Names of scenes whose codes are there without a record, and which are not being removed."""
    listed = os.listdir(stage) if stage.is_dir() else []
    records = {file.removesuffix(".json") for file in listed if file.endswith(".json")}
    lost = _with_codes(stage) - records
    return lost - removals(stage).keys() if lost else lost


def abandoned(stage: Path) -> list[Path]:
    """First files of additions that were killed before the second: objects without codes and without a record."""
    files, coded = _own_files(stage), _with_codes(stage)
    return [
        stage / file for file, scene in files if scene not in coded and not (stage / f"{scene}.json").exists()
    ]


def _with_codes(stage: Path) -> set[str]:
    """Names of scenes with a file of codes."""
    return {scene for file, scene in _own_files(stage) if not file.endswith(".objects.safetensors")}


def removals(stage: Path) -> dict[str, Path]:
    """The marks of scenes that are being removed, by name; other files with this ending are none."""
    marks = [path for path in stage.glob(f"[!.]*{REMOVED}") if path.is_file()]
    there = {scene for _, scene in _own_files(stage)} if marks else set()
    return {path.stem: path for path in marks if path.stem in there or _is_record(path)}


def has_entries(root: Path) -> bool:
    """Whether a folder holds the entry of a scene, so that it is a library even without ``library.json``."""
    stage = root / "scenes"
    return any(recovered_record(stage, scene) for _, scene in _own_files(stage)) or any(
        _is_record(path) for path in stage.glob("[!.]*.json")
    )


def _is_record(path: Path) -> bool:
    try:
        read_record(path)
    except FileFormatError:
        return False
    return True


def _own_files(stage: Path) -> list[tuple[str, str]]:
    """The files of tensors of a library, and the names of their scenes."""
    listed = sorted(os.listdir(stage)) if stage.is_dir() else []
    return [(file, found[1]) for file in listed if (found := OWN_FILE.fullmatch(file))]


def hash_of(content: Mapping[str, Any]) -> str:
    """The hash of all other values, which is written with them."""
    return fingerprint({name: value for name, value in content.items() if name != _HASH})


def mapped_tensors(path: Path, expected: str) -> dict[str, Tensor]:
    """The tensors of a file of the library, mapped; they have to be compared with their hash.

    Raises:
        FileFormatError: If it is missing or cannot be read.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError as error:
        raise damaged(path, expected, "no such file") from error
    except (OSError, SafetensorError, ValueError, TypeError) as error:
        raise damaged(path, expected, str(error)[:80]) from error


def damaged(path: Path, expected: str, found: str) -> FileFormatError:
    """The error of a damaged file in the stage of a library, with what repairs it."""
    remedy = command("verify", path.parents[1], "--repair")
    return FileFormatError(path, expected=expected, found=found, remedy=remedy)


def command(action: str, library: Path, *words: object) -> str:
    """A command that a message proposes, with quotation marks where a shell needs them."""
    return shlex.join(["lexsplat", "library", action, str(library), *map(str, words)])
