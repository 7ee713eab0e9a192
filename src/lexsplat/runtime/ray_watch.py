"""Whether the head node of a Ray cluster is still there. Ray ends this process without a word where it is not."""

from __future__ import annotations

import os
import socket
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


class ClusterLostError(WorkersError):
    """The cluster has disappeared."""

    @classmethod
    def by(cls, error: Exception | None = None) -> ClusterLostError:
        """The error to tell, of what Ray raised if it did."""
        return cls(
            "--workers",
            expected="the cluster",
            found="no node that answers" if error is None else f"no connection ({type(error).__name__})",
            remedy="finished work is kept; run the same command again when the cluster is back, or without --workers",
        )


class HeadWatch:
    """A thread that connects to the head node again and again, while the context is open.

    Args:
        address: "HOST:PORT" of the head; None watches nothing.
    """

    def __init__(self, address: str | None) -> None:
        self.lost = False
        self._address = address
        self._ended = threading.Event()
        self._entered: float | None = None  # when the call of Ray began that is under way

    def __enter__(self) -> HeadWatch:
        if self._address is not None:
            threading.Thread(target=self._watch, name="head of Ray", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

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
            if self._answers():
                answered = time.monotonic()
        self.lost, lost = True, time.monotonic()
        while not self._ended.wait(POLL_SECONDS / 4):
            entered = self._entered
            if entered is not None and time.monotonic() - max(entered, lost) > BLOCKED_SECONDS:
                print(f"error: {ClusterLostError.by()}", file=sys.stderr, flush=True)
                os._exit(1)

    def _answers(self) -> bool:
        host, _, port = str(self._address).rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=POLL_SECONDS).close()
        except OSError:
            return False
        return True
