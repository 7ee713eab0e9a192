"""Whether the head node of a Ray cluster is still there.

Where it is not, Ray ends this process from within its own code: at once if the node of this machine is gone, else a
minute later. A thread asks more often. Where Ray is faster, a process that waits for the end of this one prints the
reason.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import TypeVar

from lexsplat.runtime.errors import WorkersError

T = TypeVar("T")

POLL_SECONDS = 2.0
GRACE_SECONDS = 20.0
"""Seconds without an answer, after which the cluster counts as gone; Ray itself would end this process at 60."""
BLOCKED_SECONDS = 15.0
"""Seconds for which a call of Ray may go on after that."""
WITNESS_SECONDS = 20
"""Seconds after the end of a process in which the head may go, so that the end counts as Ray's."""


class ClusterLostError(WorkersError):
    """The cluster has disappeared."""

    crashes_at_exit = True  # in threads of Ray that still look for it

    @classmethod
    def by(cls, error: Exception | None = None) -> ClusterLostError:
        """The error to raise, made from Ray's error if there is one."""
        return cls(
            "--workers",
            expected="the cluster",
            found="no node that answers" if error is None else f"no connection ({type(error).__name__})",
            remedy="finished work is kept; run the same command again when the cluster is back, or without --workers",
        )


_WITNESS = """
import socket, sys, time
host, port, seconds, line = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
for _ in range(0 if sys.stdin.read() else seconds):
    try:
        socket.create_connection((host, port), timeout=2).close()
    except OSError:
        sys.exit(line)
    time.sleep(1)
"""
"""Program that reads until this process ends. If nothing was written and the head is gone, it prints the line."""


class HeadWatch:
    """A thread that repeatedly connects to the head node while the context is open.

    Args:
        address: "HOST:PORT" of the head; None watches nothing.

    Attributes:
        silent: Whether the head has not answered the last time.
        lost: Whether it has not answered for `GRACE_SECONDS`.
    """

    def __init__(self, address: str | None) -> None:
        self.lost = False
        self.silent = False
        self._host, _, self._port = (address or "").replace("[", "").replace("]", "").rpartition(":")
        self._witness: subprocess.Popen[str] | None = None
        self._ended = threading.Event()
        self._entered: float | None = None  # when the call of Ray began that is under way

    def __enter__(self) -> HeadWatch:
        if self._port:
            line = f"error: {ClusterLostError.by()}"
            facts = self._host, self._port, str(WITNESS_SECONDS), line
            command = [sys.executable, "-I", "-S", "-c", _WITNESS, *facts]
            self._witness = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True, text=True
            )
            threading.Thread(target=self._watch, name="head of Ray", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._witness is not None:
            self._witness.communicate("an orderly end")

    def check(self) -> None:
        """Raise `ClusterLostError` if the head is gone."""
        if self.lost:
            raise ClusterLostError.by()

    def guarded(self, items: Iterator[T]) -> Iterator[T]:
        """Items that calls of Ray make. Where such a call hangs although the head is gone, the program ends."""
        while True:
            self.check()
            self._entered = time.monotonic()
            try:
                item = next(items)
            except StopIteration:
                return
            finally:
                self._entered = None
            yield item

    def _watch(self) -> None:
        answered = time.monotonic()
        while time.monotonic() - answered < GRACE_SECONDS:
            if self._ended.wait(POLL_SECONDS):
                return
            self.silent = not self._answers()
            if not self.silent:
                answered = time.monotonic()
        self.lost, lost = True, time.monotonic()
        while not self._ended.wait(POLL_SECONDS / 4):
            entered = self._entered
            if entered is not None and time.monotonic() - max(entered, lost) > BLOCKED_SECONDS:
                os._exit(1)  # the witness prints the reason

    def _answers(self) -> bool:
        try:
            socket.create_connection((self._host, int(self._port)), timeout=POLL_SECONDS).close()
        except OSError:
            return False
        return True
