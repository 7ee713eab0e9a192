"""The engine on Ray (``lexsplat[cluster]``): tasks with retries on a cluster or on the cores of this machine."""

from __future__ import annotations

import atexit
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from lexsplat.runtime.environment import code_identity, version_of_lexsplat, versions
from lexsplat.runtime.errors import WorkersError
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.ray_connection import OwnRay, connect
from lexsplat.runtime.ray_tasks import Answer, Tasks, no_node, options_of, run, slots, store_full
from lexsplat.runtime.ray_watch import ClusterLostError, HeadWatch
from lexsplat.runtime.workers import ANY_MACHINE, Needs, Outcome, R, S, SharedFolder, T, Workers

log = logging.getLogger("lexsplat")

_PROBE_SECONDS = 120.0
_RECONNECT = "RAY_gcs_rpc_server_reconnect_timeout_s"


@contextmanager
def ray_workers(address: str | None, paths: tuple[Path, ...] = ()) -> Iterator[Workers]:
    """Connect to Ray, check its nodes, and disconnect at the end.

    Args:
        address: "ray://HOST:PORT"; None for the cluster of ``RAY_ADDRESS``, or else a Ray on this machine.
        paths: Files and folders that every node must see.

    Raises:
        WorkersError: If Ray is not installed or not reached, or a node lacks lexsplat, has another version of it, or
            does not see a path.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use to its makers otherwise
    place = address or os.environ.get("RAY_ADDRESS") or "local"
    if place != "local":  # `HeadWatch` reports sooner that the head is gone, with the remedy
        os.environ.setdefault(_RECONNECT, "86400")
    try:
        import ray
    except ImportError as error:
        raise WorkersError(
            "--workers ray",
            expected="the package ray",
            found="none installed",
            remedy="pip install 'lexsplat[cluster]'",
        ) from error
    if place == "local":
        with OwnRay() as own:
            yield RayWorkers(HeadWatch(None), own)
        return
    connect(place)
    # From within a cluster Ray ends this process where the head is gone; in the other cases it raises.
    head = None if place.startswith("ray://") else ray.get_runtime_context().gcs_address
    watch, lost = HeadWatch(head), False
    try:
        with watch:
            log.log(NOTE, "workers: %s nodes, %s cores", _check_nodes(paths), slots(ANY_MACHINE))
            yield RayWorkers(watch)
    except ClusterLostError:
        lost = True
        raise
    finally:
        if lost or watch.lost:  # to disconnect from nothing would wait for it
            atexit.unregister(ray.shutdown)
        else:
            ray.shutdown()


class RayWorkers:
    """Tasks on the Ray to which this process is connected.

    Args:
        watch: Watches its head.
        own: The Ray of this process alone, if it is one. It is waited for at the first task, and its node, this
            machine, needs no check.
    """

    distributed = True

    def __init__(self, watch: HeadWatch, own: OwnRay | None = None) -> None:
        self._watch, self._own = watch, own
        self._running = 0

    @property
    def metrics(self) -> dict[str, float]:
        """See `Workers.metrics`."""
        return {"workers": float(self._running)}

    def see(self, folder: SharedFolder) -> bool:
        """See `Workers.see`."""
        if self._own is not None:
            return folder.is_visible
        import ray

        try:
            answers = _on_every_node(ray.remote(_sees), folder)
            return all(ray.get(list(answers.values()), timeout=_PROBE_SECONDS))
        except (ConnectionError, ray.exceptions.RayError) as error:
            raise ClusterLostError.by(error) from error

    def require(self, paths: tuple[Path, ...]) -> None:
        """See `Workers.require`."""
        if self._own is None:
            _check_nodes(paths)

    def map(
        self, work: Callable[[S, T], R], shared: S, items: Mapping[str, T], needs: Needs = ANY_MACHINE
    ) -> Iterator[Outcome]:
        """See `Workers.map`. Tasks are sent while slots are free, though an earlier one is still at work.

        Raises:
            WorkersError: If the cluster disappears, or even after a wait no node has what a task needs.
        """
        import ray

        if self._own is not None:
            self._own.wait()
        try:
            options = options_of(needs, len(items))
            task = ray.remote(run).options(**options)
            tasks = Tasks(task, work, ray.put(shared), items, replace(needs, gpu="num_gpus" in options))
            for outcome, messages in self._watch.guarded(self._outcomes(tasks)):
                for level, text in messages:
                    log.log(level, "%s: %s", outcome.name, text)
                yield outcome
        except (ConnectionError, ray.exceptions.RaySystemError) as error:
            raise ClusterLostError.by(error) from error
        except (ray.exceptions.ObjectStoreFullError, ray.exceptions.OutOfDiskError) as error:
            raise store_full(needs.result) from error

    def _outcomes(self, tasks: Tasks) -> Iterator[Answer]:
        """The answers of tasks in order; while one is waited for, others are sent and end."""
        while tasks.todo or tasks.sent:
            tasks.send()
            self._running = min(tasks.slots, len(tasks.running))
            name, reference = next(iter(tasks.sent.items()))
            if reference in tasks.running and not tasks.wait():
                self._watch.check()
                if self._watch.silent or not tasks.are_stranded():  # a silent head cannot count nodes
                    continue
                yield from tasks.take_ended()
                raise no_node(tasks.needs)
            if reference not in tasks.running:
                answer = tasks.take(name)
                if answer is not None:
                    yield answer


def _sees(folder: SharedFolder) -> bool:
    """Whether a node sees a folder. A worker calls it."""
    return folder.is_visible


def _check_nodes(paths: tuple[Path, ...]) -> int:
    """Run a probe on every node; returns their number."""
    import ray

    def probe(files: list[str]) -> tuple[str, str, list[str], dict[str, str]]:
        # Nested, so that it is sent by value: a node without lexsplat can run it too.
        from pathlib import Path

        try:
            from lexsplat.runtime.environment import code_identity, version_of_lexsplat, versions
        except ImportError:
            return "", "", [], {}
        missing = [file for file in files if not Path(file).exists()]
        return version_of_lexsplat(), code_identity(), missing, versions()

    answers = _on_every_node(ray.remote(probe), [str(path.resolve()) for path in paths if path.exists()])
    if not answers:
        raise WorkersError(
            "--workers", expected="nodes with CPUs", found="none", remedy="add nodes to the cluster"
        )
    for name, reference in answers.items():
        try:
            found, code, missing, packages = ray.get(reference, timeout=_PROBE_SECONDS)
        except ray.exceptions.RayError as error:
            remedy = "check the node with: ray status"
            raise WorkersError(
                f"node {name}", expected="an answer", found=type(error).__name__, remedy=remedy
            ) from error
        _check_probe(name, found, code, missing)
        _compare(name, packages)
    return len(answers)


def _on_every_node(task: Any, argument: Any) -> dict[str, Any]:
    """References to the answers of all nodes that can run tasks, by the name of the node."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy as OnNode

    return {
        node["NodeManagerHostname"] + "/" + node["NodeID"][:6]: task.options(
            num_cpus=0, scheduling_strategy=OnNode(node["NodeID"], soft=True)
        ).remote(argument)
        for node in ray.nodes()
        if node["Alive"] and node["Resources"].get("CPU")
    }


def _check_probe(node: str, found: str, code: str, missing: list[str]) -> None:
    own = version_of_lexsplat()
    if (found, code) != (own, code_identity()):
        other = f"{found} with other code" if found == own else found
        raise WorkersError(
            f"node {node}",
            expected=f"lexsplat {own}",
            found=other or "no lexsplat",
            remedy=f"install the same lexsplat on every node: pip install 'lexsplat[cluster]=={own}'",
        )
    if missing:
        raise WorkersError(
            f"node {node}",
            expected=f"the file system of this machine with {missing[0]}",
            found="no such file or folder",
            remedy="put capture and scene on a file system that every node mounts at the same path",
        )


def _compare(node: str, packages: dict[str, str]) -> None:
    """Warn of packages with other versions on a node, so that its results may have other bits."""
    own = versions()
    others = [
        f"{name} {packages.get(name, 'missing')} (here {own.get(name, 'missing')})"
        for name in ("python", "torch", "numpy", "numba")
        if packages.get(name) != own.get(name)
    ]
    if others:
        log.warning("node %s: other versions, so its bits may differ: %s", node, ", ".join(others))
