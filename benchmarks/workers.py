"""Feature extraction on Ray workers of this machine, one thread each: seconds, processor seconds, overlap, overhead.

python benchmarks/workers.py --workers 1 2 4 --views 40

    start         seconds until Ray and its workers can take tasks: what a build on Ray adds before it begins
    seconds       from the start of the first task to the end of the last, without the first one of each worker, which
                  loads encoders
    cpu_seconds   processor time of these tasks, and of the busiest worker among them
    overlap       mean number of tasks under way
    speed_up      seconds of the first number of workers / seconds of this one
    speed_up_cpu  the same with the processor time of the busiest worker: that of a machine on which nothing else runs
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from records import argument_parser, write_record

from lexsplat.captures import load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.pipeline import distribution
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.ray_workers import RayWorkers
from lexsplat.runtime.workers import SharedFolder, results


def timed(shared: Any, view: Any) -> tuple[int, float, float, float]:
    """A worker, and when it started and ended the features of a view, and its processor time."""
    start, cpu = time.time(), time.process_time()
    distribution._extract_view(shared, view)
    return os.getpid(), start, time.time(), time.process_time() - cpu


def measure(workers: int, views: int) -> dict[str, float]:
    """One run with this many workers."""
    import ray

    capture = load_capture(demo_capture())
    chosen = dict(list(capture.views.items())[:views])
    config = BuildConfig(clip="bundled", dino="bundled", device="cpu", encoder_device="cpu")
    began = time.time()
    ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        list(results(RayWorkers().map(nothing, None, {str(i): i for i in range(workers)})))
        start = time.time() - began
        with tempfile.TemporaryDirectory() as folder, SharedFolder.offered(Path(folder)) as cache:
            shared = distribution._Extraction(distribution._views_only(capture), config, cache)
            found = list(results(RayWorkers().map(timed, shared, chosen)))
    finally:
        ray.shutdown()
    return {"workers": workers, "start": round(start, 1), **summary(found)}


def nothing(shared: None, item: int) -> int:
    """A task that takes no time."""
    return item


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
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--views", type=int, default=40)
    given = parser.parse_args()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    rows = [measure(workers, given.views) for workers in given.workers]
    for row in rows:  # per task, as the first task of each worker does not count
        for name, of in (("speed_up", "seconds"), ("speed_up_cpu", "cpu_seconds_of_the_busiest")):
            row[name] = round((rows[0][of] / rows[0]["tasks"]) / (row[of] / row["tasks"]), 2)
        print(row, flush=True)
    write_record(given.json, rows)


if __name__ == "__main__":
    main()
