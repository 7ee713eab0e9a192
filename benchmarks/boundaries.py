"""Whether segments end where things end: boundary recall against masks.

    python benchmarks/boundaries.py output/bonsai --pictures FOLDER
    python benchmarks/boundaries.py output/bonsai --sheet docs/images/segments.png --sheet-levels 1 4

Renders the segments of each level into the held-out views that have masks: a pixel shows the segment with the largest
weight in it. Recall is the share of the masks' outline that has a border between segments within ``--tolerance``
pixels. Chance is the share of all pixels that have one: what an outline elsewhere would reach. The edge of the
picture is no outline.
"""

from __future__ import annotations

from colorsys import hsv_to_rgb
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from records import argument_parser, write_record
from scipy.ndimage import binary_erosion, distance_transform_edt

import lexsplat
from lexsplat.captures import load_annotations
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.queries.scoring import render_gaussian_scores
from lexsplat.scenes.scene import Scene

Mask = NDArray[np.bool_]
_AT_ONCE = 64
_BORDER, _OUTLINE = (255, 220, 0), (255, 0, 200)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("scene", type=Path, help="a built scene whose capture has masks")
    parser.add_argument("--capture", type=Path, help="the capture, if it is not where the build found it")
    parser.add_argument("--tolerance", type=float, default=2.0, help="pixels at the size of the scene")
    parser.add_argument(
        "--pictures", type=Path, help="write VIEW-LEVEL.png: borders yellow, outlines of masks pink"
    )
    parser.add_argument(
        "--sheet", type=Path, help="write one picture: segments in flat colors, outlines of masks black"
    )
    parser.add_argument("--sheet-levels", type=int, nargs="+", default=[1, 4], help="its columns")
    options = parser.parse_args()
    scene = lexsplat.open_scene(str(options.scene))
    if scene.field.segments is None or scene.folder is None:
        raise SystemExit(f"{options.scene}: no segments")
    outlines = outlines_of(scene, options.capture)
    rows = []
    for level in range(len(scene.field.segments.levels)):
        found = []
        for view, outline in outlines.items():
            borders = borders_of(shown_segments(scene, view, level))
            found.append(recall_and_chance(borders, outline, options.tolerance))
            if options.pictures:
                options.pictures.mkdir(parents=True, exist_ok=True)
                name = f"{Path(view).stem}-{level}.png"
                Image.fromarray(drawn(scene, view, borders, outline)).save(options.pictures / name)
        segments = int(scene.field.segments.levels[level].unique().numel())
        recall, chance = np.mean(found, 0)
        rows.append({"level": level, "segments": segments, "recall": float(recall), "chance": float(chance)})
        print(f"level {level}: {segments:6,} segments, recall {recall:.3f}, chance {chance:.3f}")
    if options.sheet:
        columns = [
            np.concatenate(
                [in_flat_colors(shown_segments(scene, view, level), outlines[view]) for view in outlines]
            )
            for level in options.sheet_levels
        ]
        Image.fromarray(np.concatenate(columns, 1)).save(options.sheet, optimize=True)
    write_record(options.json, rows, scene=str(options.scene), tolerance=options.tolerance)


def outlines_of(scene: Scene, source: Path | None = None) -> dict[str, Mask]:
    """The outline of all masks of each held-out view, at the size of the scene."""
    capture = reload_capture(scene.folder, source)
    masks, found = load_annotations(capture).masks, {}
    for view in capture.test_names:
        camera, outline = scene.camera(view), None
        for mask in masks.get(view, {}).values():
            if isinstance(mask, np.ndarray):
                part = np.asarray(Image.fromarray(mask).resize((camera.width, camera.height), 0))
            else:
                part = capture.views[view].load_mask(mask, (camera.width, camera.height))
            part = part & ~binary_erosion(part, border_value=1)
            outline = part if outline is None else outline | part
        if outline is not None and outline.any():
            found[view] = outline
    return found


@torch.no_grad()
def shown_segments(scene: Scene, view: str, level: int) -> NDArray[np.int64]:
    """The segment of a level with the largest weight in each pixel ``[H, W]``; -1 where there is none."""
    camera, segments = scene.camera(view), scene.field.segments
    labels = segments.levels[level][segments.labels]
    best = torch.zeros(camera.height, camera.width)
    shown = torch.full((camera.height, camera.width), -1)
    for numbers in labels.unique().split(_AT_ONCE):
        weights = (labels[None] == numbers[:, None]).float()
        values, places = render_gaussian_scores(scene.gaussians, camera, weights).max(0)
        better = values > best
        best[better], shown[better] = values[better], numbers[places[better]]
    return shown.numpy()


def borders_of(shown: NDArray[np.int64]) -> Mask:
    """Pixels whose right or lower neighbor shows another segment."""
    borders = np.zeros(shown.shape, bool)
    borders[:, :-1] |= shown[:, 1:] != shown[:, :-1]
    borders[:-1] |= shown[1:] != shown[:-1]
    return borders


def recall_and_chance(borders: Mask, outline: Mask, tolerance: float) -> tuple[float, float]:
    """Shares of the outline and of all pixels that have a border within the tolerance."""
    if not borders.any():
        return 0.0, 0.0
    near = distance_transform_edt(~borders) <= tolerance
    return float(near[outline].mean()), float(near.mean())


def drawn(scene: Scene, view: str, borders: Mask, outline: Mask) -> NDArray[np.uint8]:
    """The rendering of a view with both kinds of lines."""
    pixels = (scene.render(view).image.clamp(0, 1).numpy() * 255).round().astype(np.uint8)
    pixels[borders], pixels[outline] = _BORDER, _OUTLINE
    return pixels


def in_flat_colors(shown: NDArray[np.int64], outline: Mask) -> NDArray[np.uint8]:
    """Segments in colors of their own, far apart for neighboring numbers, and outlines in black."""
    hues = np.arange(shown.max() + 1) * 0.618 % 1
    colors = [hsv_to_rgb(hue, 0.3 + 0.3 * (hue * 7 % 1), 0.95 - 0.3 * (hue * 13 % 1)) for hue in hues]
    pixels = (np.array([*colors, (0, 0, 0)]) * 255).round().astype(np.uint8)[shown]
    pixels[outline] = 0
    return pixels


if __name__ == "__main__":
    main()
