"""Tasks on Ray: their resources, the number sent at a time, and their outcomes."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from lexsplat.runtime.errors import WorkersError
from lexsplat.runtime.memory import size_text
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.ray_watch import ClusterLostError
from lexsplat.runtime.workers import Needs, Outcome, attempt

log = logging.getLogger("lexsplat")

RETRIES = 20
"""Times that a task is done again after its worker or node was lost."""

_WAIT_SECONDS = 5.0
_NODES_SECONDS = 30.0
_WITHOUT_NODES_SECONDS = 60.0
"""Seconds without a node that can hold a task, after which no more is waited for one."""
_LEAST_MEMORY = 64 << 20
"""Smallest budget worth a try."""
_HELD = 16
"""Results a slot that may wait for an earlier one, where the size of a result is not known."""

Answer = tuple[Outcome, list[tuple[int, str]]]
"""An outcome, and the notes and warnings of its task: levels and texts."""


def slots(needs: Needs) -> int:
    """Number of tasks with these needs that the nodes of the cluster can run at a time."""
    found = 0.0
    for node in _nodes():
        fits = node.get("CPU", 0.0)
        if needs.gpu:
            fits = min(fits, node.get("GPU", 0.0))
        if needs.memory:
            fits = min(fits, node.get("memory", 0.0) // needs.memory)
        found += int(fits)
    return int(found)


def _nodes() -> list[dict[str, float]]:
    """The resources of every live node."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


