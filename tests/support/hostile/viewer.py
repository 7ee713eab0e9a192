"""Reader of the history of the viewer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from support.hostile import mutations as mutate
from support.hostile.registry import Reader, reader


@reader
def viewer_memory() -> Reader:
    from lexsplat.viewer.history import History

    def make(folder: Path) -> None:
        (folder / "viewer.json").write_text(
            json.dumps({"history": ["red apple", "床"], "vocabulary": ["mug"]})
        )

    def check(history: Any) -> None:
        phrases = [*history.prompts, *history.vocabulary]
        assert all(isinstance(phrase, str) and phrase.strip() for phrase in phrases)
        json.dumps(phrases, ensure_ascii=False).encode("utf-8")

    return Reader(make, lambda folder: History.load(folder), check,
                  {"viewer.json": lambda c, r: mutate.json_file(c, r, 40, 200)})  # fmt: skip
