"""One training in slices, for `time_to_quality.py`; it runs with today's packages and with those of `d4e65b3`.

Reads a number of steps from each line of the standard input, trains as many, and answers with a line of JSON: steps
done, wall and processor seconds of the slice, and the mean PSNR of the held-out views, which is not in these seconds.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from typing import Any

import numpy as np
import torch

try:
    from lexsplat.captures import initial_points, load_capture
    from lexsplat.evaluation.demo import demo_capture
    from lexsplat.pipeline.config import BuildConfig
except ImportError:  # the flat modules before the fifteen packages
    from lexsplat.config import BuildConfig  # type: ignore[import-not-found,no-redef]
    from lexsplat.demo.demo import demo_capture  # type: ignore[no-redef]

    from lexsplat.scenes import initial_points  # type: ignore[attr-defined,no-redef]
    from lexsplat.scenes import load_scene as load_capture  # type: ignore[attr-defined,no-redef]
from lexsplat.reconstruction import Reconstructor
from lexsplat.rendering import render

try:
    from lexsplat.reconstruction.few_photos import has_few_photos, points_between
except ImportError:  # `d4e65b3` adds no points
    has_few_photos = None  # type: ignore[assignment]

VALIDATION_EVERY = 6
SLICE_BEFORE = 4  # steps of a training that is thrown away: kernels are compiled in it


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", metavar="CAPTURE[=DOWNSCALE]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--on", choices=("validation", "test"), default="test")
    parser.add_argument("--settings", type=json.loads, default={}, help="changed fields, as JSON")
    parser.add_argument("--length", type=float, default=1.0, help="share of the usual steps")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    capture, config = prepared(options)
    points = starting_points(capture, options.seed)
    before = Reconstructor(capture, config, points, device="cpu", seed=options.seed)
    for _ in range(SLICE_BEFORE):
        before.step()
    mean_psnr(before, capture)
    trainer = Reconstructor(capture, config, points, device="cpu", seed=options.seed)
    answer(steps=0, total=config.iterations)
    for line in sys.stdin:
        wall, processor = time.perf_counter(), time.process_time()
        for _ in range(min(int(line), config.iterations - trainer.steps_done)):
            trainer.step()
        spent = {"wall": time.perf_counter() - wall, "processor": time.process_time() - processor}
        gaussians = len(trainer.gaussians().means)
        answer(steps=trainer.steps_done, **spent, psnr=mean_psnr(trainer, capture), gaussians=gaussians)


def answer(**fields: Any) -> None:
    """Print one line of JSON at once."""
    print(json.dumps(fields), flush=True)


def prepared(options: argparse.Namespace) -> tuple[Any, Any]:
    """The capture at its working size with the chosen split, and the settings that ``lexsplat build`` would use."""
    name, _, downscale = options.capture.partition("=")
    source = demo_capture("tabletop" if name == "demo" else "second") if name in ("demo", "second") else name
    capture = load_capture(source)
    views = capture.views.values()
    largest = max((view.capture_size for view in views), key=lambda size: size[0] * size[1])
    config = BuildConfig(downscale=float(downscale) if downscale else None).resolved("cpu", largest)
    capture = capture.downscaled(config.downscale or 1.0)
    if options.on == "validation":
        held_out = capture.train_names[::VALIDATION_EVERY]
        kept = tuple(view for view in capture.train_names if view not in held_out)
        capture = dataclasses.replace(capture, train_names=kept, test_names=held_out)
    training = dataclasses.replace(config.reconstruction, **options.settings)
    iterations = max(1, round(options.length * training.iterations))
    return capture, dataclasses.replace(training, iterations=iterations)


def starting_points(capture: Any, seed: int) -> Any:
    """The points from which ``lexsplat build`` of the same version trains: few photos get more, if it adds any."""
    points = initial_points(capture, seed=seed)
    if has_few_photos is None or points.origin == "random" or not has_few_photos(capture):
        return points
    return points_between(capture, points, seed)


@torch.no_grad()
def mean_psnr(trainer: Any, capture: Any) -> float:
    """Mean PSNR of the held-out views in dB."""
    background = torch.tensor(capture.background)
    values = []
    for view in capture.test_views:
        image = render(trainer.gaussians(), view.camera, background=background).image.clamp(0, 1).numpy()
        values.append(-10 * np.log10(np.mean((image - view.load_image()) ** 2, dtype=np.float64)))
    return float(np.mean(values))


if __name__ == "__main__":
    main()
