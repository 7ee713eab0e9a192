"""Lists image files. Hidden ones are left out: macOS writes a ``._photo.jpg`` beside photos on foreign disks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lexsplat.captures.images.reading import IMAGE_SUFFIXES


def is_image_file(path: Path) -> bool:
    """Whether a name is that of an image, and not hidden."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def images_below(folder: Path) -> tuple[list[Path], list[Path]]:
    """The image files in a folder and its subfolders, sorted, and those that are hidden or in hidden folders."""
    images: tuple[list[Path], list[Path]] = [], []
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
            hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
            images[hidden].append(path)
    return images


def some_of(names: Sequence[str]) -> str:
    """The first three names, in a line."""
    return ", ".join(names[:3]) + (" and more" if len(names) > 3 else "")


def hidden_note(hidden: Sequence[str]) -> list[str]:
    """A note that counts hidden image files, if there are any."""
    if not hidden:
        return []
    many = "1 hidden file is" if len(hidden) == 1 else f"{len(hidden):,} hidden files are"
    return [f"{many} left out: {some_of(hidden)}"]
