"""Features of views and whole scenes on workers (`lexsplat.runtime.workers`)."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from lexsplat.captures import Capture, View
from lexsplat.features import extract_features
from lexsplat.features.extraction import missing_views
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders
from lexsplat.pipeline.provenance import with_full_paths
from lexsplat.pipeline.scene_progress import LastEvent, named, named_messages, relayed
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import write_file
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.workers import Needs, Outcome, SharedFolder, Workers, raise_failures

LIBRARIES_BYTES = 1536 << 20
"""Host memory of a worker in addition to its budget: the interpreter, the libraries and an encoder of usual size."""


@dataclass(frozen=True)
class _Extraction:
    """Inputs of all extraction tasks: the capture without its points, settings, and the store of features."""

    capture: Capture
    config: BuildConfig
    cache: SharedFolder


def extract_on_workers(
    capture: Capture,
    config: BuildConfig,
    encoders: Encoders,
    cache_dir: Path,
    workers: Workers,
    listener: Listener = silent,
) -> None:
    """Store the features of every view that the cache lacks; each view is a task.

    A view is encoded alone on one thread, so its bits depend neither on the workers nor on the other views. Workers
    write into the cache where they see it and return the files where they do not.

    Raises:
        LexsplatError: If views fail; the features of all others are stored before.
    """
    clip, dino = encoders.clip, encoders.dino
    missing = missing_views(capture, clip, dino, config.features, cache_dir)
    done = len(capture.views) - sum(map(len, missing.values()))
    with SharedFolder.offered(cache_dir) as cache:
        views = {name: capture.views[name] for name in missing}
        shared = _Extraction(_views_only(capture), config, cache)
        needs = Needs(gpu=config.encoder_device == "cuda")
        failed: list[Outcome] = []
        for outcome in workers.map(_extract_view, shared, views, needs):
            if outcome.error is not None:
                failed.append(outcome)
                continue
            for name, content in outcome.result.items():
                write_file(cache.path / name, content)
            done += len(missing[outcome.name])
            listener(Event("features", done, len(capture.views), workers.metrics))
    raise_failures(failed)


def _extract_view(shared: _Extraction, view: View) -> dict[str, bytes]:
    """Extract the features of a view; returns its files by name if this process does not see the cache."""
    config = shared.config
    if not view.image_path.exists():
        raise CaptureError(
            view.image_path,
            expected="a photo that every worker sees",
            found="no such file on one of them",
            remedy="put the capture on a file system that every node mounts at the same path",
        )
    encoders = _encoders(config.clip, config.dino if config.uses_dino else "none", config.encoder_device)
    capture = replace(shared.capture, views={view.name: view}, train_names=(view.name,), test_names=())

    def extract(folder: Path) -> None:
        memory = config.memory_bytes
        extract_features(
            capture, encoders.clip, encoders.dino, config.features, cache_dir=folder, memory=memory
        )

    visible = shared.cache.is_visible
    with shared.cache.opened(None if visible else {}) as folder:
        extract(folder)
        return {} if visible else {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


@functools.lru_cache(maxsize=1)
def _encoders(clip: str, dino: str, device: str) -> Encoders:
    """The encoders of a worker, which stay loaded between tasks."""
    return Encoders(clip, dino, device)


def _views_only(capture: Capture) -> Capture:
    """The capture without views and points. Workers need no more, since the view comes with the task."""
    none = capture.points[:0]
    return replace(capture, views={}, train_names=(), test_names=(), points=none, point_colors=none)


@dataclass(frozen=True)
class SceneTask:
    """A scene to build.

    Args:
        source: The capture.
        output: The scene folder.
        config: Settings; the workers of the scenes are not among them.
        until: Last stage to run.
    """

    source: Path
    output: Path
    config: BuildConfig
    until: str = "language"


@dataclass(frozen=True)
class _Scenes:
    """Inputs shared by all scenes: the output folder, and in this process the listener of progress events."""

    folder: SharedFolder
    listener: Listener | None


def scene_tasks(
    sources: Mapping[Path, BuildConfig], output: Path, until: str = "language"
) -> dict[str, SceneTask]:
    """A scene for every capture, in a folder of the capture's name below ``output``.

    Raises:
        CaptureError: If two captures have one name.
    """
    tasks: dict[str, SceneTask] = {}
    for source, config in sources.items():
        name = source.resolve().name
        if name in tasks:
            raise CaptureError(
                source,
                expected="captures of different names",
                found=f"the name of {tasks[name].source}",
                remedy="rename one: the scenes are written below --output by these names",
            )
        own = replace(with_full_paths(config), workers="none")
        tasks[name] = SceneTask(source.resolve(), output.resolve() / name, own, until)
    return tasks


def build_scenes(
    tasks: Mapping[str, SceneTask], output: Path, workers: Workers, listener: Listener = silent
) -> Iterator[Outcome]:
    """Build scenes, each a task; finished ones are kept, and a scene that fails does not stop the others.

    Args:
        tasks: From `scene_tasks`.
        output: Folder of all scenes, which every worker must see.
        workers: Workers that run the tasks.
        listener: Receives an event of stage "scenes" after every scene, and one of stage "finished" or "failed" with
            its name. Of scenes under way it receives the events of their stages: in this process all, of workers the
            last one of every second.

    Yields:
        The outcomes in the order of the tasks.

    Raises:
        WorkersError: If a worker does not see the output.
    """
    memory = max((task.config.memory_bytes for task in tasks.values()), default=0)
    on_gpu = any(task.config.device != "cpu" for task in tasks.values())
    needs = Needs(memory=memory + LIBRARIES_BYTES, libraries=LIBRARIES_BYTES, gpu=on_gpu)
    with SharedFolder.offered(output) as folder:
        if not workers.see(folder):
            raise folder.unseen()
        lock, failed = threading.Lock(), 0

        def send(event: Event) -> None:
            with lock:  # events of workers come from another thread
                listener(event)

        send(Event("scenes", 0, len(tasks)))
        shared = _Scenes(folder, None if workers.distributed else send)
        with relayed(folder.path, tasks, send) as forget:
            for done, outcome in enumerate(workers.map(_build_scene, shared, tasks, needs), start=1):
                forget(outcome.name)
                failed += outcome.error is not None
                send(Event("finished" if outcome.error is None else "failed", 1, 1, scene=outcome.name))
                yield outcome
                metrics = workers.metrics | ({"failed": failed} if failed else {})
                send(Event("scenes", done, len(tasks), metrics))


def _build_scene(shared: _Scenes, task: SceneTask) -> list[str]:
    """Build a scene; returns the names of its stages."""
    from lexsplat.pipeline.build import build

    name, here = task.output.name, shared.listener
    with shared.folder.opened(None) as folder, nullcontext() if here is None else named_messages(name):
        listener = LastEvent(folder, name) if here is None else named(name, here)
        built = build(task.source, task.output, task.config, until=task.until, listener=listener)
    return list(built.record["stages"])
