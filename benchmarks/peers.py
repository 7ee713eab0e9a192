"""Other CPU rasterizers in the training of this project: time of a step, PSNR and memory on the same capture.

    python benchmarks/peers.py [--capture demo|second] [--steps 30] [--repeats 3] [--json FILE]

Only the rasterizer differs: points, losses, optimizers, density control and the order of views are the same. Each
peer trains in a process of its own. Repeats alternate the peers.

    lexsplat    the Numba kernels
    gsplat      gsplat's torch functions for projection, colors and tile lists, blended by `blend_tile` with autograd;
                gsplat's own torch blending needs a CUDA build of nerfacc
    OpenSplat   skipped: it must be built from source with the headers of OpenCV, which this script does not do

The milliseconds of a step are medians after three steps; PSNR is that of the held-out views after all steps.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import torch
from records import argument_parser, write_record
from torch import Tensor

from lexsplat.captures import initial_points, load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.evaluation.metrics import psnr
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import Reconstructor
from lexsplat.rendering import backends, render
from lexsplat.rendering.results import Projection

TILE = 16
WARM_STEPS = 3
PEERS = ("lexsplat", "gsplat")
SKIPPED = {"OpenSplat": "must be built from source with the headers of OpenCV"}


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
    return SimpleNamespace(
        camera=camera, columns=columns, offsets=[*offsets, len(members)], members=members.long()
    )


def shade(gaussians: Gaussians, camera: Camera, projection: Projection, degree: int) -> Tensor:
    """gsplat's spherical harmonics."""
    from gsplat.cuda._torch_impl import _spherical_harmonics

    directions = gaussians.means - torch.tensor(camera.position, dtype=torch.float32)
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    return (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0)


def blend_tile(
    projection: Projection, colors: Tensor, members: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    """Colors ``[P, C]`` and transmittance ``[P]`` of the pixels ``[P, 2]`` behind the listed Gaussians."""
    offset = pixels[:, None] - projection.means2d[members]
    xx, xy, yy = projection.conics[members].unbind(-1)
    exponent = (
        0.5 * (xx * offset[..., 0] ** 2 + yy * offset[..., 1] ** 2) + xy * offset[..., 0] * offset[..., 1]
    )
    alpha = (projection.opacities[members] * torch.exp(-exponent)).clamp_max(0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones(len(pixels), 1), after[:, :-1]], 1)
    return (alpha * before * (after > 1e-4)) @ colors[members], after[:, -1]


def blend(
    projection: Projection, tiles: SimpleNamespace, colors: Tensor, features: None, background: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The image ``[H, W, 3]`` over the background and alpha ``[H, W]``, tile by tile."""
    width, height = tiles.camera.width, tiles.camera.height
    behind = torch.zeros(3) if background is None else background
    rows = []
    for top in range(0, height, TILE):
        row = []
        for column, left in enumerate(range(0, width, TILE)):
            tile = top // TILE * tiles.columns + column
            members = tiles.members[tiles.offsets[tile] : tiles.offsets[tile + 1]]
            ys, xs = torch.meshgrid(
                torch.arange(top, min(top + TILE, height)) + 0.5,
                torch.arange(left, min(left + TILE, width)) + 0.5,
                indexing="ij",
            )
            values = torch.cat([behind.expand(ys.numel(), 3), torch.zeros(ys.numel(), 1)], 1)
            if len(members):
                pixels = torch.stack([xs.flatten(), ys.flatten()], 1)
                color, passed = blend_tile(projection, colors, members, pixels)
                values = torch.cat([color + passed[:, None] * behind, 1 - passed[:, None]], 1)
            row.append(values.reshape(*ys.shape, 4))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows, 0)
    return image[..., :3], image[..., 3]


def train(peer: str, name: str, steps: int, threads: int) -> dict[str, float]:
    """Train from the same points with the rasterizer of ``peer``."""
    torch.set_num_threads(threads)
    if peer == "gsplat":
        functions = {"project": project, "find_tiles": find_tiles, "shade": shade, "blend": blend}
        backends.backend_for = lambda gaussians: SimpleNamespace(__name__=peer, **functions)
    capture = load_capture(demo_capture("tabletop" if name == "demo" else "second"))
    config = BuildConfig(iterations=3000).resolved("cpu", next(iter(capture.views.values())).capture_size)
    capture = capture.downscaled(config.downscale or 1.0)
    trainer = Reconstructor(capture, config.reconstruction, initial_points(capture, seed=0), seed=0)
    times = []
    for _ in range(steps):
        start = time.process_time(), time.perf_counter()
        trainer.step()
        times.append((time.process_time() - start[0], time.perf_counter() - start[1]))
    processor, wall = np.median(1e3 * np.array(times[WARM_STEPS:]), 0)
    background = torch.tensor(capture.background)
    with torch.no_grad():
        images = [
            render(trainer.gaussians(), v.camera, background=background).image for v in capture.test_views
        ]
    errors = [psnr(i.clamp(0, 1).numpy(), v.load_image()) for i, v in zip(images, capture.test_views)]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"processor_ms": processor, "wall_ms": wall, "psnr": float(np.mean(errors)), "peak_bytes": peak}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--capture", choices=("demo", "second"), default="demo")
    parser.add_argument("--steps", type=int, default=30, help="training steps, more than 3")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument(
        "--only", choices=PEERS, help="train one peer in this process and print its numbers as JSON"
    )
    options = parser.parse_args()
    if options.steps <= WARM_STEPS:
        parser.error(f"--steps must be more than {WARM_STEPS}, got {options.steps}")
    if options.only:
        print(json.dumps(train(options.only, options.capture, options.steps, options.threads)))
        return
    runs: dict[str, list[dict[str, float]]] = {peer: [] for peer in PEERS}
    for _ in range(options.repeats):
        for peer in PEERS:
            arguments = ["--capture", options.capture, "--steps", options.steps, "--threads", options.threads]
            command = [sys.executable, __file__, "--only", peer, *map(str, arguments)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            runs[peer].append(json.loads(done.stdout.splitlines()[-1]))
    print(f"{'peer':10} {'processor ms':>12} {'wall ms':>9} {'PSNR':>6} {'peak MB':>8}")
    rows = []
    for peer, found in runs.items():
        row = {key: float(np.median([run[key] for run in found])) for key in found[0]}
        rows.append({"peer": peer, **row})
        print(
            f"{peer:10} {row['processor_ms']:12.1f} {row['wall_ms']:9.1f} {row['psnr']:6.2f}"
            f" {row['peak_bytes'] / 1e6:8.0f}"
        )
    for peer, reason in SKIPPED.items():
        print(f"{peer:10} skipped: {reason}")
    conditions = {"capture": options.capture, "steps": options.steps, "threads": options.threads}
    write_record(options.json, rows, **conditions, repeats=options.repeats, skipped=SKIPPED)


if __name__ == "__main__":
    main()
