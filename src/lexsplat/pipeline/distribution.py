"""Features of views and whole scenes on workers (`lexsplat.runtime.workers`)."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lexsplat.captures import Capture, View
from lexsplat.features import extract_features
from lexsplat.features.extraction import missing_views
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders
from lexsplat.pipeline.provenance import with_full_paths
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.workers import Needs, Outcome, SharedFolder, Workers, raise_failures

LIBRARIES_BYTES = 1536 << 20
"""Host memory of a worker beside its budget: the interpreter, the libraries and an encoder of usual size."""


@dataclass(frozen=True)
class _Extraction:
    """What the tasks of all views read: the capture without its points, settings, and where features are stored."""

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
                with atomic_path(cache.path / name) as temporary:
                    temporary.write_bytes(content)
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
        memory = parse_bytes(config.memory)
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
    """A capture without views and points: what workers need of it beside the view of their task."""
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
    """What all scenes share: the output folder and the listener of progress events."""

    folder: SharedFolder
    listener: Listener


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
        workers: Where they run.
        listener: Receives an event of stage "scenes" after every scene; in this process, those of its stages too.

    Yields:
        The outcomes in the order of the tasks.

    Raises:
        WorkersError: If a worker does not see the output.
    """
    memory = max((parse_bytes(task.config.memory) for task in tasks.values()), default=0)
    needs = Needs(memory=memory + LIBRARIES_BYTES, gpu=any(t.config.device != "cpu" for t in tasks.values()))
    with SharedFolder.offered(output) as folder:
        if not workers.see(folder):
            raise folder.unseen()
        listener(Event("scenes", 0, len(tasks)))
        shared = _Scenes(folder, silent if workers.distributed else listener)
        for done, outcome in enumerate(workers.map(_build_scene, shared, tasks, needs), start=1):
            yield outcome
            listener(Event("scenes", done, len(tasks), workers.metrics))


def _build_scene(shared: _Scenes, task: SceneTask) -> list[str]:
    """Build a scene; returns the names of its stages."""
    from lexsplat.pipeline.build import build

    with shared.folder.opened(None):
        built = build(task.source, task.output, task.config, until=task.until, listener=shared.listener)
    return list(built.record["stages"])
