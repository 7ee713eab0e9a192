"""Maps over views, blocks or scenes: in this process, or on Ray with ``--workers``.

Results arrive in the order of the items, whichever worker finishes first. What is added up from them is therefore
added in one order, and any number of workers gives the same bits.
"""

from __future__ import annotations

import logging
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from lexsplat.runtime.errors import LexsplatError, TaskError, WorkersError

log = logging.getLogger("lexsplat")

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Needs:
    """Resources that one task needs.

    Args:
        memory: Host memory in bytes; 0 leaves it to the engine.
        libraries: The part of it that no budget makes smaller.
        gpu: Whether it computes on a GPU, of which it then gets one of its own.
        result: Size of its result in bytes, if it may be large.
    """

    memory: int = 0
    libraries: int = 0
    gpu: bool = False
    result: int = 0


ANY_MACHINE = Needs()


@dataclass(frozen=True)
class Outcome:
    """The end of one task.

    Args:
        name: Name of its item.
        result: Return value of the task; None if it failed.
        error: Why the task itself failed. A lost worker is not a failure: the task is repeated.
    """

    name: str
    result: Any = None
    error: LexsplatError | None = None


def attempt(work: Callable[[S, T], R], shared: S, name: str, item: T) -> Outcome:
    """Run one task; any exception is its outcome, except those that end the program."""
    try:
        return Outcome(name, work(shared, item))
    except LexsplatError as error:
        return Outcome(name, error=error)
    except Exception as error:
        return Outcome(name, error=_task_error(name, error))


def _task_error(name: str, error: Exception) -> TaskError:
    """The line of an error without a remedy of its own."""
    log.debug("task %s", name, exc_info=error)
    found, remedy = f"{type(error).__name__}: {error}", "fix this"
    if isinstance(error, OSError):  # such as a full disk
        found = f"{error.strerror or error}" + (f": {error.filename}" if error.filename else "")
    elif isinstance(error, MemoryError):
        found = "no memory left"
        remedy = "give a smaller --memory, a larger --downscale or a smaller --reconstruction.max-gaussians"
    remedy += " and run the same command again; finished work is kept"
    one_line = TaskError(name, expected="a result", found=found[:300], remedy=remedy)
    one_line.__cause__ = error
    return one_line


class Workers(Protocol):
    """An engine that runs tasks."""

    @property
    def distributed(self) -> bool:
        """Whether tasks run in other processes."""

    @property
    def metrics(self) -> dict[str, float]:
        """Values that progress events carry: the number of tasks that run at a time, as "workers"."""

    def see(self, folder: SharedFolder) -> bool:
        """Whether every worker sees a folder of this process."""

    def require(self, paths: tuple[Path, ...]) -> None:
        """Check that every worker sees files and folders of this process.

        Raises:
            WorkersError: If one does not, or cannot work.
        """

    def map(
        self, work: Callable[[S, T], R], shared: S, items: Mapping[str, T], needs: Needs = ANY_MACHINE
    ) -> Iterator[Outcome]:
        """Run ``work(shared, item)`` for every item.

        Args:
            work: A function of a module. It may run more than once for an item, so it writes files atomically.
            shared: Data that all tasks read, sent to each worker once.
            items: The inputs that differ between tasks, by name of the task. An item is looked up when its task
                begins, so that a mapping may load large ones then.
            needs: Resources that one task needs.

        Yields:
            The outcomes in the order of the items.
        """


class InProcess:
    """The engine without workers: one task after the other."""

    distributed = False

    @property
    def metrics(self) -> dict[str, float]:
        """See `Workers.metrics`."""
        return {}

    def see(self, folder: SharedFolder) -> bool:
        """See `Workers.see`."""
        return True

    def require(self, paths: tuple[Path, ...]) -> None:
        """See `Workers.require`."""

    def map(
        self, work: Callable[[S, T], R], shared: S, items: Mapping[str, T], needs: Needs = ANY_MACHINE
    ) -> Iterator[Outcome]:
        """See `Workers.map`."""
        for name, item in items.items():
            yield attempt(work, shared, name, item)


IN_PROCESS = InProcess()


def results(outcomes: Iterator[Outcome]) -> Iterator[Any]:
    """The results of the tasks that succeed; failures are raised once, after the last task.

    Raises:
        LexsplatError: The first failure. Further ones are counted and named in it.
    """
    failed: list[Outcome] = []
    for outcome in outcomes:
        if outcome.error is None:
            yield outcome.result
        else:
            failed.append(outcome)
    raise_failures(failed)


