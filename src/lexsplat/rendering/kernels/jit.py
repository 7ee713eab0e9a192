"""Compilation of the kernels, with a cache on disk, and their execution on several threads.

A kernel releases the GIL and runs on the thread pool of this module instead of Numba's ``prange``. It compiles
several times faster that way and needs no threading layer, which fails after a fork and with concurrent callers.
Several Python threads can render at once.
"""

from __future__ import annotations

import functools
import itertools
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.core import event, registry

from lexsplat.runtime.device import kernel_threads
from lexsplat.runtime.fingerprints import digest
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.user_cache import user_cache

logger = logging.getLogger("lexsplat")

_dispatchers: set[Any] = set()
_announced = False


def kernel(function: Callable[..., Any], *, inlined: bool = False) -> Callable[..., Any]:
    """Compile a function that releases the GIL, with a cache on disk.

    Fast-math stays off: it leaves comparisons with NaN undefined, and comparisons decide where memory is written.

    Args:
        function: The function to compile.
        inlined: Whether it becomes part of its callers. A call passes seven values for each array.
    """
    # Numba reads the folder from its global settings when it creates the cache; the settings are restored afterwards.
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    numba.config.CACHE_DIR = _cache_folder()  # type: ignore[attr-defined]
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=inlined)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]
    _dispatchers.add(dispatcher)
    return dispatcher


@functools.cache
def _cache_folder() -> str:
    """Folder of the compiled kernels for exactly these sources and this version of Numba.

    Numba checks only the file of the compiled function, so its cache would keep kernels whose callees in other files
    have changed. It separates processors and versions of Python, but not its own versions. The first writable folder
    is used: the environment variable NUMBA_CACHE_DIR, or else the package's cache, then the user's, then a temporary
    one.
    """
    here = Path(__file__).parent
    key = digest(
        [numba.__version__.encode(), *(source.read_bytes() for source in sorted(here.glob("*.py")))], 6
    )
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    places = [lambda: Path(chosen)] if chosen else [lambda: here / "__pycache__", user_cache]
    for place in places:
        try:
            folder = place().expanduser() / f"kernels-{key}"
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except (OSError, RuntimeError):
            continue
    logger.info("no writable folder for compiled kernels; set NUMBA_CACHE_DIR to keep them between runs")
    return tempfile.mkdtemp(prefix="lexsplat-kernels-")


def marker_of(kernels: str) -> Path:
    """An empty file beside the compiled kernels that says that all ``kernels`` are there, for this processor."""
    target = registry.cpu_target.target_context.codegen().magic_tuple()
    return Path(_cache_folder()) / f"{kernels}-{digest([repr((sys.version, target)).encode()], 6)}"


def announce() -> None:
    """Log once per process that kernels are compiled."""
    global _announced
    if not _announced:
        _announced = True
        logger.log(NOTE, "compiling CPU kernels, once for this machine")


class _Announcer(event.Listener):
    """Announces that kernels are compiled; Numba sends no event for kernels from the cache."""

    def on_start(self, event: Any) -> None:
        if event.data["dispatcher"] in _dispatchers:
            announce()

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Announcer())


class _Compiled(event.Listener):
    """Tells of each kernel that is compiled because Python calls it, after those that it calls itself."""

    def __init__(self, told: Callable[[], None]) -> None:
        self._told, self._unfinished = told, 0

    def on_start(self, event: Any) -> None:
        self._unfinished += event.data["dispatcher"] in _dispatchers

    def on_end(self, event: Any) -> None:
        if event.data["dispatcher"] in _dispatchers:
            self._unfinished -= 1
            if not self._unfinished:
                self._told()


@contextmanager
def each_compiled(told: Callable[[], None]) -> Iterator[None]:
    """Call a function after each kernel that this block compiles because Python calls it, on one thread."""
    with event.install_listener("numba:compile", _Compiled(told)):
        yield


_pool: ThreadPoolExecutor | None = None


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork; the child process starts its own pool.
    os.register_at_fork(after_in_child=_forget_pool)


def parallel(function: Callable[..., Any], count: int, grain: int, *arguments: Any) -> None:
    """Run ``function(start, stop, *arguments)`` over ``range(count)`` on the number of threads for kernels.

    Args:
        function: A kernel.
        count: Number of work items.
        grain: Items per piece; a thread takes the next piece when it has finished one.
        *arguments: Further arguments of ``function``.
    """
    global _pool
    if count <= 0:
        return
    pieces = -(-count // grain)
    threads = min(kernel_threads(), pieces)
    if threads <= 1:
        function(0, count, *arguments)
        return
    ticket = itertools.count()  # next() is atomic

    def work() -> None:
        while (piece := next(ticket)) < pieces:
            function(piece * grain, min(count, (piece + 1) * grain), *arguments)

    if _pool is None:
        _pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1, thread_name_prefix="lexsplat")
    helpers = [_pool.submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            helper.result()
