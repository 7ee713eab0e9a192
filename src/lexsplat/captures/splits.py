"""The split into training views and held-out views."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.listing import is_image_file
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import read_json

SPLIT_FILE = "test_views.json"
"""File in the capture folder: a JSON list of the stems of the views to hold out."""


def match_stem(stem: str, names: Iterable[str]) -> list[str]:
    """The image names a stem can refer to: those with this full stem, else those with this last path component.

    A folder or suffix that is given must be that of the image. More than one result means that the stem is ambiguous.
    """
    names = list(names)
    exact = [name for name in names if stem in (name, stem_of(name))]
    if exact:
        return [stem] if stem in exact else exact
    last = [(name, name.rpartition("/")[2]) for name in names]
    exact = [name for name, file in last if file == stem]
    return exact or [name for name, file in last if stem_of(file) == stem]


def choose_test_names(
    names: Sequence[str],
    *,
    root: Path,
    test_names: Sequence[str] | None,
    listed: Sequence[str] | None,
    annotated: Collection[str],
    test_every: int,
) -> tuple[tuple[str, ...], list[str]]:
    """The names of the views to hold out, sorted, and warnings.

    The first of these that exists applies: ``test_names`` (given by the caller), ``test_views.json`` in the
    capture, the split of the camera files (``listed``), views with ground truth (``annotated``), every
    ``test_every``-th view counting from the first.

    Raises:
        CaptureError: If a held-out name matches no view, or no view is left for training.
        ValueError: If ``test_every`` is negative or 1.
    """
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 (hold out nothing) or at least 2, got {test_every}")
    file = root / SPLIT_FILE
    warnings: list[str] = []
    if test_names is not None:
        chosen = _resolve(test_names, names, root)
    elif file.is_file():
        chosen = _resolve(_read_split(file), names, file)
    elif listed is not None:
        # The camera files may list images without a file, which were reported already.
        chosen = set(listed) & set(names)
    else:
        chosen = set(annotated)
        if chosen and len(chosen) == len(names):
            held_out = f"every {test_every}th" if test_every and len(names) > 1 else "none"
            warnings.append(f"{root}: every view has ground truth; {held_out} is held out")
            chosen = set()
        if not chosen and test_every and len(names) > 1:
            chosen = set(names[::test_every])
    if len(chosen) >= len(names):
        raise CaptureError(
            file if file.is_file() else root,
            expected="at least one training view",
            found=f"all {len(names)} views held out",
            remedy="hold out fewer views",
        )
    return tuple(sorted(chosen)), warnings


def mask_folders(segmentations: Path) -> list[Path]:
    """The folders below ``segmentations`` that hold masks, sorted."""
    masks = filter(is_image_file, segmentations.rglob("*.png"))
    return sorted({path.parent for path in masks if path.parent != segmentations})


def _resolve(stems: Sequence[str], names: Collection[str], origin: Path) -> set[str]:
    chosen = set()
    for stem in stems:
        matches = match_stem(stem, names)
        if len(matches) != 1:
            raise CaptureError(
                origin,
                expected="names of views to hold out",
                found=f"{stem!r}, which matches {'no view' if not matches else ' and '.join(matches[:3])}",
                remedy="name views as in the image folder, with their subfolder",
            )
        chosen.add(matches[0])
    return chosen


def _read_split(file: Path) -> list[str]:
    content = read_json(file, remedy="copy the file again or correct it")
    if not isinstance(content, list) or not all(isinstance(stem, str) for stem in content):
        raise FileFormatError(
            file,
            expected="a JSON list of image stems",
            found=repr(content)[:60],
            remedy='write it like ["0001", "0009"]',
        )
    return content
