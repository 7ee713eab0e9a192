"""Reconstruct a capture in one piece or in blocks: PSNR of held-out views, Gaussians, peak memory, seconds.

python benchmarks/blocks.py CAPTURE --blocks 4 --iterations 600 --max-gaussians 8000
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import initial_points
from lexsplat.geometry.world import World
from lexsplat.reconstruction import ReconstructionConfig, reconstruct
from lexsplat.reconstruction.blocks import BlockRun, reconstruct_blocks
from lexsplat.rendering import render


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--blocks", type=int, default=1)
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--max-gaussians", type=int, default=8000)
    parser.add_argument("--downscale", type=float, default=1.0)
    given = parser.parse_args()
    capture = load_capture(given.capture, test_every=8).downscaled(given.downscale)
    config = ReconstructionConfig(iterations=given.iterations, max_gaussians=given.max_gaussians)
    before, start, cpu = _peak(), time.perf_counter(), time.process_time()
    if given.blocks == 1:
        gaussians = reconstruct(capture, config)
    else:
        up = World.of_cameras(view.camera for view in capture.train_views).up
        points = initial_points(capture)
        with tempfile.TemporaryDirectory() as folder:
            run = BlockRun("cpu", 0, 4 << 30, Path(folder), "benchmark")
            gaussians = reconstruct_blocks(capture, config, points, up, given.blocks, run)
    result = {
        "blocks": given.blocks,
        "gaussians": len(gaussians),
        "seconds": round(time.perf_counter() - start, 1),
        "cpu_seconds": round(time.process_time() - cpu, 1),
        "peak_mb": _peak() >> 20,
        "peak_above_start_mb": (_peak() - before) >> 20,
    }
    errors = []
    for view in capture.test_views:
        with torch.no_grad():
            image = render(gaussians, view.camera).image.clamp(0, 1).numpy()
        errors.append(float(np.mean((image - view.load_image()) ** 2)))
    result["psnr"] = round(float(np.mean([-10 * np.log10(error) for error in errors])), 2)
    json.dump(result, sys.stdout)
    print()


def _peak() -> int:
    """Highest memory of this process so far in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main()
