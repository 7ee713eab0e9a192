"""Hashes and stamps that detect whether an input has changed since a result was computed from it.

"The same file" has four meanings, by what is at stake:

- content (`file_hash`): results that are recorded, or cached for other folders and machines;
- content, as far as damage goes (`file_checksum`): files that are read as a whole whenever a scene is opened;
- name, size and modification time (`file_stamp`): intermediate files of one machine, where a pass over all photos
  would cost too much;
- name, size and both ends (`file_sample`): the photos of a finished "poses" stage, which users copy and sync without
  keeping times.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from lexsplat.runtime.files import to_json

_SAMPLE = 1 << 16


def digest(contents: Iterable[bytes], size: int = 12) -> str:
    """Hash of the concatenated contents, ``2 * size`` hex digits."""
    found = hashlib.blake2b(digest_size=size)
    for content in contents:
        found.update(content)
    return found.hexdigest()


def fingerprint(*parts: Any) -> str:
    """A short hash of JSON-like values and dataclasses; equal content has equal hashes in every process."""
    text = json.dumps([to_json(part) for part in parts], sort_keys=True, ensure_ascii=False)
    return digest([text.encode("utf-8")])


def file_stamp(path: Path) -> tuple[int, int]:
    """Size in bytes and modification time in nanoseconds of a file: cheap, and valid on one machine only."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def file_hash(path: Path, digest_size: int = 12) -> str:
    """Hash of a file's content, ``2 * digest_size`` hex digits."""
    return digest(blocks(path), digest_size)


def file_sample(path: Path) -> str:
    """Hash of the size of a file, its first and its last 64 KiB: cheap, and the same for copies.

    Photos and videos are compressed: another content of the same size differs there, too.
    """
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        parts = [str(size).encode()]
        for place in (0, max(size - _SAMPLE, 0)):
            file.seek(place)
            parts.append(file.read(_SAMPLE))
    return digest(parts)


def file_checksum(path: Path) -> int:
    """CRC-32 of a file's content: several times faster than a hash, and misses one damaged file in four billion."""
    found = 0
    for block in blocks(path):
        found = zlib.crc32(block, found)
    return found


def blocks(path: Path) -> Iterator[bytes]:
    """The content of a file, a MiB at a time."""
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            yield block
