"""Steps of an edit that no scene holds yet: what ``lexsplat edit`` and the viewer have kept in a journal."""

from __future__ import annotations

import contextlib
import json
from shlex import quote

from lexsplat.runtime.errors import SceneFolderError
from lexsplat.scenes.folder import SceneFolder, file_of

JOURNAL = "edits.jsonl"


def unsaved_steps(folder: SceneFolder) -> int:
    """Number of steps in the journal of a scene (`lexsplat.scenes.journal`) that can be saved.

    It is 0 without a journal, or if the journal is damaged or of an earlier reconstruction.
    """
    count, fits = _steps(folder)
    return count if fits else 0


def outdated_steps(folder: SceneFolder) -> int:
    """Number of steps in the journal of a scene that fit it no longer, as it was reconstructed again."""
    count, fits = _steps(folder)
    return 0 if fits else count


def refuse_to_lose_steps(folder: SceneFolder) -> None:
    """Refuse to change Gaussians that unsaved steps are for.

    Raises:
        SceneFolderError: If the journal has steps that can be saved.
    """
    if count := unsaved_steps(folder):
        place = quote(str(folder.root))
        raise SceneFolderError(
            file_of(folder, JOURNAL),
            expected="no unsaved steps of an edit, which do not fit other Gaussians",
            found=f"{count:,} step{'' if count == 1 else 's'}",
            remedy=f"give another --output, or run first: lexsplat edit {place} save --output SCENE2, and then"
            f" lexsplat edit {place} discard",
        )


def saving(path: str, count: int) -> str:
    """How to get a scene with the steps."""
    return f"lexsplat edit {quote(path)} save --output SCENE2 makes a scene with {'it' if count == 1 else 'them'}"


def discarding(path: str, count: int) -> str:
    """Why outdated steps are worthless, and how to remove them."""
    verb, them = ("fits", "it") if count == 1 else ("fit", "them")
    return f"no longer {verb} the scene, which was built again; lexsplat edit {quote(path)} discard removes {them}"


def _steps(folder: SceneFolder) -> tuple[int, bool]:
    """Number of steps in the journal of a scene, and whether they are for its Gaussians; 0 if it is damaged."""
    with contextlib.suppress(OSError, ValueError, AttributeError, RecursionError):
        lines = file_of(folder, JOURNAL).read_text(encoding="utf-8").split("\n")
        header, *entries = map(json.loads, lines[:-1])  # a line that is cut off is no step
        count = sum(-1 if entry.get("undo") else 1 for entry in entries)
        reconstruction = folder.record["stages"].get("reconstruct", {}).get("fingerprint")
        return max(count, 0), header.get("reconstruction") == reconstruction
    return 0, True
