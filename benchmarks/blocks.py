"""Reconstruct a capture in one piece or in blocks: PSNR of held-out views, Gaussians, memory, processor seconds.

python tools/demo_scene/street.py output/street
python benchmarks/blocks.py output/street --blocks 9 --iterations 2560 --max-gaussians 12000 --save output/nine.ply

Every eighth view is held out. The memory is the peak of the process less what it has after a tiny reconstruction, so
without libraries and compiled kernels. ``--pictures FOLDER`` writes held-out views that show a seam: the photo, the
rendering, and the rendering in the colors of the cells, side by side.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures import Capture, View, load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints, initial_points
from lexsplat.evaluation.memory import forget_peak_memory, peak_memory
from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.geometry.world import World
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.reconstruction.block_training import BlockRun, reconstruct_blocks
from lexsplat.reconstruction.blocks import cut_blocks, ground_axes
from lexsplat.rendering import render
from lexsplat.scenes.formats.ply import write_ply


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--blocks", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--max-gaussians", type=int, default=8000)
    parser.add_argument("--downscale", type=float, default=1.0)
    parser.add_argument("--points", type=Path, help="folder that keeps triangulated points for the next call")
    parser.add_argument("--save", type=Path, help="PLY file of the result")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of seams")
    given = parser.parse_args()
    names = sorted(load_capture(given.capture).views)  # annotated views would be held out, and may be few
    capture = load_capture(given.capture, test_names=names[::8]).downscaled(given.downscale)
    config = ReconstructionConfig(iterations=given.iterations, max_gaussians=given.max_gaussians)
    points = initial_points(capture, cache_dir=given.points)
    Reconstructor(capture, replace(config, iterations=10, max_gaussians=100), points).run()
    forget_peak_memory()
    before, start, cpu = peak_memory() or 0, time.perf_counter(), time.process_time()
    result: dict[str, object] = {"blocks": given.blocks, "points": len(points.points)}
    if given.blocks == 1:
        trainer = Reconstructor(capture, config, points)
        trainer.run()
        gaussians = trainer.gaussians()
    else:
        up = World.of_cameras(view.camera for view in capture.train_views).up
        with tempfile.TemporaryDirectory() as folder:
            run = BlockRun("cpu", 0, 4 << 30, Path(folder), "benchmark")
            gaussians = reconstruct_blocks(capture, config, points, up, given.blocks, run)
    result |= {
        "gaussians": len(gaussians),
        "seconds": round(time.perf_counter() - start, 1),
        "cpu_seconds": round(time.process_time() - cpu, 1),
        "peak_above_start_mb": ((peak_memory() or 0) - before) >> 20,
    }
    result["psnr"] = round(float(np.mean([_psnr(gaussians, view) for view in capture.test_views])), 2)
    if given.save is not None:
        given.save.parent.mkdir(parents=True, exist_ok=True)
        write_ply(gaussians, given.save)
    if given.pictures is not None:
        _write_pictures(gaussians, capture, points, given.blocks if given.blocks > 1 else 9, given.pictures)
    json.dump(result, sys.stdout)
    print()


def _image(gaussians: Gaussians, view: View) -> NDArray[np.float32]:
    with torch.no_grad():
        return render(gaussians, view.camera).image.clamp(0, 1).numpy()


def _psnr(gaussians: Gaussians, view: View) -> float:
    return -10 * float(np.log10(np.mean((_image(gaussians, view) - view.load_image()) ** 2)))


def _write_pictures(
    gaussians: Gaussians, capture: Capture, points: InitialPoints, count: int, folder: Path
) -> None:
    """Write the four held-out views in which the points of two cells are most nearly equal in number."""
    folder.mkdir(parents=True, exist_ok=True)
    axes = ground_axes(World.of_cameras(view.camera for view in capture.train_views).up)
    cut = cut_blocks(capture, points.points, axes, count, deal=True)
    colors = np.random.default_rng(0).permuted(np.linspace(0.1, 0.9, 3 * count).reshape(count, 3), axis=0)
    of_cells = torch.from_numpy(colors[cut.cells_of(gaussians.means.numpy())]).float()[:, None]
    painted = replace(gaussians, sh0=(of_cells - 0.5) / SH_C0, shN=torch.zeros_like(gaussians.shN))

    def second(view: View) -> float:
        return float(np.sort(cut.shares(view, points.points))[-2])

    for view in sorted(capture.test_views, key=second)[-4:]:
        images = [view.load_image(), _image(gaussians, view), _image(painted, view)]
        picture = np.round(255 * np.concatenate(images, 1)).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{view.stem}.png")


if __name__ == "__main__":
    main()
