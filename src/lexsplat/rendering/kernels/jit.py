"""How the kernels are compiled, announced and spread over threads.

Kernels release the GIL and are driven by our own threads instead of Numba's ``prange``. They compile several
times faster that way, need no threading layer (whose pitfalls are forked children and two callers at once), and
several Python threads may render at the same time.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import logging
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import torch
from numba.core import event

logger = logging.getLogger("lexsplat")

_dispatchers: set[Any] = set()
_announced = False


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function, without the GIL and with a cache on disk.

    Fast-math stays off: under its promise that there are no NaN, the outcome of a comparison with one is
    undefined, and comparisons decide here where memory is written.
    """
    # Numba takes the folder from its global settings when the cache is made; leave those as they were.
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    numba.config.CACHE_DIR = _cache_folder()  # type: ignore[attr-defined]
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]
    _dispatchers.add(dispatcher)
    return dispatcher


@functools.cache
def _cache_folder() -> str:
    """Where compiled kernels are kept, for exactly these sources and this compiler.

    Numba looks only at the file of the function it compiles, and would keep kernels whose parts, written in
    another file, have changed. Two versions of Numba would overwrite each other's; those of several processors and
    versions of Python it keeps apart. The first folder that can be written is taken: that of the environment
    variable NUMBA_CACHE_DIR, the package's, the user's, a temporary one.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    here = Path(__file__).parent
    for source in sorted(here.glob("*.py")):
        digest.update(source.read_bytes())
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    places = [Path(chosen)] if chosen else [here / "__pycache__", Path(home) / "lexsplat"]
    for place in places:
        try:
            # A user without a home is a RuntimeError.
            folder = place.expanduser() / f"kernels-{digest.hexdigest()[:12]}"
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except (OSError, RuntimeError):
            continue
    logger.info(
        "no folder for compiled kernels can be written; set NUMBA_CACHE_DIR to keep them between runs"
    )
    return tempfile.mkdtemp(prefix="lexsplat-kernels-")


class _Announcer(event.Listener):
    """Says once per process, before the first of our kernels is compiled, what the wait is for.

    Numba tells when it compiles, and does not when it finds a kernel in the cache: no guess at what is cached for
    this processor and this version, nor at which kernels will be needed.
    """

    def on_start(self, event: Any) -> None:
        global _announced
        if not _announced and event.data["dispatcher"] in _dispatchers:
            _announced = True
            logger.info("compiling CPU kernels, once (about 15 seconds)")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Announcer())


_pool: ThreadPoolExecutor | None = None


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork; a child starts its own.
    os.register_at_fork(after_in_child=_forget_pool)


def parallel(function: Callable[..., Any], count: int, grain: int, *arguments: Any) -> None:
    """Run ``function(start, stop, *arguments)`` over ``range(count)`` on as many threads as torch uses.

    Args:
        function: A kernel.
        count: Number of work items.
        grain: Items handed out at a time; threads take the next piece when they are done.
        *arguments: Passed through.
    """
    global _pool
    if count <= 0:
        return
    pieces = -(-count // grain)
    threads = min(torch.get_num_threads(), pieces)
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
