"""The engine on Ray (``lexsplat[cluster]``): tasks with retries on a cluster or on the cores of this machine."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lexsplat.runtime.environment import code_identity, version_of_lexsplat
from lexsplat.runtime.errors import LexsplatError, WorkersError
from lexsplat.runtime.memory import size_text
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.workers import ANY_MACHINE, Needs, Outcome, R, S, SharedFolder, T, Workers

log = logging.getLogger("lexsplat")

RETRIES = 20
"""Times that a task is done again after its worker or node was lost."""

_PROBE_SECONDS = 120.0
_TOKEN = "; if the cluster was started with a token, set RAY_AUTH_MODE=token and copy ~/.ray/auth_token from its head"
_WAIT_SECONDS = 5.0
_HEAD_TRIES = 4
_CORES_SECONDS = 30.0
_WITHOUT_NODES_SECONDS = 60.0
"""Seconds without a node that can compute, after which the cluster counts as gone."""


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
    try:
        import ray
    except ImportError as error:
        raise WorkersError(
            "--workers ray",
            expected="the package ray",
            found="none installed",
            remedy="pip install 'lexsplat[cluster]'",
        ) from error
    place = address or os.environ.get("RAY_ADDRESS") or "local"
    host, _, port = place.removeprefix("ray://").rpartition(":")
    answers = False
    if host and port.isdigit():  # Ray tries for a minute where nothing listens
        try:
            socket.create_connection((host, int(port)), timeout=_WAIT_SECONDS).close()
        except OSError as error:
            raise _unreachable(place, error) from error
        answers = True
    try:
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        own: dict[str, Any] = {"include_dashboard": False} if place == "local" else {}
        ray.init(address=place, **quiet, **own)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError, OSError) as error:
        raise _unreachable(place, error, answers=answers) from error
    lost = False
    try:
        log.log(NOTE, "workers: %s nodes, %s cores", _check_nodes(paths), _cores())
        yield RayWorkers()
    except ClusterLostError:
        lost = True  # to disconnect from nothing would wait until Ray ends this process
        raise
    finally:
        if not lost:
            ray.shutdown()


class ClusterLostError(WorkersError):
    """The cluster has disappeared."""


class RayWorkers:
    """Tasks on the Ray to which this process is connected."""

    distributed = True

    def __init__(self) -> None:
        self._running = 0

    @property
    def metrics(self) -> dict[str, float]:
        """See `Workers.metrics`."""
        return {"workers": float(self._running)}

    def see(self, folder: SharedFolder) -> bool:
        """See `Workers.see`."""
        import ray

        try:
            answers = _on_every_node(ray.remote(_sees), folder)
            return all(ray.get(list(answers.values()), timeout=_PROBE_SECONDS))
        except (ConnectionError, ray.exceptions.RayError) as error:
            raise _gone(error) from error

    def require(self, paths: tuple[Path, ...]) -> None:
        """See `Workers.require`."""
        _check_nodes(paths)

    def map(
        self, work: Callable[[S, T], R], shared: S, items: Mapping[str, T], needs: Needs = ANY_MACHINE
    ) -> Iterator[Outcome]:
        """See `Workers.map`. At most two tasks a core are under way, which bounds the results that wait.

        Raises:
            WorkersError: If the cluster disappears, or no node has what a task needs.
        """
        import ray

        try:
            options = _options(needs, len(items))
            task = ray.remote(_run).options(**options)
            everyone = ray.put(shared)
            todo, running = deque(items), deque[tuple[str, Any]]()
            cores, asked = _cores(), time.monotonic()
            while todo or running:
                if time.monotonic() - asked > _CORES_SECONDS and _head_answers():  # nodes may have come
                    cores, asked = _cores(), time.monotonic()
                while todo and len(running) < 2 * cores:
                    name = todo.popleft()
                    running.append((name, task.remote(work, everyone, items[name])))
                self._running = min(cores, len(running))
                name, reference = running.popleft()
                yield _outcome(name, reference)
        except (ConnectionError, ray.exceptions.RaySystemError) as error:
            raise _gone(error) from error
        except (ray.exceptions.ObjectStoreFullError, ray.exceptions.OutOfDiskError) as error:
            raise _store_full(needs.result) from error


def _sees(folder: SharedFolder) -> bool:
    """Whether a node sees a folder. A worker calls it."""
    return folder.is_visible


def _cores() -> int:
    import ray

    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def _run(work: Callable[[Any, Any], Any], shared: Any, item: Any) -> Any:
    """Run a task on one thread, so that its bits do not depend on the node. A worker calls it."""
    import torch

    torch.set_num_threads(1)
    return work(shared, item)


def _outcome(name: str, reference: Any) -> Outcome:
    """Wait for one task."""
    import ray

    _wait(reference)
    try:
        return Outcome(name, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, LexsplatError):
            return Outcome(name, error=cause)
        if isinstance(cause, (ray.exceptions.ObjectStoreFullError, ray.exceptions.OutOfDiskError)):
            raise cause from error
        if isinstance(error, ray.exceptions.RaySystemError):  # the task could not be read there
            found = str(error).strip().splitlines()[-1][:200]
            remedy = "install the same packages on every node"
            raise WorkersError(name, expected="a result", found=found, remedy=remedy) from error
        raise
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
        ray.exceptions.ObjectLostError,
    ) as error:
        found = f"its worker died {RETRIES + 1} times ({type(error).__name__})"
        remedy = "give the workers more memory, or run without --workers to see why"
        return Outcome(name, error=WorkersError(name, expected="a result", found=found, remedy=remedy))


def _wait(reference: Any) -> None:
    """Wait until a task has ended, as long as there are nodes."""
    import ray

    alone_since = None
    while not ray.wait([reference], timeout=_WAIT_SECONDS, fetch_local=False)[0]:
        if not _head_answers():
            raise _gone(None)
        if any(node["Alive"] and node["Resources"].get("CPU") for node in ray.nodes()):
            alone_since = None
            continue
        alone_since = alone_since or time.monotonic()
        if time.monotonic() - alone_since > _WITHOUT_NODES_SECONDS:
            raise _gone(None)


def _head_answers() -> bool:
    """Whether the head node can be connected to. Ray would end this process a minute after it cannot."""
    import ray

    if ray.util.client.ray.is_connected():  # "ray://": the connection itself reports its end
        return True
    host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
    for _ in range(_HEAD_TRIES):
        try:
            socket.create_connection((host, int(port)), timeout=_WAIT_SECONDS).close()
            return True
        except OSError:
            time.sleep(_WAIT_SECONDS)
    return False


def _options(needs: Needs, tasks: int) -> dict[str, Any]:
    """Options of Ray for tasks with these needs; checks that a node, and the object stores, can meet them."""
    import ray

    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    options: dict[str, Any] = {"num_cpus": 1, "max_retries": RETRIES}
    if needs.gpu and any(node.get("GPU") for node in nodes):
        options["num_gpus"] = 1
    if needs.memory:
        most = int(max((node.get("memory", 0) for node in nodes), default=0))
        if needs.memory > most:
            raise WorkersError(
                "--workers",
                expected=f"a node with {size_text(needs.memory, up=True)} of memory for a task",
                found=f"at most {size_text(most)}",
                remedy=f"use --memory {size_text(max(1 << 20, most // 2))}, or larger nodes",
            )
        options["memory"] = needs.memory
    cores = int(sum(node.get("CPU", 0) for node in nodes))
    store = int(sum(node.get("object_store_memory", 0) for node in nodes))
    if needs.result * min(tasks, 2 * max(1, cores)) > store:
        raise _store_full(needs.result, store)
    return options


def _check_nodes(paths: tuple[Path, ...]) -> int:
    """Run a probe on every node; returns their number.

    Raises:
        WorkersError: If a node cannot do the work.
    """
    import ray

    def probe(files: list[str]) -> tuple[str, str, list[str]]:
        # Nested, so that it is sent by value: a node without lexsplat can run it too.
        from pathlib import Path

        try:
            from lexsplat.runtime.environment import code_identity, version_of_lexsplat
        except ImportError:
            return "", "", []
        return version_of_lexsplat(), code_identity(), [file for file in files if not Path(file).exists()]

    answers = _on_every_node(ray.remote(probe), [str(path.resolve()) for path in paths if path.exists()])
    if not answers:
        raise WorkersError(
            "--workers", expected="nodes with CPUs", found="none", remedy="add nodes to the cluster"
        )
    for name, reference in answers.items():
        try:
            found, code, missing = ray.get(reference, timeout=_PROBE_SECONDS)
        except ray.exceptions.RayError as error:
            remedy = "check the node with: ray status"
            raise WorkersError(
                f"node {name}", expected="an answer", found=type(error).__name__, remedy=remedy
            ) from error
        _check_probe(name, found, code, missing)
    return len(answers)


def _on_every_node(task: Any, argument: Any) -> dict[str, Any]:
    """References to the answers of all nodes that can compute, by the name of the node."""
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


def _unreachable(place: str, error: Exception, *, answers: bool = False) -> WorkersError:
    """The error to raise; ``answers`` if something listens at the address, so that a token may be missing."""
    reason = " ".join(str(error).split())[:200]
    if "ersion mismatch" in reason:
        remedy = "use the same versions of Ray and Python on every machine"
        return WorkersError(f"Ray at {place}", expected="the same version", found=reason, remedy=remedy)
    if "ray[client]" in reason:
        remedy = "pip install 'lexsplat[cluster]'"
        return WorkersError(place, expected="the client of Ray", found="no package grpcio", remedy=remedy)
    return WorkersError(
        f"Ray at {place}",
        expected="a running cluster",
        found=reason or type(error).__name__,
        remedy="check the address and: ray status" + (_TOKEN if answers else ""),
    )


def _gone(error: Exception | None) -> ClusterLostError:
    return ClusterLostError(
        "--workers",
        expected="the cluster",
        found="no node that answers" if error is None else f"no connection ({type(error).__name__})",
        remedy="finished work is kept; run the same command again when the cluster is back, or without --workers",
    )


def _store_full(result: int, store: int | None = None) -> WorkersError:
    wanted = f"room for results of {size_text(result, up=True)} a task" if result else "room for the results"
    return WorkersError(
        "object store of Ray",
        expected=wanted,
        found="a full one" if store is None else size_text(store),
        remedy="start the nodes with a larger --object-store-memory, or run without --workers",
    )
