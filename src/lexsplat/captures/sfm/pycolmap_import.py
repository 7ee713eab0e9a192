"""The one place that imports pycolmap: ``from lexsplat.scenes.pycolmap_import import pycolmap``, where it is needed.

Importing pycolmap takes time, and it installs a handler for SIGTERM that prints a stack trace and works on the heap
while other threads may hold its lock, so that a process asked to end can stay. Here SIGTERM means again what it meant
before: as a rule the process ends at once, and what was saved is what is there (``checkpoints.py``). Ctrl-C waits
until the import is done: in the middle of it pycolmap would take it for a broken installation.
"""

from __future__ import annotations

import signal
import threading

# Only the main thread may set handlers, and None stands for one that Python did not install and cannot restore.
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

__all__ = ["pycolmap"]
