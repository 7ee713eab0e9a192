"""Deleted things against renderings of the scene without them.

The renderings are made by tools/demo_scene (Blender):

    python tools/demo_scene/make.py --scenes second --without mug --work RENDERS
    python benchmarks/deleting.py --scene output/second --capture src/lexsplat/demo/captures/second \\
        --renders RENDERS/second --things "mug=red mug" --pictures FOLDER

A thing is KIND=PROMPT: RENDERS-without-KIND has the renderings, PROMPT selects the thing and names its exact masks in
the capture. Everything is measured in the pixels of the held-out views that show the thing. Prints JSON.

    unedited    PSNR of the scene as built in the rest of the picture: what the reconstruction allows
    without fill, with fill    PSNR in the place of the thing
    true colors    the same if the fill had the colors of the renderings: what is left is not the completion
    its color left    share of the pixels in the thing's typical hue where the rendering is not (`of_its_color`)
"""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from records import argument_parser, write_record
from scipy.ndimage import map_coordinates
from skimage.color import rgb2lab

import lexsplat
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import SH_C0
from lexsplat.queries.selection import Selection
from lexsplat.rendering import render
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.scene import Scene

Array = NDArray[np.float64]
_HUE = 20.0
"""Distance in the a, b plane of CIELAB below which a color is the thing's; at most half of its chroma."""
_MARGIN = 20


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scene", type=Path, required=True, help='a built scene, or "demo"')
    parser.add_argument("--capture", type=Path, required=True, help="the capture, with exact masks")
    parser.add_argument("--renders", required=True, help="renderings: RENDERS-without-KIND/images/VIEW.png")
    parser.add_argument("--things", nargs="+", required=True, metavar="KIND=PROMPT")
    parser.add_argument(
        "--pictures", type=Path, help="write KIND.png: each view before, true, no fill, fill, true colors"
    )
    options = parser.parse_args()
    scene = lexsplat.open_scene(str(options.scene))
    rows = []
    for kind, prompt in (item.split("=", 1) for item in options.things):
        views = views_of(Path(f"{options.renders}-without-{kind}"), options.capture, prompt)
        row, pictures = measured(scene, scene.find(prompt), views)
        rows.append({"thing": kind, **row})
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pictures).save(options.pictures / f"{kind}.png")
    print(json.dumps(rows, indent=1))
    write_record(options.json, rows, scene=str(options.scene))


def views_of(renders: Path, capture: Path, prompt: str) -> dict[str, tuple[Array, NDArray[np.bool_]]]:
    """The rendering without the thing and the mask of the thing, by view."""
    found = {}
    for path in sorted((renders / "images").glob("*.png")):
        mask = capture / "segmentations" / path.stem / f"{prompt.replace(' ', '_')}.png"
        if mask.exists():  # the thing is in the view
            found[path.stem] = _read(path), np.asarray(Image.open(mask)) > 127
    if not found:
        raise SystemExit(f"{renders}: no rendering of a view that shows {prompt!r}")
    return found


