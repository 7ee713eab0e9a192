"""Masks of two kinds: ``segmentations/STEM/PROMPT.png`` to measure against, the layout of the authors' data set, and
``masks/NAME.png``, black where pixels of a photo take no part in anything that is learned.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.errors import CaptureError
from lexsplat.scenes.images import IMAGE_SUFFIXES, read_mask
from lexsplat.scenes.scene import Scene, stem_of
from lexsplat.scenes.splits import mask_folders, match_stem

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


def load_masks(scene: Scene) -> dict[str, dict[str, Path]]:
    """Where the masks of each view are: view name to prompt to file, both sorted.

    "_" in a file name means a space: ``plastic_box.png`` answers "plastic box". Sizes are checked from
    headers; read a mask with ``scene.views[name].load_mask(path)``, which also undistorts it.

    Raises:
        CaptureError: If a folder matches no view or several, or a mask does not have its photo's aspect.
    """
    if scene.segmentations is None:
        return {}
    found: dict[str, dict[str, Path]] = {}
    for folder in mask_folders(scene.segmentations):
        stem = folder.relative_to(scene.segmentations).as_posix()
        matches = match_stem(stem, scene.views)
        if len(matches) != 1:
            what = (
                "no view of that name" if not matches else f"{len(matches)} views of that name: {matches[:3]}"
            )
            raise CaptureError(
                folder,
                expected="a folder named like one image, without suffix",
                found=what,
                remedy="rename the folder, with the image's subfolder if it has one, or remove it",
            )
        prompts = found.setdefault(matches[0], {})
        for path in sorted(folder.glob("*.png")):
            scene.views[matches[0]].check_mask(path)
            prompts[path.stem.replace("_", " ")] = path
    return {name: dict(sorted(found[name].items())) for name in sorted(found)}


def load_mask(path: Path) -> NDArray[np.bool_]:
    """A mask as ``[H, W]`` bool as it lies on disk: true where the picture is brighter than half.

    Raises:
        CaptureError: If the file is missing or damaged.
    """
    return read_mask(path)
