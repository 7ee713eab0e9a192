"""Masks of two kinds: ``segmentations/STEM/PROMPT.png`` to measure against, the layout of the authors' data set, and
``masks/NAME.png``, black where pixels of a photo take no part in anything that is learned.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.reading import IMAGE_SUFFIXES

IGNORE_FOLDER = "masks"
"""Folder of a capture with ``NAME.png`` (COLMAP's way: ``0001.jpg.png``) or ``STEM.png``: a pixel that is 0 takes no
part in features, matches and losses."""


def find_ignore_masks(folders: Sequence[Path], names: Iterable[str]) -> tuple[dict[str, Path], list[str]]:
    """Which file masks which photo.

    Args:
        folders: Where masks may lie; the first that is there counts.
        names: Names of the photos.

    Returns:
        Files by name of photo, for those that have one; and a warning, if there are files that mask none.
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
    return found, [f"{folder}: {len(strays)} masks are called like no photo and are not used: {some}"]
