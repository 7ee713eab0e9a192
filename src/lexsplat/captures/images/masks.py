"""Masks of ignored pixels: ``masks/NAME.png``, black where pixels of a photo are ignored by every stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.reading import IMAGE_SUFFIXES, open_image, read_mask

_PACKED, _SMALL = 64, 1 << 20
"""A file with fewer pixels to a byte, beyond so many pixels, holds more than one color."""
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
    many = "1 mask matches" if len(strays) == 1 else f"{len(strays)} masks match"
    return found, [
        f"{folder}: {many} no photo and {'is' if len(strays) == 1 else 'are'} ignored: {some_of(strays)}"
    ]


def some_of(names: Sequence[str]) -> str:
    """The first three names, in a line."""
    return ", ".join(names[:3]) + (" and more" if len(names) > 3 else "")


def transparency_note(folder: Path, names: Sequence[str]) -> str:
    """The note that transparent pixels of these photos of a folder are ignored."""
    many = "1 photo" if len(names) == 1 else f"{len(names):,} photos"
    return f"{folder}: transparent pixels of {many} are ignored, as masked ones are: {some_of(names)}"


def blank_masks(masks: Mapping[str, Path]) -> list[str]:
    """The photos whose mask is black throughout, so that they take no part: masks the wrong way round, for example.

    Args:
        masks: Mask files by photo name.
    """
    return [name for name, path in masks.items() if _is_black(path)]


def _is_black(path: Path) -> bool:
    """Whether an image is black throughout. Large files are not: one color takes a thousandth of its pixels."""
    with open_image(path) as image:
        if path.stat().st_size * _PACKED > image.width * image.height + _SMALL:
            return False
    return not read_mask(path, nonzero=True).any()
