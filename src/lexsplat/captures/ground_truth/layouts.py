"""Ground truth in the layouts of public data sets; nothing has to be copied or renamed by hand.

- **segmentations**: ``segmentations/STEM/PROMPT.png``, the layout of lexsplat and of the authors' Mip-NeRF 360 and
  LERF folders; "_" in the name of a mask stands for a space.
- **3d-ovs**: ``segmentations/NN/CLASS.png`` and ``segmentations/classes.txt``; NN is the index of the image.
- **lerf-ovs**: LangSplat's ``label/SCENE/frame_*.json`` beside the capture ``SCENE``: polygons and boxes.

To add a layout: list it here, recognize it in `layout_of` and `annotated_names`, and read it in
`_read_ground_truth`. Views with ground truth are held out by default.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lexsplat.captures.capture import Capture, View, stem_of
from lexsplat.captures.ground_truth.prompt_lists import PromptList, capture_prompt_names
from lexsplat.captures.images.listing import is_image_file
from lexsplat.captures.images.reading import MAX_PIXELS
from lexsplat.captures.images.undistortion import MAX_SIDE
from lexsplat.captures.readers.camera_files import checked_name
from lexsplat.captures.splits import mask_folders, match_stem
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import read_json

log = logging.getLogger("lexsplat")

CLASSES_FILE = "classes.txt"
"""3D-OVS: class names, one per line."""


@dataclass(frozen=True)
class Annotations:
    """Ground truth by view and prompt.

    Args:
        layout: Name of its layout, from the list above.
        origin: The folder it was read from.
        masks: ``{view: {prompt: mask}}``: a file for `View.load_mask`, or an array ``[H, W]`` bool on the
            undistorted image.
        boxes: ``{view: {prompt: boxes}}``, ``[B, 4]`` as x0, y0, x1, y1 in pixels of the mask, if the data set has
            boxes.
    """

    layout: str
    origin: Path
    masks: Mapping[str, Mapping[str, Path | NDArray[np.bool_]]]
    boxes: Mapping[str, Mapping[str, NDArray[np.float64]]] = field(default_factory=dict)

    def prompts(self) -> tuple[str, ...]:
        """All prompts with ground truth in any view, sorted."""
        return tuple(sorted({prompt for prompts in self.masks.values() for prompt in prompts}))

    def origin_facts(self, prompt_list: PromptList | None) -> dict[str, str | None]:
        """Folder, layout and prompt list, as results record them."""
        return {"folder": str(self.origin), "layout": self.layout, "prompt_list": prompt_list}

    def renamed(self, names: Mapping[str, str]) -> Annotations:
        """The same ground truth under other prompts; prompts that ``names`` does not list are dropped."""

        def change(table: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
            kept = {
                view: {names[p]: value for p, value in prompts.items() if p in names}
                for view, prompts in table.items()
            }
            return {view: prompts for view, prompts in kept.items() if prompts}

        return Annotations(self.layout, self.origin, change(self.masks), change(self.boxes))


def find_annotations(root: Path) -> Path | None:
    """The folder of the ground truth that belongs to a capture, or None.

    Masks in ``segmentations/`` of the capture take precedence over LERF-OVS labels in ``label/`` beside it.
    """
    segmentations = root / "segmentations"
    if segmentations.is_dir() and mask_folders(segmentations):
        return segmentations
    absolute = root.resolve()
    for folder in (absolute.parent / "label" / absolute.name, root / "label" / absolute.name, root / "label"):
        if folder.is_dir() and any(folder.glob("frame_*.json")):
            return folder
    return None


def layout_of(folder: Path) -> str:
    """The layout of a folder with ground truth: a name of the list above."""
    if any(folder.glob("frame_*.json")):
        return "lerf-ovs"
    return "3d-ovs" if (folder / CLASSES_FILE).is_file() else "segmentations"


def annotated_names(root: Path, names: Collection[str]) -> set[str]:
    """Which images of a capture have ground truth. `load_annotations` reports ground truth without an image."""
    folder = find_annotations(root)
    if folder is None:
        return set()
    layout = layout_of(folder)
    if layout == "lerf-ovs":
        stems = [path.stem for path in folder.glob("frame_*.json")]
    else:
        stems = [path.relative_to(folder).as_posix() for path in mask_folders(folder)]
    found = (_images_meant(stem, layout, names, root / "images") for stem in stems)
    return {matches[0] for matches in found if len(matches) == 1}


def check_ground_truth_options(root: Path, folder: Path | None, prompt_list: PromptList | None) -> None:
    """Check the options of `load_annotations` before a long build.

    Args:
        root: The folder of the capture.
        folder: Folder of the ground truth, if not in or beside the capture.
        prompt_list: List of prompts, if not the file names of the masks.

    Raises:
        CaptureError: If ``folder`` does not exist, or the capture has no prompt lists.
    """
    if folder is not None and not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        expected, remedy = "a folder with masks or labels", "check the path of --ground-truth"
        raise CaptureError(folder, expected=expected, found=found, remedy=remedy)
    if prompt_list is not None:
        capture_prompt_names(root, prompt_list)


def load_annotations(
    capture: Capture, folder: Path | None = None, prompt_list: PromptList | None = None
) -> Annotations:
    """The ground truth of a capture, in any of the layouts.

    Args:
        capture: The capture.
        folder: Folder of the ground truth, which must hold some; None searches in and beside the capture
            (`find_annotations`), where it may be absent.
        prompt_list: Use the prompts of the paper or of the released code, for captures named after its scenes. Masks
            may be named after either list; others are dropped. None uses the file names of the masks as prompts.

    Returns:
        Masks and boxes; empty where the capture has none.

    Raises:
        CaptureError: If a given folder does not exist or holds no ground truth, a file belongs to no view or several
            or does not fit its photo, two files mean one prompt in one view, a class is missing, the capture has no
            prompt lists, or no mask is named after one of their prompts.
        FileFormatError: If a label file is not in LangSplat's format.
    """
    check_ground_truth_options(capture.root, folder, prompt_list)
    ground_truth = _read_ground_truth(capture, folder)
    if folder is not None and not ground_truth.prompts():
        raise _no_ground_truth(folder, ground_truth.layout)
    return _with_prompts_of(ground_truth, capture.root, prompt_list) if prompt_list else ground_truth


def _no_ground_truth(folder: Path, layout: str) -> CaptureError:
    """The error for a given folder that holds no ground truth, with the most likely remedy."""
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and any(path.glob("frame_*.json"))]
    others = len(list(folder.glob("*.json")))
    found, remedy = "no masks and no labels", "give the folder that holds STEM/PROMPT.png or frame_*.json"
    if layout == "lerf-ovs":
        found, remedy = "labels without objects", "annotate objects, or give another folder"
    elif below:
        found, remedy = f"labels in {below[0].name}/", f"give {below[0]}"
    elif others:
        found, remedy = f"{others} JSON files", "name labels frame_*.json, as LangSplat does"
    return CaptureError(folder, expected="ground truth", found=found, remedy=remedy)


def _with_prompts_of(ground_truth: Annotations, root: Path, prompt_list: PromptList) -> Annotations:
    """The ground truth for the prompts of a list; logs the prompts that are not in it."""
    names = capture_prompt_names(root, prompt_list)
    others = [prompt for prompt in ground_truth.prompts() if prompt not in names]
    found = ground_truth.renamed(names)
    if others and not found.masks:
        raise CaptureError(
            ground_truth.origin,
            expected=f"masks named after prompts of the list {prompt_list!r}",
            found=", ".join(others[:3]),
            remedy="omit the prompt list to use the file names of the masks as prompts",
        )
    if others:
        some = ", ".join(others[:5]) + (" and more" if len(others) > 5 else "")
        log.warning(
            "%s: masks not in the prompt list %r are ignored: %s", ground_truth.origin, prompt_list, some
        )
    return found


def _read_ground_truth(capture: Capture, folder: Path | None) -> Annotations:
    folder = find_annotations(folder or capture.root) or folder
    if folder is None:
        return Annotations("segmentations", capture.root / "segmentations", {})
    layout = layout_of(folder)
    return _read_lerf_ovs(capture, folder) if layout == "lerf-ovs" else _read_masks(capture, folder, layout)


# Folders of masks


def _read_masks(capture: Capture, folder: Path, layout: str) -> Annotations:
    """``STEM/PROMPT.png``, or 3D-OVS's ``NN/CLASS.png`` with a mask for each class of the list."""
    classes = _read_classes(folder / CLASSES_FILE) if layout == "3d-ovs" else ()
    masks: dict[str, dict[str, Path]] = {}
    for view_folder in mask_folders(folder):
        stem = view_folder.relative_to(folder).as_posix()
        view = capture.views[_the_image(stem, layout, capture, view_folder)]
        files = _masks_by_prompt(view_folder)
        if layout == "3d-ovs":
            files = {name: view_folder / f"{name}.png" for name in classes}
        for path in files.values():
            if not path.is_file():
                raise CaptureError(
                    view_folder,
                    expected=f"a mask for each of the {len(classes)} classes of {CLASSES_FILE}",
                    found=f"no {path.name}",
                    remedy="draw it (black if the class is not visible), or remove the class from the list",
                )
            view.check_mask(path)
        masks.setdefault(view.name, {}).update(files)
    ordered = {name: dict(sorted(masks[name].items())) for name in sorted(masks)}
    return Annotations(layout, folder, ordered)


