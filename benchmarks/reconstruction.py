"""Reconstruction quality (PSNR, SSIM, Gaussians, processor seconds) of settings, over captures and seeds.

    python benchmarks/reconstruction.py second demo ../data/bonsai=4 --variants default mcmc --seeds 0 1 --json FILE
    python benchmarks/reconstruction.py demo=3 --photos 12 --variants default --points 0 2500 --iterations 1500

A capture is a folder, ``demo`` or ``second``, optionally with ``=DOWNSCALE``. Settings are measured on **validation
views**: every sixth *training* view is held out and the test views are not used, so a default may be chosen by this
table. ``--on test`` measures a chosen default on the test views. All variants start from the same points, which are
computed once. ``--points`` varies how many points few photos are filled up to; 0 adds none.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from records import argument_parser, write_record

from lexsplat.captures import Capture, InitialPoints, View, initial_points, load_capture
from lexsplat.cli.progress import ProgressBars
from lexsplat.evaluation.demo import demo_capture
from lexsplat.evaluation.metrics import psnr, ssim
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.reconstruction.few_photos import ENOUGH_POINTS, has_few_photos, points_between
from lexsplat.rendering import render

VALIDATION_EVERY = 6
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "mcmc": {"strategy": "mcmc"},
    "plain-rates": {"rate_scale": 1.0},
    "no-warm-up": {"warm_up": 0.0},
    "no-cool-down": {"cool_down": 0.0},  # with the lower rates of a training without one
    "no-renewal": {"renewal": 0.0},
    "classic": {"antialiased": False},
    "half-cap": {"max_gaussians": 20_000},
    "quarter-cap": {"max_gaussians": 10_000},
    "degree-1": {"sh_degree": 1},
    # The default is the first of these for many photos and the last for few.
    "plain": {"opacity_weight": 0.0, "scale_weight": 0.0, "exposure": False},
    "regularized": {"opacity_weight": 0.01, "scale_weight": 0.01, "exposure": False},
    "exposure": {"opacity_weight": 0.0, "scale_weight": 0.0, "exposure": True},
    "regularized-exposure": {"opacity_weight": 0.01, "scale_weight": 0.01, "exposure": True},
}
"""Variants by name, and the fields of `ReconstructionConfig` that they change."""


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[=DOWNSCALE]")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["default", "mcmc"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--iterations", type=int, help="optimization steps; default: 2,000, on CUDA 30,000")
    parser.add_argument("--on", choices=("validation", "test"), default="validation")
    parser.add_argument("--photos", type=int, help="training photos, evenly spaced; default: all")
    parser.add_argument("--points", type=int, nargs="+", default=[ENOUGH_POINTS], metavar="N")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    rows = []
    print(f"{'capture':14} {'variant':20}  points seed   PSNR   SSIM  Gaussians  seconds")
    for wish in options.captures:
        name, _, downscale = wish.partition("=")
        scene, config = prepared(name, float(downscale) if downscale else None, options)
        with ProgressBars() as bars:
            known = initial_points(scene, seed=0, listener=bars)
        for variant, enough, seed in product(options.variants, options.points, options.seeds):
            points = points_between(scene, known, enough=enough) if has_few_photos(scene) else known
            changed = dataclasses.replace(config, **VARIANTS[variant])
            row = {"capture": Path(name).name, "variant": variant, "points": len(points.points), "seed": seed}
            row |= measured(scene, changed, points, seed, options.device)
            rows.append(row)
            print(
                f"{row['capture']:14} {variant:20} {row['points']:7,} {seed:4} {row['psnr']:6.2f} {row['ssim']:6.3f}"
                f" {row['gaussians']:10,} {row['seconds']:8.1f}",
                flush=True,
            )
    write_record(options.json, rows, on=options.on, device=options.device)


def prepared(
    name: str, downscale: float | None, options: argparse.Namespace
) -> tuple[Capture, ReconstructionConfig]:
    """A capture at its working size with the chosen split, and the settings that `lexsplat build` would use."""
    capture = demo_capture("tabletop" if name == "demo" else "second") if name in ("demo", "second") else name
    scene = load_capture(capture)
    largest = max((view.capture_size for view in scene.views.values()), key=lambda size: size[0] * size[1])
    wished = BuildConfig(downscale=downscale, iterations=options.iterations)
    config = wished.resolved(options.device, largest)
    scene = scene.downscaled(config.downscale or 1.0)
    if options.photos:
        places = np.linspace(0, len(scene.train_names) - 1, options.photos).round().astype(int)
        # The points of the capture come from all photos; those of a user would come from these.
        none = np.zeros((0, 3), np.float32)
        names = tuple(scene.train_names[place] for place in places)
        scene = dataclasses.replace(scene, train_names=names, points=none, point_colors=none)
    if options.on == "validation":
        held_out = scene.train_names[::VALIDATION_EVERY]
        kept = tuple(view for view in scene.train_names if view not in held_out)
        scene = dataclasses.replace(scene, train_names=kept, test_names=held_out)
    return scene, config.reconstruction


def measured(
    scene: Capture, config: ReconstructionConfig, points: InitialPoints, seed: int, device: str
) -> dict[str, Any]:
    """Train once and measure the held-out views at the working size."""
    trainer = Reconstructor(scene, config, points, device=device, seed=seed)
    start = time.process_time()
    trainer.run()
    seconds = time.process_time() - start
    scores = np.array([view_scores(trainer, scene, view) for view in scene.test_views])
    return {
        "psnr": float(scores[:, 0].mean()),
        "ssim": float(scores[:, 1].mean()),
        "gaussians": len(trainer.gaussians().means),
        "seconds": seconds,
        "views": len(scores),
    }


@torch.no_grad()
def view_scores(trainer: Reconstructor, scene: Capture, view: View) -> Sequence[float]:
    """PSNR in dB and SSIM of one view."""
    background = torch.tensor(scene.background, device=trainer.device)
    image = render(trainer.gaussians(), view.camera, background=background).image
    pixels, photo = image.clamp(0, 1).cpu().numpy(), view.load_image()
    return psnr(pixels, photo), ssim(pixels, photo)


if __name__ == "__main__":
    main()
