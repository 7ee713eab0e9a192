"""Masks of ignored pixels: ``masks/NAME.png``, black where pixels of a photo are ignored by every stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.listing import hidden_note, images_below, some_of
from lexsplat.captures.images.reading import open_image, read_mask

_PACKED, _SMALL = 64, 1 << 20
"""A file with fewer pixels to a byte, beyond so many pixels, holds more than one color."""
IGNORE_FOLDER = "masks"
"""Folder of a capture with ``NAME.png`` (COLMAP's convention: ``0001.jpg.png``) or ``STEM.png``. Pixels of value 0
are ignored by feature extraction, matching and losses."""

INVERTED = "black is ignored and white is used: if the masks are the wrong way round, invert them"
"""The remedy for masks that leave nothing."""


def find_ignore_masks(folders: Sequence[Path], names: Iterable[str]) -> tuple[dict[str, Path], list[str]]:
    """The mask files of photos.

    Args:
        folders: Folders that may hold masks; the first existing one is used.
        names: Names of the photos.

    Returns:
        Mask files by photo name, for photos that have one, and warnings: of files that match no photo, of masks of
        photos that are no PNG, and of hidden files.
    """
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None:
        return {}, []
    there, hidden = (
        [path.relative_to(folder).as_posix() for path in paths] for paths in images_below(folder)
    )
    found, names = {}, list(names)
    for name in names:
        for file in (f"{name}.png", f"{stem_of(name)}.png"):
            if file in there:
                found[name] = folder / file
                break
    unused = sorted(set(there) - {path.relative_to(folder).as_posix() for path in found.values()})
    meant = {*names, *map(stem_of, names)}
    others = [
        name for name in unused if not name.endswith(".png") and not meant.isdisjoint({name, stem_of(name)})
    ]
    strays = [name for name in unused if name not in others]
    notes = [f"{folder}: {note}" for note in hidden_note(hidden)]
    if others:
        many = "1 mask is" if len(others) == 1 else f"{len(others)} masks are"
        notes.append(
            f"{folder}: {many} ignored: masks must be PNG, such as {stem_of(others[0])}.png; found {some_of(others)}"
        )
    if not strays:
        return found, notes
    many = "1 mask matches" if len(strays) == 1 else f"{len(strays)} masks match"
    told = f"{many} no photo and {'is' if len(strays) == 1 else 'are'} ignored: {some_of(strays)}"
    return found, [*notes, f"{folder}: {told}"]


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
