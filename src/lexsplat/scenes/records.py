"""The content of ``scene.json``: checks of what the rest relies on, and records written under earlier names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from lexsplat.features.hub import present_name
from lexsplat.runtime.errors import FileFormatError, SceneFolderError

FORMAT_VERSION = 1
"""Raised when a reader of the old layout would misread the new one."""

_RENAMED = {
    "embed": "language",  # a stage
    "placed": "registered",  # facts of the stage "poses"
    "left_out": "unregistered",
    "averaging": "averaged",  # settings
    "embedding": "trained",
    "lifting": "lifted",
    "neighbours": "neighbors",
    "normalise_rendering": "normalize_rendering",
    "metres_per_unit": "meters_per_unit",  # the world
}
"""Keys of scene folders that were written before the renames, and their present names."""


def read_record(content: Any, path: Path) -> dict[str, Any]:
    """A record under the present names, from the content of ``scene.json``.

    Raises:
        SceneFolderError: If it is of another format version.
        FileFormatError: If an entry is of a wrong type.
    """
    record = _checked(content, path)
    for part in ("stages", "config", "world"):
        if part in record:
            record[part] = _renamed(record[part])
    config = record.get("config", {})
    for encoder in ("clip", "dino"):
        if encoder in config:
            config[encoder] = present_name(config[encoder])
    return record


def _renamed(value: Any, depth: int = 3) -> Any:
    """The same content under the present names of its keys, down to a depth."""
    if isinstance(value, dict) and depth:
        return {_RENAMED.get(key, key): _renamed(entry, depth - 1) for key, entry in value.items()}
    return value


def _checked(record: Any, path: Path) -> dict[str, Any]:
    """The content of ``scene.json``, checked for the types that the rest relies on."""
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
        # The hash becomes part of a file name.
        "clip_hash": encoder is None or (isinstance(encoder, str) and re.fullmatch(r"[\w-]+", encoder)),
        "config": isinstance(config, dict) and isinstance(config.get("clip", ""), str),
        "downscale": scale is None or (isinstance(scale, (int, float)) and 0 < scale < 1e6),
        "provenance": isinstance(record.get("provenance", {}), dict),
        "warnings": isinstance(record.get("warnings", []), list),
        "checksums": isinstance(record.get("checksums", {}), dict),
        "capture": isinstance(record.get("capture"), (str, type(None))),
        "images": isinstance(record.get("images"), (str, type(None))),
    }
    wrong = [name for name, holds in sound.items() if not holds]
    if wrong:
        raise FileFormatError(
            path, expected=f"{wrong[0]} as written by a build", found="something else", remedy="build again"
        )
    return record
