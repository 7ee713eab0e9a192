"""Tasks on Ray workers of this machine, one thread each: seconds, processor seconds, overlap, overhead.

python benchmarks/workers.py --work features averages scenes --workers 1 2 4 --views 48 --scenes 4

    start         seconds until Ray and its workers can take tasks: what a build on Ray adds before it begins
    seconds       from the start of the first task to the end of the last, without the first one of each worker, which
                  loads libraries and encoders
    cpu_seconds   processor time of these tasks, and of the busiest worker among them
    overlap       mean number of tasks under way
    speed_up      seconds a task of the first number of workers / those of this one
    speed_up_cpu  the same with the processor time of the busiest worker: that of a machine on which nothing else runs

The demo's views are encoded, their features averaged over the shipped Gaussians, and its capture built several times
with few iterations.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from records import argument_parser, write_record

from lexsplat import open_scene
from lexsplat.captures import load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.features import FeatureConfig, extract_features
from lexsplat.language.methods import averaging
from lexsplat.language.methods.averaged import AveragedConfig
from lexsplat.pipeline import distribution
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders
from lexsplat.runtime.progress import silent
from lexsplat.runtime.ray_watch import HeadWatch
from lexsplat.runtime.ray_workers import RayWorkers
from lexsplat.runtime.workers import SharedFolder, results

CONFIG = BuildConfig(clip="bundled", dino="bundled", device="cpu", encoder_device="cpu")
Tasks = tuple[Callable[..., Any], Any, Mapping[str, Any]]
"""What a task does, what all of them share, and the items."""


def timed(shared: tuple[Callable[..., Any], Any], item: Any) -> tuple[int, float, float, float]:
    """A worker, and when it started and ended a task, and its processor time."""
    work, inner = shared
    start, cpu = time.time(), time.process_time()
    work(inner, item)
    return os.getpid(), start, time.time(), time.process_time() - cpu


def nothing(shared: None, item: int) -> int:
    """A task that takes no time."""
    return item


@contextmanager
def features(views: int, scenes: int) -> Iterator[Tasks]:
    """Each view is a task."""
    capture = load_capture(demo_capture())
    chosen = dict(list(capture.views.items())[:views])
    with tempfile.TemporaryDirectory() as folder, SharedFolder.offered(Path(folder)) as cache:
        shared = distribution._Extraction(distribution._views_only(capture), CONFIG, cache)
        yield distribution._extract_view, shared, chosen


@contextmanager
def averages(views: int, scenes: int) -> Iterator[Tasks]:
    """Each shard of 16 views is a task, sixteen times over; features are of one crop size."""
    capture = load_capture(demo_capture())
    names = list(capture.train_names)[:views]
    capture = replace(
        capture, views={n: capture.views[n] for n in names}, train_names=tuple(names), test_names=()
    )
    encoders, few = Encoders.of(CONFIG), FeatureConfig(crop_sizes=(0.36,), crop_strides=(0.5,))
    with tempfile.TemporaryDirectory() as folder:
        maps = extract_features(capture, encoders.clip, encoders.dino, few, cache_dir=Path(folder))
        gaussians = open_scene("demo").gaussians
        shared = averaging._Averaging(
            gaussians,
            {n: capture.views[n].camera for n in names},
            maps,
            AveragedConfig(),
            averaging.all_valid,
            0,
        )
        dimensions = maps[names[0]].clip.shape[-1]
        shards = averaging.view_shards(names)
        items = {
            f"{shard[0]}, {i}": (shard, range(dimensions), dimensions, None)
            for i in range(16)
            for shard in shards
        }
        yield averaging._shard_sums, shared, items


@contextmanager
def whole_scenes(views: int, scenes: int) -> Iterator[Tasks]:
    """Each scene is a task."""
    with tempfile.TemporaryDirectory() as folder, SharedFolder.offered(Path(folder)) as output:
        few = FeatureConfig(crop_sizes=(0.36,), crop_strides=(0.5,))
        config = replace(CONFIG, iterations=100, features=few)
        tasks = {
            str(i): distribution.SceneTask(demo_capture(), Path(folder) / str(i), config)
            for i in range(scenes)
        }
        yield distribution._build_scene, distribution._Scenes(output, silent), tasks


WORK = {"features": features, "averages": averages, "scenes": whole_scenes}


def measure(kind: str, workers: int, views: int, scenes: int) -> dict[str, float | str]:
    """One run with this many workers."""
    import ray

    began = time.time()
    ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        engine = RayWorkers(HeadWatch(None))
        list(results(engine.map(nothing, None, {str(i): i for i in range(workers)})))
        start = time.time() - began
        with WORK[kind](views, scenes) as (work, shared, items):
            found = list(results(engine.map(timed, (work, shared), items)))
    finally:
        ray.shutdown()
    return {"work": kind, "workers": workers, "start": round(start, 1), **summary(found)}


def summary(found: list[tuple[int, float, float, float]]) -> dict[str, float]:
    """Figures of the tasks but the first one of each worker."""
    by_worker = defaultdict(list)
    for worker, *times in sorted(found, key=lambda task: task[1]):
        by_worker[worker].append(times)
    tasks = {worker: times[1:] for worker, times in by_worker.items()}
    every = [times for worker in tasks.values() for times in worker]
    seconds = max(end for _, end, _ in every) - min(start for start, _, _ in every)
    return {
        "tasks": len(every),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(sum(cpu for _, _, cpu in every), 1),
        "cpu_seconds_of_the_busiest": round(
            max(sum(cpu for *_, cpu in times) for times in tasks.values()), 1
        ),
        "overlap": round(sum(end - start for start, end, _ in every) / seconds, 2),
    }


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--work", nargs="+", choices=list(WORK), default=list(WORK))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--scenes", type=int, default=8)
    given = parser.parse_args()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_worker_niceness", "0")  # else they wait for all other work
    rows = []
    for kind in given.work:
        of_kind = [measure(kind, workers, given.views, given.scenes) for workers in given.workers]
        for row in of_kind:  # per task, as the first task of each worker does not count
            for name, of in (("speed_up", "seconds"), ("speed_up_cpu", "cpu_seconds_of_the_busiest")):
                row[name] = round((of_kind[0][of] / of_kind[0]["tasks"]) / (row[of] / row["tasks"]), 2)
            print(row, flush=True)
        rows += of_kind
    write_record(given.json, rows)


if __name__ == "__main__":
    main()
