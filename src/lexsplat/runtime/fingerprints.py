"""Hashes that detect whether the inputs of a result have changed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from lexsplat.runtime.files import to_json


def fingerprint(*parts: Any) -> str:
    """A short hash of JSON-like values and dataclasses; equal content has equal hashes in every process."""
    text = json.dumps([to_json(part) for part in parts], sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode("utf-8"), digest_size=12).hexdigest()


def file_hash(path: Path) -> str:
    """Hash of the content of a file."""
    digest = hashlib.blake2b(digest_size=12)
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
