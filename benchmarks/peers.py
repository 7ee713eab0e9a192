"""Other trainers on a CPU beside ours: time of a step, PSNR and memory on the same capture.

    python benchmarks/peers.py [--capture demo|second] [--steps 30] [--repeats 3]
        [--opensplat PROGRAM|SOURCES|fetch] [--json FILE]

    lexsplat    our trainer with the Numba kernels
    gsplat      our trainer with gsplat's torch functions for projection, colors and tile lists, blended by torch
                operations with autograd; gsplat's own torch blending needs a CUDA build of nerfacc
    naive       `naive.py`: the trainer of the paper in torch operations
    OpenSplat   a program that is on this machine, or is built from its sources; skipped without one

All train on the same photos of the same size from the same points, and all schedules end with the last step. The rest
is each trainer's own: learning rates, order of views, degrees of colors, density control. Each peer trains in a
process of its own. Repeats alternate the peers.

The milliseconds of a step are medians after three steps. PSNR is that of the held-out views after all steps, rendered
by lexsplat (for gsplat by itself) over the color that the peer trains over. Memory is the peak of the process, which
includes Python for all but OpenSplat.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from naive import LAST_STEP, TILE, NaiveTrainer, blend
from opensplat import BACKGROUND, Skipped, find_opensplat, train_opensplat
from records import REPOSITORY, argument_parser, write_record
from torch import Tensor

from lexsplat.captures import initial_points, load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.evaluation.memory import peak_memory
from lexsplat.evaluation.metrics import psnr
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import Reconstructor
from lexsplat.rendering import backends, render
from lexsplat.rendering.results import Projection

WARM_STEPS = 3
PEERS = ("lexsplat", "gsplat", "naive", "OpenSplat")


def project(gaussians: Gaussians, camera: Camera, near: float) -> Projection:
    """gsplat's projection, with the mip filter where the Gaussians are antialiased."""
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.log_scales.exp(), True, False)
    view, K = (torch.tensor(array, dtype=torch.float32)[None] for array in (camera.viewmat, camera.K))
    radii, means2d, depths, conics, factors = _fully_fused_projection(
        gaussians.means, covariances, view, K, camera.width, camera.height,
        near_plane=near, calc_compensations=gaussians.antialiased,
    )  # fmt: skip
    opacities = gaussians.opacity_logits.sigmoid()
    if factors is not None:
        opacities = opacities * factors[0]
    return Projection(
        means2d=means2d[0], conics=conics[0], opacities=opacities, depths=depths[0].detach(),
        radii=radii[0].amax(-1), extents=radii[0], means=gaussians.means,
    )  # fmt: skip


def find_tiles(projection: Projection, camera: Camera) -> SimpleNamespace:
    """gsplat's list of the Gaussians of each tile, nearest first."""
    from gsplat.cuda._torch_impl import _isect_offset_encode, _isect_tiles

    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    lists = (projection.means2d.detach()[None], projection.extents[None], projection.depths[None])
    _, keys, members = _isect_tiles(*lists, TILE, columns, rows)
    offsets = _isect_offset_encode(keys, 1, columns, rows).flatten().tolist()
    sizes = np.diff([*offsets, len(members)]).tolist()
    return SimpleNamespace(camera=camera, members=members.long().split(sizes))


