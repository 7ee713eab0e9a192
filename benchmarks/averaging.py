"""Time of the language stage without features, against back-projecting every channel at every pixel, in one process.

    python benchmarks/averaging.py                         # a synthetic room of 200,000 Gaussians
    python benchmarks/averaging.py --gaussians 1000000 --views 100 --only-sparse
    python benchmarks/averaging.py --demo output/demo      # the language stage of a scene of `lexsplat demo`

The stage is all of method "averaged": averaging, codebook and segments. The room has no mip filter, like splats of
other programs: its views are rendered at full size. Its features are random; the time of averaging does not depend
on their values. `sparse` is the program, `dense` the same with `DenseCellWeights`, the path of CUDA, with torch on
all threads, as it was before the sparse path. Sparse runs first; `peak` is the peak memory of the process after its
first run. "CPU s" is processor time of all threads.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from records import argument_parser, write_record
from torch import Tensor

from lexsplat.captures import load_capture
from lexsplat.evaluation.demo import DEMO_CONFIG, demo_capture
from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.language.methods import averaging
from lexsplat.language.methods.averaged import Averaged, AveragedConfig
from lexsplat.language.methods.averaging import average_features
from lexsplat.language.methods.method import FitRun, TrainingViews
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders, feature_maps
from lexsplat.rendering import PreparedView
from lexsplat.rendering.back_projection import DenseCellWeights, cell_of
from lexsplat.runtime.progress import Event
from lexsplat.scenes.folder import SceneFolder


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--demo", type=Path, metavar="SCENE", help="measure the language stage of this scene")
    parser.add_argument("--gaussians", type=int, default=200_000)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--size", default="1600x1067")
    parser.add_argument("--dimensions", type=int, default=512)
    parser.add_argument("--cells", type=int, default=112, help="cells along the short side")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--only-sparse", action="store_true")
    parser.add_argument(
        "--mip", action="store_true", help="Gaussians with the mip filter, as `build` makes them"
    )
    options = parser.parse_args()
    run, views = demo_stage(options.demo) if options.demo else synthetic_average(options)
    if not options.demo:
        warm_up()
    paths = ["sparse"] if options.only_sparse else ["sparse", "dense"]
    rows = []
    for repeat in range(options.repeats):
        for path in paths:
            row = measured(run, path)
            rows.append({"path": path, "repeat": repeat, "views": views, **row})
            print(
                "{path:7} {seconds:8.2f} s  {cpu:8.2f} CPU s  peak {peak:.2f} GiB".format(**rows[-1]),
                flush=True,
            )
    if not options.only_sparse:
        best = {path: min(row["cpu"] for row in rows if row["path"] == path) for path in paths}
        print(f"ratio of CPU seconds: {best['dense'] / best['sparse']:.2f}")
        found = [row["first"] for row in rows[:2]]
        print(f"largest difference of the weights of codes: {np.abs(found[0] - found[1]).max():.2g}")
    write_record(options.json, [{k: v for k, v in row.items() if k != "first"} for row in rows])


def measured(run: Callable[[], Any], path: str) -> dict[str, Any]:
    """Wall and CPU seconds of one run, and its first results."""
    start, cpu = time.perf_counter(), time.process_time()
    with ExitStack() as patches:
        if path == "dense":
            patches.enter_context(patch.object(averaging, "weigh_cells", dense_cells))
            unwrapped = averaging._shard_sums.__wrapped__  # type: ignore[attr-defined]
            patches.enter_context(patch.object(averaging, "_shard_sums", unwrapped))
        found = run()
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20)
    return {"seconds": seconds, "cpu": cpu, "peak": peak, "first": np.asarray(found[:4096], np.float32)}


def dense_cells(
    gaussians: Gaussians, camera: Camera, cells: tuple[int, int], counts: Tensor, prepared: PreparedView
) -> DenseCellWeights:
    """What `weigh_cells` makes for CUDA."""
    rows = cell_of(np.arange(camera.height), camera.height, cells[0])
    columns = cell_of(np.arange(camera.width), camera.width, cells[1])
    at = torch.from_numpy(rows[:, None] * cells[1] + columns)
    return DenseCellWeights(gaussians, camera, at, counts, prepared)


def demo_stage(scene: Path) -> tuple[Callable[[], Any], int]:
    """The language stage of a scene of the demo: averaging, codebook and segments."""
    folder = SceneFolder.open(scene)
    capture = load_capture(demo_capture("tabletop"))
    config = DEMO_CONFIG.resolved("cpu", next(iter(capture.views.values())).capture_size)
    capture = capture.downscaled(config.downscale or 1.0)
    capture = replace(
        capture, views={name: capture.views[name] for name in capture.train_names}, test_names=()
    )
    maps = feature_maps(capture, config, Encoders.of(config), folder.features_path)
    gaussians = folder.read_gaussians()
    views = TrainingViews(capture.views, features={name: maps[name] for name in maps})

    def run() -> Any:
        return timed_fit(gaussians, views, config)

    return run, len(capture.views)


def synthetic_average(options: Any) -> tuple[Callable[[], Any], int]:
    """The language stage of a room whose features are random, over views from inside it."""
    width, height = map(int, options.size.split("x"))
    gaussians = replace(room(options.gaussians), antialiased=options.mip)
    angles = np.linspace(0, 2 * np.pi, options.views, endpoint=False)
    cameras = {
        f"{number:03}": look_at(
            np.array([0.5 * np.cos(a), 0.5 * np.sin(a), 0.1]),
            np.array([-2 * np.cos(a), -2 * np.sin(a), -0.3]),
            np.array([0, 0, 1.0]), width, height, 1.0,
        )
        for number, a in enumerate(angles)
    }  # fmt: skip
    shape = (options.cells, round(options.cells * width / height), options.dimensions)
    features = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    maps = dict.fromkeys(cameras, FeatureMap(torch.nn.functional.normalize(features, dim=-1).half()))

    config = BuildConfig(clip="bundled", dino="none", device="cpu")
    views = TrainingViews({name: Unmasked(camera) for name, camera in cameras.items()}, features=maps)

    def run() -> Any:
        return timed_fit(gaussians, views, config)

    return run, options.views


@dataclass(frozen=True)
class Unmasked:
    """A view without a photo: what the fit reads of it."""

    camera: Camera

    def load_valid(self, size: tuple[int, int]) -> None:
        """All pixels count."""


def timed_fit(gaussians: Gaussians, views: TrainingViews, config: BuildConfig) -> Any:
    """The weights of the fit; prints the processor seconds at which each of its parts ended."""
    start, last = time.process_time(), {}

    def listener(event: Event) -> None:
        last[event.stage] = time.process_time() - start

    field = Averaged().fit(gaussians, views, config, FitRun(memory=config.memory_bytes, listener=listener))
    print("  ended after", {stage: f"{seconds:.1f} CPU s" for stage, seconds in last.items()}, flush=True)
    return field.weights


def room(count: int) -> Gaussians:
    """Translucent disks on the walls of a room of 4 x 4 x 2.5 and on a table, of sizes that vary sixfold."""
    rng = np.random.default_rng(0)
    half = np.array([2, 2, 1.25])
    points = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    points *= half
    points[: count // 3] = points[: count // 3] * 0.4 - np.array([0, 0, 0.5])
    made = gaussians_from_points(points, rng.uniform(0, 1, (count, 3)), sh_degree=0)
    log_scales = made.log_scales + torch.from_numpy(rng.normal(0, 0.6, (count, 3)).astype(np.float32))
    opacities = torch.from_numpy(rng.normal(0, 2, count).astype(np.float32))
    return replace(made, log_scales=log_scales, opacity_logits=opacities)


def warm_up() -> None:
    """Compile the kernels."""
    gaussians = room(1000)
    camera = look_at(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), 64, 48, 1.0)
    maps = {"a": FeatureMap(torch.ones(6, 8, 130))}
    for path in ("sparse", "dense"):
        measured(lambda: average_features(gaussians, {"a": camera}, maps, AveragedConfig()).means, path)
    timed_fit(gaussians, TrainingViews({"a": Unmasked(camera)}, features=maps), BuildConfig(dino="none"))


if __name__ == "__main__":
    main()
