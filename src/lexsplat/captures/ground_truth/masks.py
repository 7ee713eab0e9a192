"""Ground-truth masks in ``segmentations/STEM/PROMPT.png``."""

from __future__ import annotations

from pathlib import Path

from lexsplat.captures.capture import Capture
from lexsplat.captures.splits import mask_folders, match_stem
from lexsplat.runtime.errors import CaptureError


def load_masks(capture: Capture) -> dict[str, dict[str, Path]]:
    """The mask files by view name and prompt, both sorted.

    "_" in a file name stands for a space: ``plastic_box.png`` is the mask of "plastic box". Sizes are checked from
    headers; read a mask with ``capture.views[name].load_mask(path)``, which also undistorts it.

    Raises:
        CaptureError: If a folder matches no view or several, or a mask does not have its photo's aspect.
    """
    if capture.segmentations is None:
        return {}
    found: dict[str, dict[str, Path]] = {}
    for folder in mask_folders(capture.segmentations):
        stem = folder.relative_to(capture.segmentations).as_posix()
        matches = match_stem(stem, capture.views)
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
            capture.views[matches[0]].check_mask(path)
            prompts[path.stem.replace("_", " ")] = path
    return {name: dict(sorted(found[name].items())) for name in sorted(found)}
