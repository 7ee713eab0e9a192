"""What is remarkable about a folder of photos: files that are left out, copies, and photos that look like others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.listing import some_of
from lexsplat.captures.readers.video import videos_in
from lexsplat.runtime.fingerprints import file_hash, file_sample

_NOT_READ = (
    ".gif", ".avif", ".jxl", ".jp2", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".raw", ".psd",
    ".svg", ".exr", ".hdr",
)  # fmt: skip
"""Endings of image files that are not read; cameras write some of them beside their JPEGs."""
_SAMPLE, _SPREAD = (64, 64), 3
"""Pixels of a photo that are compared, and by how many of 255 the channels of a gray one differ, from rounding."""


def copies_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The photos that are byte for byte the same as another one.

    Only files of one size are read: their ends first, and whole if these agree.

    Args:
        folder: Folder of the photos.
        names: Their names.

    Returns:
        The photo with the shortest name for each of its copies, by the name of the copy.
    """
    groups = [list(names)]
    for key in (_size, file_sample, file_hash):
        parts: dict[tuple[int, object], list[str]] = {}
        for number, group in enumerate(groups):
            for name in group:
                parts.setdefault((number, key(folder / name)), []).append(name)
        groups = [part for part in parts.values() if len(part) > 1]
    ordered = [sorted(group, key=lambda name: (len(name), name)) for group in groups]
    return {copy: group[0] for group in ordered for copy in group[1:]}


def _size(path: Path) -> int:
    return path.stat().st_size


def copies_note(copies: dict[str, str]) -> list[str]:
    """A note on copies of photos, if there are any."""
    if not copies:
        return []
    copy, photo = min(copies.items())
    many = "1 photo is an exact copy" if len(copies) == 1 else f"{len(copies):,} photos are exact copies"
    return [f"{many} of another one and left out, such as {copy}, a copy of {photo}"]


def left_out(folder: Path) -> list[str]:
    """A note on image files of formats that are not read, and one on videos, if there are any."""
    files = (path for path in folder.iterdir() if not path.name.startswith(".") and path.is_file())
    other = sorted(path.name for path in files if path.suffix.lower() in _NOT_READ)
    notes = []
    if other:
        told = "is left out: its format is" if len(other) == 1 else "are left out: their formats are"
        notes.append(f"{some_of(other)} {told} not read; save as JPEG or PNG")
    if videos := videos_in(folder):
        told = "is" if len(videos) == 1 else "are"
        notes.append(f"{some_of(videos)} {told} left out: a video is given by itself, without photos")
    return notes


def twins(names: Sequence[str]) -> list[str]:
    """A note on photos that differ in their endings only, as phones export a photo in two formats."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(stem_of(name), []).append(name)
    found = [group for group in groups.values() if len(group) > 1]
    if not found:
        return []
    count = "1 pair" if len(found) == 1 else f"{len(found):,} pairs"
    told = f"{count} of photos with one name and two endings, such as {' and '.join(found[0][:2])}"
    return [f"{told}: the same shot twice? Keep one of them"]


def looks_gray(image: Image.Image) -> bool:
    """Whether a decoded image is without color, at a sample of its pixels."""
    if "".join(image.getbands()) in ("L", "LA", "1", "I", "F"):
        return True
    pixels = np.asarray(image.resize(_SAMPLE, Image.Resampling.NEAREST).convert("RGB"))
    return bool(np.ptp(pixels.astype(np.int16), axis=-1).max() <= _SPREAD)


def gray_note(gray: Sequence[str], photos: int) -> list[str]:
    """A note on gray photos, where fewer than half of the photos are gray."""
    if not gray or 2 * len(gray) >= photos:
        return []
    many = "1 photo is" if len(gray) == 1 else f"{len(gray):,} photos are"
    return [f"{many} gray among color ones: {some_of(gray)}; the scene takes its colors from all photos"]