class Tasks:
    """The tasks of one map: those to send, and in order those that were sent.

    Args:
        task: The remote function.
        work: Function that the tasks run.
        everyone: Reference to what all tasks read.
        items: The items by name.
        needs: Resources that one task needs.
    """

    def __init__(
        self, task: Any, work: Callable[..., Any], everyone: Any, items: Mapping[str, Any], needs: Needs
    ) -> None:
        self._task, self._work, self._everyone, self._items = task, work, everyone, items
        self.needs = needs
        self.todo = deque(items)
        self.sent: dict[str, Any] = {}
        self.running: set[Any] = set()
        self.slots = 0
        self._counted = -_NODES_SECONDS  # when nodes were counted
        self._held = time.monotonic()  # when one could last hold a task

    def send(self) -> None:
        """Send tasks while there are slots, and room for results that wait for an earlier one."""
        if time.monotonic() - self._counted > _NODES_SECONDS:  # nodes may have come
            self._count()
        free = max(1, self.slots)
        most = max(2 * free, _store() // self.needs.result) if self.needs.result else _HELD * free
        while self.todo and len(self.running) < 2 * free and len(self.sent) < most:
            name = self.todo.popleft()
            reference = self._task.remote(self._work, self._everyone, name, self._items[name])
            self.sent[name] = reference
            self.running.add(reference)

    def wait(self) -> bool:
        """Wait a little; returns whether a task has ended."""
        import ray

        ended, _ = ray.wait(list(self.running), timeout=_WAIT_SECONDS, fetch_local=False)
        self.running.difference_update(ended)
        return bool(ended)

    def take(self, name: str) -> Answer | None:
        """The answer of a task that has ended; None if it is repeated because its result was lost."""
        import ray

        reference = self.sent[name]
        try:
            answer = ray.get(reference, timeout=_WAIT_SECONDS)
        except ray.exceptions.GetTimeoutError:
            self.running.add(reference)
            return None
        except ray.exceptions.RayError as error:
            answer = _failed(name, error), []
        del self.sent[name]
        return answer

    def take_ended(self) -> Iterator[Answer]:
        """The answers of all tasks that have ended, whatever comes before them."""
        for name in [name for name, sent in self.sent.items() if sent not in self.running]:
            answer = self.take(name)
            if answer is not None:
                yield answer

    def are_stranded(self) -> bool:
        """Whether no node has been able to hold a task for a while."""
        self._count()
        return time.monotonic() - self._held > _WITHOUT_NODES_SECONDS

    def _count(self) -> None:
        before, self.slots, self._counted = self.slots, slots(self.needs), time.monotonic()
        if self.slots or before:
            self._held = self._counted


def run(work: Callable[[Any, Any], Any], shared: Any, name: str, item: Any) -> Answer:
    """Run a task on one thread, so that its bits do not depend on the node. A worker calls it."""
    import torch

    torch.set_num_threads(1)
    with _messages() as messages:
        return attempt(work, shared, name, item), messages


@contextmanager
def _messages() -> Iterator[list[tuple[int, str]]]:
    """Notes and warnings that are logged inside the block."""
    messages: list[tuple[int, str]] = []
    handler = logging.Handler(NOTE)
    handler.emit = lambda record: messages.append((record.levelno, record.getMessage()))  # type: ignore[method-assign]
    log.setLevel(NOTE)
    log.addHandler(handler)
    try:
        yield messages
    finally:
        log.removeHandler(handler)


def _failed(name: str, error: Exception) -> Outcome:
    """The outcome of a task that gave no answer."""
    import ray

    if isinstance(error, ray.exceptions.RayTaskError):
        cause = error.cause
        if isinstance(cause, (ray.exceptions.ObjectStoreFullError, ray.exceptions.OutOfDiskError)):
            raise cause from error
        found = str(error).strip().splitlines()[-1][:200]
        if not isinstance(error, ray.exceptions.RaySystemError):
            return Outcome(name, error=WorkersError(name, expected="a result", found=found))
        remedy = "install the same packages on every node"  # the task could not be read there
        raise WorkersError(name, expected="a result", found=found, remedy=remedy) from error
    lost = (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
        ray.exceptions.ObjectLostError,
    )
    if not isinstance(error, lost):
        raise error
    found = f"its worker died {RETRIES + 1} times ({type(error).__name__})"
    remedy = "give the workers more memory, or run without --workers to see why"
    return Outcome(name, error=WorkersError(name, expected="a result", found=found, remedy=remedy))


def options_of(needs: Needs, tasks: int) -> dict[str, Any]:
    """Options of Ray for tasks with these needs; checks that a node, and the object stores, can meet them."""
    nodes = _nodes()
    options: dict[str, Any] = {"num_cpus": 1, "max_retries": RETRIES}
    if needs.gpu and any(node.get("GPU") for node in nodes):
        options["num_gpus"] = 1
    if needs.memory:
        if needs.memory > _most_memory():
            raise no_node(needs)
        options["memory"] = needs.memory
    cores = int(sum(node.get("CPU", 0) for node in nodes))
    together = min(tasks, 2 * max(1, cores))
    if needs.result * together > _store():
        raise store_full(needs.result, together, _store())
    return options


def _most_memory() -> int:
    """Memory of the largest node that can compute."""
    return int(max((node.get("memory", 0) for node in _nodes() if node.get("CPU")), default=0))


def _store() -> int:
    """Size of all object stores."""
    return int(sum(node.get("object_store_memory", 0) for node in _nodes()))


def no_node(needs: Needs) -> WorkersError:
    """The error where no node can hold a task."""
    most = _most_memory()
    if needs.memory <= most:
        return ClusterLostError.by()
    room = (most - needs.libraries) // 2  # Ray counts what other programs take as free
    smaller = f"use --memory {size_text(room)}, or " if room >= _LEAST_MEMORY else ""
    return WorkersError(
        "--workers",
        expected=f"a node with {size_text(needs.memory, up=True)} of memory for a task",
        found=f"at most {size_text(most)}",
        remedy=f"{smaller}use larger nodes; finished work is kept",
    )


def store_full(result: int, together: int = 1, store: int | None = None) -> WorkersError:
    """The error where the object stores do not hold the results of the tasks that are under way together."""
    wanted = "room for the results"
    if result:
        wanted = f"room for {together} results of {size_text(result, up=True)}"
    return WorkersError(
        "object store of Ray",
        expected=wanted,
        found="a full one" if store is None else size_text(store),
        remedy="start the nodes with a larger --object-store-memory, or run without --workers",
    )
