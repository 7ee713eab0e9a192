"""Steps of an edit that no scene holds yet: what ``lexsplat edit`` and the viewer have kept in a journal."""

from __future__ import annotations

import contextlib
import json
from shlex import quote

from lexsplat.scenes.folder import SceneFolder, file_of


def unsaved_steps(folder: SceneFolder) -> int:
    """Number of steps in the journal of a scene (`lexsplat.scenes.journal`), up to a damaged line.

    0 without a journal, and if it is no text.
    """
    count = 0
    with contextlib.suppress(OSError, ValueError, AttributeError, RecursionError):
        lines = file_of(folder, "edits.jsonl").read_text(encoding="utf-8").split("\n")
        for entry in map(json.loads, lines[1:-1]):  # after the header; a line that is cut off is no step
            count += -1 if entry.get("undo") else 1
    return max(count, 0)


def saving(path: str, count: int) -> str:
    """How to get a scene with the steps."""
    return f"lexsplat edit {quote(path)} save --output SCENE2 makes a scene with {'it' if count == 1 else 'them'}"