def _masks_by_prompt(view_folder: Path) -> dict[str, Path]:
    """The masks of a view by the prompts that their names mean.

    Raises:
        CaptureError: If two names mean one prompt.
    """
    files: dict[str, Path] = {}
    for path in sorted(filter(is_image_file, view_folder.glob("*.png"))):
        other = files.setdefault(path.stem.replace("_", " "), path)
        if other is not path:
            raise CaptureError(
                view_folder,
                expected="a mask for each prompt",
                found=f"{other.name} and {path.name}, which mean the same one",
                remedy="remove one of them",
            )
    return files


def _read_classes(path: Path) -> tuple[str, ...]:
    """The names in ``classes.txt``, each the name of a file in a view's folder."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, expected="class names, one per line", found=str(error)) from error
    classes = tuple(checked_name(line.strip(), path) for line in lines if line.strip())
    if any("/" in name for name in classes):
        raise FileFormatError(path, expected="class names", found="a path")
    return classes


def _images_meant(stem: str, layout: str, names: Collection[str], image_folder: Path) -> list[str]:
    """The images a folder or file of the ground truth can refer to; a number in 3D-OVS is an index of images."""
    matches = match_stem(stem, names)
    if layout != "3d-ovs" or not stem.isdigit() or not image_folder.is_dir():
        return matches
    images = sorted(p.name for p in image_folder.iterdir() if is_image_file(p))
    counted = [images[int(stem)]] if int(stem) < len(images) else []
    if not matches:
        return [name for name in counted if name in names]
    return matches if counted == matches else sorted({*matches, *counted})


def _the_image(stem: str, layout: str, capture: Capture, subject: Path) -> str:
    matches = _images_meant(stem, layout, capture.views, capture.root / "images")
    if len(matches) != 1:
        found = f"{len(matches)} views: {' and '.join(matches[:3])}" if matches else "no view of that name"
        raise CaptureError(
            subject,
            expected="ground truth of one view",
            found=found,
            remedy="name it like the image, with the image's subfolder if it has one, or remove it",
        )
    return matches[0]


# LERF-OVS


def _read_lerf_ovs(capture: Capture, folder: Path) -> Annotations:
    masks: dict[str, dict[str, NDArray[np.bool_]]] = {}
    boxes: dict[str, dict[str, NDArray[np.float64]]] = {}
    for path in sorted(folder.glob("frame_*.json")):
        image, size, objects = _read_labels(path)
        view = capture.views[_the_image(stem_of(image), "lerf-ovs", capture, path)]
        parts: dict[str, list[tuple[NDArray[np.bool_], NDArray[np.float64]]]] = {}
        for category, box, polygon in objects:
            corners = polygon if len(polygon) > 2 else polygon[:0]  # two corners enclose nothing
            mask = view.undistort_mask(polygon_mask(corners, *size), path)
            if view.lens.distorts:  # the label's box is around the object in the distorted photo
                box = _box_around(mask)
            parts.setdefault(category, []).append((mask, box))
        masks[view.name], boxes[view.name] = {}, {}
        for category, found in sorted(parts.items()):
            masks[view.name][category] = np.logical_or.reduce([mask for mask, _ in found])
            boxes[view.name][category] = np.stack([box for _, box in found])
    return Annotations("lerf-ovs", folder, masks, boxes)


_Object = tuple[str, NDArray[np.float64], NDArray[np.float64]]
"""One object of a label file: category, box ``[4]`` and polygon ``[n, 2]``, in pixels."""


def _read_labels(path: Path) -> tuple[str, tuple[int, int], list[_Object]]:
    """Name, width and height of the image of a label file, and the objects."""
    content = read_json(path, remedy="copy the file again or correct it")
    try:
        info = content["info"]
        name, size = str(info["name"]), (int(info["width"]), int(info["height"]))
        objects = [
            (
                str(entry["category"]),
                np.asarray(entry["bbox"], dtype=np.float64).reshape(4),
                np.asarray(entry["segmentation"], dtype=np.float64).reshape(-1, 2),
            )
            for entry in content["objects"]
        ]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            path,
            expected="info (name, width, height) and objects (category, bbox, segmentation)",
            found=repr(error)[:200],
            remedy="use LangSplat's label files",
        ) from error
    numbers = [part for _, *parts in objects for part in parts]
    if min(size) < 1 or max(size) > MAX_SIDE or size[0] * size[1] > MAX_PIXELS:
        raise FileFormatError(
            path, expected="a size and finite coordinates", found=f"size {size[0]}x{size[1]}"[:60]
        )
    # Corners may lie outside the image, but not so far that integers overflow or drawing takes minutes.
    if not all((np.abs(part) <= 10 * MAX_SIDE).all() for part in numbers):
        raise FileFormatError(path, expected="finite coordinates in or near the photo", found="others")
    return name, size, objects


def polygon_mask(points: Sequence[Sequence[float]] | NDArray, width: int, height: int) -> NDArray[np.bool_]:
    """A filled polygon ``[H, W]`` as LangSplat draws it: corners truncated to whole pixels, the outline included.

    Differs from OpenCV's ``fillPoly`` in 0.2 % of the pixels, all on the outline.

    Args:
        points: Corners ``[n, 2]`` as x, y in pixels.
        width: Width of the mask.
        height: Height of the mask.
    """
    from skimage.draw import polygon

    corners = np.asarray(points, dtype=np.float64).reshape(-1, 2).astype(np.int32)
    mask = np.zeros((height, width), dtype=bool)
    if len(corners) == 0:
        return mask
    mask[polygon(corners[:, 1], corners[:, 0], mask.shape)] = True
    image = Image.fromarray(mask)
    closed = [(int(x), int(y)) for x, y in [*corners, corners[0]]]
    ImageDraw.Draw(image).line(closed, fill=1)
    return np.asarray(image, dtype=bool)


def _box_around(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return np.full(4, -1.0)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max()], dtype=np.float64)


def load_ground_truth(view: View, mask: Path | NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask of `Annotations` as an array ``[H, W]`` on the undistorted image."""
    return mask.astype(bool) if isinstance(mask, np.ndarray) else view.load_mask(mask)
