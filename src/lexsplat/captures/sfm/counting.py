"""Counts the pairs of photos that pycolmap has matched, while it matches them; pycolmap itself reports nothing.

pycolmap writes each pair into its database, which others may read meanwhile. Python's own SQLite must not do so in
this process: two copies of SQLite in one process release each other's locks, and the process ends with a bus error.
Another process counts.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

_EVERY = 0.5
"""Seconds between two counts."""

_COUNTER = """
import contextlib, sqlite3, sys, time
while True:
    found = 0
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(sys.argv[1], uri=True)) as opened:
        found = opened.execute("SELECT COUNT(*) FROM matches").fetchone()[0]
    print(found, flush=True)  # fails when the other process has ended
    time.sleep(float(sys.argv[2]))
"""


@contextlib.contextmanager
def counted_pairs(database: Path, total: int, listener: Callable[[int, int], None]) -> Iterator[None]:
    """Report how many pairs are matched, from another thread, while the block runs.

    Args:
        database: pycolmap's database.
        total: Number of pairs that will be matched.
        listener: Receives the number of matched pairs and ``total``; at the end of the block ``total`` twice.
    """
    listener(0, total)
    with counts_of(database) as counts:
        before, ended = next(counts, 0), threading.Event()

        def watch() -> None:
            for found in counts:
                if ended.is_set():
                    return
                listener(min(max(0, found - before), max(0, total - 1)), total)

        thread = threading.Thread(target=watch, name="pairs matched", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
    listener(total, total)


@contextlib.contextmanager
def counts_of(database: Path) -> Iterator[Iterator[int]]:
    """The number of pairs in a database, again and again; none where no process can be started."""
    address = f"{database.resolve().as_uri()}?mode=ro"
    try:
        counter = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _COUNTER, address, str(_EVERY)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
    except OSError:
        yield iter(())
        return
    with counter:
        try:
            yield map(int, counter.stdout or ())
        finally:
            counter.kill()
