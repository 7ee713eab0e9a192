"""Masks of ignored pixels: ``masks/NAME.png``, black where pixels of a photo are ignored by every stage."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.reading import IMAGE_SUFFIXES

IGNORE_FOLDER = "masks"
"""Folder of a capture with ``NAME.png`` (COLMAP's convention: ``0001.jpg.png``) or ``STEM.png``. Pixels of value 0
are ignored by feature extraction, matching and losses."""


def find_ignore_masks(folders: Sequence[Path], names: Iterable[str]) -> tuple[dict[str, Path], list[str]]:
    """The mask files of photos.

    Args:
        folders: Folders that may hold masks; the first existing one is used.
        names: Names of the photos.

    Returns:
        Mask files by photo name, for photos that have one, and a warning if some files match no photo.
    """
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None:
        return {}, []
    there = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()
    }
    found = {}
    for name in names:
        for file in (f"{name}.png", f"{stem_of(name)}.png"):
            if file in there:
                found[name] = folder / file
                break
    strays = sorted(there - {path.relative_to(folder).as_posix() for path in found.values()})
    if not strays:
        return found, []
    some = ", ".join(strays[:3]) + (" and more" if len(strays) > 3 else "")
    return found, [f"{folder}: {len(strays)} masks match no photo and are ignored: {some}"]
