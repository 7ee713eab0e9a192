"""Progress of commands that are mostly quick."""

from __future__ import annotations

import atexit
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType
from typing import TYPE_CHECKING

from lexsplat.runtime.lazy import without_collection
from lexsplat.runtime.progress import Event, uncounted

if TYPE_CHECKING:
    from lexsplat.cli.progress import ProgressBars

_PATIENCE = 2.0


class LateProgress:
    """A listener that shows a stage if it is not finished after two seconds, and nothing before.

    A timer shows it even if the stage sends no event meanwhile. Stages may contain stages.

    Args:
        patience: Seconds without anything shown.
    """

    def __init__(self, patience: float = _PATIENCE) -> None:
        self._patience = patience
        self._lock = threading.RLock()
        self._starts: dict[str, float] = {}  # of unfinished stages, in the order in which they began
        self._latest: dict[str, Event] = {}
        self._timer: threading.Timer | None = None
        self._bars: ProgressBars | None = None
        self._shown: set[str] = set()  # unfinished stages that have a bar
        atexit.register(self._close)

    def __call__(self, event: Event) -> None:
        """Receive one event."""
        with self._lock:
            if event.done == 0:  # it starts anew
                self._starts.pop(event.stage, None)
                self._shown.discard(event.stage)
            now = time.monotonic()
            start, finished = self._starts.setdefault(event.stage, now), event.done >= event.total
            self._latest[event.stage] = event
            if self._bars is not None and event.stage in self._shown:
                self._bars(event)
            elif not finished and now - start >= self._patience:
                self._show()
            elif not finished and self._timer is None:
                self._wait()
            if finished:
                self._starts.pop(event.stage)
                self._shown.discard(event.stage)
                if not self._starts:
                    self._close()

    def _wait(self) -> None:
        """Look again after the time."""
        self._timer = threading.Timer(self._patience, self._look)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        with self._lock:
            self._timer = None
            self._show()
            if self._starts.keys() - self._shown:
                self._wait()

    def _show(self) -> None:
        """Show what is not finished after the time."""
        from lexsplat.cli.progress import ProgressBars

        with self._lock:
            now = time.monotonic()
            for stage, start in self._starts.items():
                if stage in self._shown or now - start < self._patience:
                    continue
                if self._bars is None:
                    self._bars = ProgressBars().__enter__()
                self._bars.add(self._latest[stage], start)
                self._shown.add(stage)

    def _close(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._bars is not None:
                self._bars.__exit__(None, None, None)
                self._bars = None
                self._shown.clear()


command: ContextVar[str] = ContextVar("command", default="")
"""Name of the command that runs; each imports other modules."""


@contextmanager
def starting() -> Iterator[None]:
    """Import in this block what a command needs; the time so far is shown after two seconds."""
    with uncounted(LateProgress(), "start", command.get()), loading():
        yield


@contextmanager
def loading() -> Iterator[None]:
    """Import modules in this block: no collector runs, and Ctrl-C ends the block whatever a module makes of it.

    Extension modules swallow an interruption while they load (torch, while it imports numpy), and what needs the half
    of a module then fails with any error.
    """
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        with without_collection():
            yield
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        with without_collection():
            yield
    except Exception:
        if not interrupted:
            raise
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted:
        raise KeyboardInterrupt