def shade(gaussians: Gaussians, camera: Camera, projection: Projection, degree: int) -> Tensor:
    """gsplat's spherical harmonics."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    directions = gaussians.means - torch.tensor(camera.position, dtype=torch.float32)
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    return (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0)


def train(peer: str, options: Namespace) -> dict[str, float]:
    """Train one peer in this process.

    Raises:
        Skipped: If it cannot run here.
    """
    torch.set_num_threads(options.threads)
    capture = load_capture(demo_capture("tabletop" if options.capture == "demo" else "second"))
    sizes = next(iter(capture.views.values())).capture_size
    config = BuildConfig(iterations=options.steps).resolved("cpu", sizes)
    capture = capture.downscaled(config.downscale or 1.0)
    points = initial_points(capture, seed=0)
    background = torch.tensor(capture.background)
    if peer == "OpenSplat":
        program = find_opensplat(options.opensplat, REPOSITORY / "output" / "opensplat")
        gaussians, seconds, peak = train_opensplat(program, capture, points, options.steps, options.threads)
        background = torch.tensor(BACKGROUND)
    else:
        trainer: NaiveTrainer | Reconstructor
        if peer == "naive":
            if options.steps > LAST_STEP:
                raise Skipped(f"without density control it trains at most {LAST_STEP} steps")
            trainer = NaiveTrainer(capture, points, options.steps)
        else:
            if peer == "gsplat":
                functions = {"project": project, "find_tiles": find_tiles, "shade": shade, "blend": blend}
                backends.backend_for = lambda gaussians: SimpleNamespace(__name__=peer, **functions)
            # Without the warm-up, whose steps run at half the size.
            trainer = Reconstructor(capture, replace(config.reconstruction, warm_up=0.0), points, seed=0)
        clocks = [(time.process_time(), time.perf_counter())]
        for _ in range(options.steps):
            trainer.step()
            clocks.append((time.process_time(), time.perf_counter()))
        gaussians, seconds, peak = trainer.gaussians().detach(), np.diff(clocks, axis=0), peak_memory() or 0
    processor, wall = np.median(1e3 * seconds[WARM_STEPS:], 0)
    images = [render(gaussians, view.camera, background=background).image for view in capture.test_views]
    errors = [psnr(i.clamp(0, 1).numpy(), v.load_image()) for i, v in zip(images, capture.test_views)]
    return {
        "processor_ms": processor, "wall_ms": wall, "psnr": float(np.mean(errors)), "peak_bytes": peak,
        "gaussians": len(gaussians),
    }  # fmt: skip


def train_elsewhere(peer: str, options: Namespace) -> dict[str, Any]:
    """`train` in a process of its own; ``{"skipped": reason}`` where the peer cannot run."""
    arguments = ["--capture", options.capture, "--steps", options.steps, "--threads", options.threads]
    if options.opensplat:
        arguments += ["--opensplat", options.opensplat]
    command = [sys.executable, __file__, "--only", peer, *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--capture", choices=("demo", "second"), default="demo")
    parser.add_argument("--steps", type=int, default=30, help=f"training steps, more than {WARM_STEPS + 1}")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument(
        "--opensplat",
        metavar="PROGRAM|SOURCES|fetch",
        default=shutil.which("opensplat"),
        help="the program, a folder of its sources, or fetch; by default the program on the path",
    )
    parser.add_argument(
        "--only", choices=PEERS, help="train one peer in this process and print its numbers as JSON"
    )
    options = parser.parse_args()
    if options.steps <= WARM_STEPS + 1:  # the time of OpenSplat's first step is not seen
        parser.error(f"--steps must be more than {WARM_STEPS + 1}, got {options.steps}")
    if options.only:
        try:
            print(json.dumps(train(options.only, options)))
        except Skipped as reason:
            print(json.dumps({"skipped": str(reason)}))
        return
    runs: dict[str, list[dict[str, float]]] = {peer: [] for peer in PEERS}
    skipped = {}
    try:  # here, so that it is built once
        options.opensplat = find_opensplat(options.opensplat, REPOSITORY / "output" / "opensplat")
    except Skipped as reason:
        skipped["OpenSplat"] = str(reason)
        del runs["OpenSplat"]
    for _ in range(options.repeats):
        for peer in [peer for peer in PEERS if peer not in skipped]:
            found = train_elsewhere(peer, options)
            if "skipped" in found:
                skipped[peer] = found["skipped"]
                del runs[peer]
            else:
                runs[peer].append(found)
    print(f"{'peer':10} {'processor ms':>12} {'wall ms':>9} {'PSNR':>6} {'peak MB':>8} {'Gaussians':>9}")
    rows = []
    for peer, repeats in runs.items():
        row = {key: float(np.median([run[key] for run in repeats])) for key in repeats[0]}
        rows.append({"peer": peer, **row})
        print(
            f"{peer:10} {row['processor_ms']:12.1f} {row['wall_ms']:9.1f} {row['psnr']:6.2f}"
            f" {row['peak_bytes'] / 1e6:8.0f} {row['gaussians']:9,.0f}"
        )
    for peer, reason in skipped.items():
        print(f"{peer:10} skipped: {reason}")
    conditions = {"capture": options.capture, "steps": options.steps, "threads": options.threads}
    write_record(options.json, rows, **conditions, repeats=options.repeats, skipped=skipped)


if __name__ == "__main__":
    main()
