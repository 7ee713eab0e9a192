"""Make a bundled capture from a work folder of renderings: images, sparse model, masks and prompts.

images/NAME.jpg
sparse/0/*.bin                    COLMAP model, all views posed
test_views.json                   names of the held-out views
segmentations/NAME/PROMPT.png     0 or 255, held-out views only; "_" in the file name stands for a space
prompts.json                      {prompt: kind of prompt}
truth/NAME.npz                    with ``truth``: object index and depth of every view (does not ship)
truth/things.json                 with ``truth``: what the indices mean
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from layouts import Layout, Prompt
from numpy.typing import NDArray
from PIL import Image
from sparse_model import depth_errors, pinhole, slim_model, triangulate

JPEG_QUALITY = 90
MIN_PIXELS = 150
MIN_PART_PIXELS = 40
"""A view has a mask for a thing, or a part of one, that shows at least so many pixels."""


def mask_of(prompt: Prompt, index: NDArray[np.uint8], things: dict[str, dict]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the visible objects or parts of a prompt."""
    mask = np.zeros(index.shape, bool)
    for selector in prompt.selects:
        kind, _, part = selector.partition(".")
        numbers = [int(number) for number, thing in things.items() if thing["kind"] == kind]
        if not numbers:
            raise ValueError(f"a prompt selects {selector!r}, which is not in the scene")
        for number in numbers:
            if part:
                mask |= index == 10 * number + things[str(number)]["parts"][part]
            else:
                mask |= index // 10 == number
    return mask


def write_masks(layout: Layout, work: Path, output: Path) -> int:
    """Write the masks of the held-out views; returns their number."""
    things = json.loads((work / "things.json").read_text())
    written = 0
    for name in layout.test_names():
        index = np.load(work / "truth" / f"{name}.npz")["index"]
        folder = output / "segmentations" / name
        folder.mkdir(parents=True)
        for text, prompt in layout.prompts.items():
            mask = mask_of(prompt, index, things)
            if mask.sum() >= (MIN_PART_PIXELS if prompt.kind == "part" else MIN_PIXELS):
                picture = Image.fromarray(mask.astype(np.uint8) * 255)
                picture.save(folder / f"{text.replace(' ', '_')}.png", optimize=True)
                written += 1
    return written


def write_sparse_model(layout: Layout, work: Path, output: Path, say: Callable[[str], None]) -> None:
    """Write ``sparse/0`` after a check of its points against the rendered depths."""
    cameras = json.loads((work / "cameras.json").read_text())
    camera = pinhole(cameras["width"], cameras["height"], cameras["K"])
    poses = {f"{name}.jpg": np.array(pose) for name, pose in cameras["camera_to_world"].items()}
    held_out = {f"{name}.jpg" for name in layout.test_names()}
    train = [name for name in poses if name not in held_out]
    pycolmap.logging.minloglevel = 2
    found = triangulate(output / "images", train, camera, poses, layout.seed)
    model = slim_model(found, camera, poses)
    depths = {name: np.load(work / "truth" / f"{Path(name).stem}.npz")["depth"] for name in train}
    errors = depth_errors(model, depths)
    say(
        f"{model.num_points3D()} points, mean track {model.compute_mean_track_length():.1f} views, "
        f"reprojection error {model.compute_mean_reprojection_error():.2f} px; off the surface by "
        f"{100 * np.median(errors):.2f} % of depth (median), {100 * (errors > 0.02).mean():.1f} % by > 2 %"
    )
    folder = output / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write_binary(folder)


def pack(layout: Layout, work: Path, output: Path, *, truth: bool, say: Callable[[str], None]) -> None:
    """Write the capture folder ``output`` from the renderings in ``work``; an existing one is replaced."""
    shutil.rmtree(output, ignore_errors=True)
    (output / "images").mkdir(parents=True)
    for name in layout.names():
        picture = Image.open(work / "images" / f"{name}.png").convert("RGB")
        picture.save(output / "images" / f"{name}.jpg", quality=JPEG_QUALITY, progressive=True)
    (output / "test_views.json").write_text(json.dumps(layout.test_names(), indent=1) + "\n")
    kinds = {text: prompt.kind for text, prompt in layout.prompts.items()}
    (output / "prompts.json").write_text(json.dumps(kinds, indent=1) + "\n")
    masks = write_masks(layout, work, output)
    write_sparse_model(layout, work, output, say)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    say(f"{output.name}: {layout.views} images, {masks} masks, {size / 1e6:.2f} MB")
    if truth:
        shutil.copytree(work / "truth", output / "truth")
        shutil.copy(work / "things.json", output / "truth" / "things.json")
