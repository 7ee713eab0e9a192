"""The only module that imports pycolmap: use ``from lexsplat.captures.sfm.pycolmap_import import pycolmap``.

pycolmap installs a SIGTERM handler that prints a stack trace and allocates memory while other threads may hold the
allocator's lock, so a terminated process can deadlock. This module restores the previous handler: as a rule the
process ends at once and resumes from its last checkpoint. Ctrl-C is deferred until the import is complete, because
pycolmap reports an interrupted import as a broken installation.

The import takes time; import it inside functions.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Only the main thread may set handlers. None is a handler that Python did not install and cannot restore.
_is_main = threading.current_thread() is threading.main_thread()
_before = signal.getsignal(signal.SIGTERM)
_interrupt = signal.getsignal(signal.SIGINT)
_waiting: list[int] = []
if _is_main and _interrupt is not None:
    signal.signal(signal.SIGINT, lambda number, frame: _waiting.append(number))
try:
    import pycolmap
finally:
    if _is_main and _interrupt is not None:
        signal.signal(signal.SIGINT, _interrupt)
if _is_main and _before is not None:
    signal.signal(signal.SIGTERM, _before)
if _waiting:
    signal.raise_signal(signal.SIGINT)

__all__ = ["pycolmap", "quiet_pycolmap"]


@contextmanager
def quiet_pycolmap(seed: int) -> Iterator[None]:
    """pycolmap with a fixed seed and without its log.

    Its failures are raised as they are. One that it holds to be impossible ends the process with a stack trace: so
    does a disk that fills up while it writes, in spite of `lexsplat.captures.sfm.feature_budget.check_space`.
    """
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)
    pycolmap.set_random_seed(seed)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
