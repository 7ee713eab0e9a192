"""Reader of the history of the viewer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from support.hostile import mutations as mutate
from support.hostile.registry import Reader, reader


@reader
def viewer_memory() -> Reader:
    from lexsplat.viewer.history import Memory

    def make(folder: Path) -> None:
        (folder / "viewer.json").write_text(
            json.dumps({"history": ["red apple", "床"], "vocabulary": ["mug"]})
        )

    def check(memory: Any) -> None:
        phrases = [*memory.history, *memory.vocabulary]
        assert all(isinstance(phrase, str) and phrase.strip() for phrase in phrases)
        json.dumps(phrases, ensure_ascii=False).encode("utf-8")

    return Reader(make, lambda folder: Memory.load(folder), check,
                  {"viewer.json": lambda c, r: mutate.json_file(c, r, 40, 200)})  # fmt: skip