def raise_failures(failed: list[Outcome]) -> None:
    """Raise the first failure, with the names of the others; nothing if there is none."""
    errors = [(outcome.name, outcome.error) for outcome in failed if outcome.error is not None]
    if not errors:
        return
    first = errors[0][1]
    if len(errors) > 1:
        others = ", ".join(name for name, _ in errors[1:4]) + (", ..." if len(errors) > 4 else "")
        found = f"{first.found} (and {len(errors) - 1} more failed: {others})".strip()
        raise type(first)(first.subject, expected=first.expected, found=found, remedy=first.remedy) from first
    raise first


def open_workers(spec: str, paths: tuple[Path, ...] = ()) -> AbstractContextManager[Workers]:
    """The engine of ``--workers``.

    Args:
        spec: "none"; "ray" for the cluster of ``RAY_ADDRESS``, or else a Ray on this machine; an address
            "ray://HOST:PORT".
        paths: Files and folders that every worker must see.

    Raises:
        WorkersError: If Ray is not installed or cannot be reached, or a worker cannot do the work.
    """
    check_spec(spec)
    if spec == "none":
        return nullcontext(IN_PROCESS)
    from lexsplat.runtime.ray_workers import ray_workers

    return ray_workers(None if spec == "ray" else spec, paths)


def check_spec(spec: str) -> None:
    """Refuse a value of ``--workers`` that names no engine.

    Raises:
        ValueError: It is neither "none" nor "ray" nor an address.
    """
    host, colon, port = spec.removeprefix("ray://").rpartition(":")
    address = spec.startswith("ray://") and host and colon and port.isdigit()
    if spec not in ("none", "ray") and not address:
        raise ValueError(f"workers must be none, ray or ray://HOST:PORT, got {spec!r}")


@dataclass(frozen=True)
class SharedFolder:
    """A folder of results. Workers that see it write to it; for others, files travel with the tasks.

    Args:
        path: The folder, absolute.
        token: Content of the file by which a worker recognizes the folder.
    """

    path: Path
    token: str

    @classmethod
    @contextmanager
    def offered(cls, path: Path) -> Iterator[SharedFolder]:
        """Mark a folder so that workers recognize it; the mark is removed at the end."""
        folder = cls(path.resolve(), uuid.uuid4().hex)
        folder.path.mkdir(parents=True, exist_ok=True)
        folder._mark.write_text(folder.token, encoding="ascii")
        try:
            yield folder
        finally:
            folder._mark.unlink(missing_ok=True)

    @staticmethod
    def forget_marks(root: Path) -> None:
        """Remove the marks that killed commands left in ``root`` and its folders, which only this process uses."""
        for mark in (*root.glob(".workers-*"), *root.glob("*/.workers-*")):
            mark.unlink(missing_ok=True)

    @property
    def is_visible(self) -> bool:
        """Whether this process sees the folder itself, not one of the same name on another machine."""
        try:
            return self._mark.read_text(encoding="ascii") == self.token
        except OSError:
            return False

    def read(self, names: Iterable[str]) -> dict[str, bytes]:
        """The content of files, to be sent to a worker that does not see them."""
        return {name: (self.path / name).read_bytes() for name in names}

    @contextmanager
    def opened(self, files: Mapping[str, bytes] | None) -> Iterator[Path]:
        """The folder, for a worker.

        Args:
            files: Files from `read`, for workers that do not see the folder: they get one of their own with these
                files, for the time of the task. None means the folder itself.

        Raises:
            WorkersError: If this process does not see the folder and got no files.
        """
        if files is not None:
            with tempfile.TemporaryDirectory() as own:
                for name, content in files.items():
                    (Path(own) / name).write_bytes(content)
                yield Path(own)
            return
        if not self.is_visible:
            raise self.unseen()
        yield self.path

    def unseen(self) -> WorkersError:
        """The error where a worker must see the folder and does not."""
        return WorkersError(
            self.path,
            expected="a folder that every worker sees",
            found="no such folder on one of them",
            remedy="give an --output on a file system that every node mounts at the same path",
        )

    @property
    def _mark(self) -> Path:
        return self.path / f".workers-{self.token}"