def measured(
    scene: Scene, chosen: Selection, views: dict[str, tuple[Array, NDArray[np.bool_]]]
) -> tuple[dict, NDArray[np.uint8]]:
    """The numbers of one thing, and a picture with a row for each view."""
    bare, filled = Editor(scene), Editor(scene)
    bare.delete(chosen, fill=False)
    before = resource.getrusage(resource.RUSAGE_SELF)
    filled.delete(chosen)
    after = resource.getrusage(resource.RUSAGE_SELF)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    fill = filled.steps[-1].values.get("fill", {"gaussians": 0})
    originals = {name: original for name, (original, _) in views.items()}
    truly = with_true_colors(filled.scene, fill["gaussians"], originals)
    scenes = {"without fill": bare.scene, "with fill": filled.scene, "true colors": truly}
    errors: dict[str, list[Array]] = {name: [] for name in ("unedited", *scenes)}
    left: dict[str, list[Array]] = {name: [] for name in ("without fill", "with fill")}
    rows = []
    for name, (original, mask) in views.items():
        unedited = _rendered(scene, name, original)
        pictures = {key: _rendered(each, name, original) for key, each in scenes.items()}
        errors["unedited"].append(((unedited - original)[~mask] ** 2).ravel())
        for key, picture in pictures.items():
            errors[key].append(((picture - original)[mask] ** 2).ravel())
            if key in left:
                left[key].append(of_its_color(picture, original, unedited, mask)[mask])
        (top, bottom), (start, end) = (
            (max(i.min() - _MARGIN, 0), i.max() + _MARGIN) for i in np.nonzero(mask)
        )
        rows.append([each[top:bottom, start:end] for each in (unedited, original, *pictures.values())])
    numbers = {
        f"{key}, dB": round(-10 * float(np.log10(np.concatenate(each).mean())), 2)
        for key, each in errors.items()
    }
    shares = {
        f"its color left, {key}": round(float(np.concatenate(each).mean()), 4) for key, each in left.items()
    }
    counts = {"views": len(views), "gaussians added": fill["gaussians"]}
    return {**numbers, **shares, **counts, "delete, processor seconds": round(seconds, 2)}, _sheet(rows)


def of_its_color(
    picture: Array, original: Array, unedited: Array, mask: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` in the hue of a thing where the original has another one.

    The hue is the median of the more colorful half of the thing's pixels.
    """
    own, here, there = (rgb2lab(each)[..., 1:] for each in (unedited, picture, original))
    chroma = np.linalg.norm(own[mask], axis=1)
    hue = np.median(own[mask][chroma >= np.median(chroma)], 0)
    reach = min(_HUE, float(np.linalg.norm(hue)) / 2)  # a pale color must not reach gray
    like, should = (np.linalg.norm(each - hue, axis=-1) < reach for each in (here, there))
    return np.asarray(like & ~should)


def with_true_colors(filled: Scene, count: int, originals: dict[str, Array]) -> Scene:
    """A scene whose last ``count`` Gaussians, the fill, have the colors of renderings.

    Each takes the mean of the views in which nothing is before it; those that no view shows keep theirs.
    """
    gaussians = filled.gaussians
    centers = gaussians.means[len(gaussians) - count :].double().numpy()
    total, seen = np.zeros((count, 3)), np.zeros(count)
    for name, original in originals.items():
        camera = _camera(filled, name, original)
        depths = render(gaussians, camera, depth=True).depth
        assert depths is not None
        x, y, depth = ((centers @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T).T
        places = np.stack([y / depth - 0.5, x / depth - 0.5])
        open_to = map_coordinates(depths.double().numpy(), places, order=1) > 0.97 * depth
        colors = [map_coordinates(channel, places, order=1) for channel in np.moveaxis(original, -1, 0)]
        total += np.stack(colors, 1) * open_to[:, None]
        seen += open_to
    sh0 = gaussians.sh0.clone()
    known = np.flatnonzero(seen)
    colored = torch.from_numpy(total[known] / seen[known][:, None]).to(sh0)
    sh0[len(gaussians) - count + torch.from_numpy(known), 0] = (colored - 0.5) / SH_C0
    return filled.with_content(replace(gaussians, sh0=sh0), filled.field)


def _rendered(scene: Scene, name: str, original: Array) -> Array:
    """A view in the size of its rendering."""
    return scene.render(_camera(scene, name, original)).image.cpu().double().numpy().clip(0, 1)


def _camera(scene: Scene, name: str, original: Array) -> Camera:
    return scene.camera(name).resized(original.shape[1], original.shape[0])


def _read(path: Path) -> Array:
    return np.asarray(Image.open(path).convert("RGB"), float) / 255


def _sheet(rows: list[list[Array]]) -> NDArray[np.uint8]:
    """Rows of pictures below each other."""
    lines = [np.concatenate(row, 1) for row in rows]
    width = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, 4), (0, width - line.shape[1]), (0, 0))) for line in lines]
    return (np.concatenate(padded) * 255).round().astype(np.uint8)


if __name__ == "__main__":
    main()
