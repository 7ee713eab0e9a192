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

logger = logging.getLogger("lexsplat")

_dispatchers: list[Any] = []
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
    _dispatchers.append((dispatcher, function))
    return dispatcher


@functools.cache
def _cache_folder() -> str:
    """Where compiled kernels are kept, for exactly these sources.

    Numba looks only at the file of the function it compiles, and would keep kernels whose parts, written in
    another file, have changed. The first folder that can be written is taken: that of the environment variable
    NUMBA_CACHE_DIR, the package's, the user's, a temporary one.
    """
    digest = hashlib.sha256()
    here = Path(__file__).parent
    for source in sorted(here.glob("*.py")):
        digest.update(source.read_bytes())
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    places = [Path(chosen)] if chosen else [here / "__pycache__", Path(home).expanduser() / "lexsplat"]
    for place in places:
        folder = place / f"kernels-{digest.hexdigest()[:12]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except (OSError, RuntimeError):
            continue
    logger.info(
        "no folder for compiled kernels can be written; set NUMBA_CACHE_DIR to keep them between runs"
    )
    return tempfile.mkdtemp(prefix="lexsplat-kernels-")


def announce_compilation() -> None:
    """Log once per process, before the first kernel runs, if the kernels must be compiled first."""
    global _announced
    if _announced:
        return
    _announced = True
    if not all(_is_cached(dispatcher, function) for dispatcher, function in _dispatchers):
        logger.info("compiling CPU kernels, once (about 15 seconds)")


def _is_cached(dispatcher: Any, function: Callable[..., Any]) -> bool:
    module = Path(function.__code__.co_filename)
    names = Path(dispatcher.stats.cache_path).glob(f"{module.stem}.{function.__name__}-*.nbi")
    return any(name.stat().st_mtime >= module.stat().st_mtime for name in names)


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
