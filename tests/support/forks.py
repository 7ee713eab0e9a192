"""Forks, some of which are killed after a while, for tests that nothing is lost."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

PROCESSES = multiprocessing.get_context("fork" if hasattr(os, "fork") else "spawn")
"""Another process; a fork, where there is one, has nothing to import."""


def outcome(child: int, seconds: float | None) -> str:
    """Wait for a fork, or kill it after so many seconds: "finished", "failed" or "killed"."""
    deadline = None if seconds is None else time.monotonic() + seconds
    while True:
        done, status = os.waitpid(child, os.WNOHANG if deadline else 0)
        if done:
            return "killed" if os.WIFSIGNALED(status) else "finished" if status == 0 else "failed"
        if deadline and time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            deadline = None
        time.sleep(0.001)
