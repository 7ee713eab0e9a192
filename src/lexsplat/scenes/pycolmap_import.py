"""The one place that imports pycolmap: ``from lexsplat.scenes.pycolmap_import import pycolmap``, where it is needed.

Importing pycolmap takes time, and it installs a handler for SIGTERM that prints a stack trace and works on the heap
while other threads may hold its lock, so that a process asked to end can stay. Here SIGTERM means again what it meant
before: as a rule the process ends at once, and what was saved is what is there (``checkpoints.py``).
"""

from __future__ import annotations

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402  (after the handler has been noted)

# Only the main thread may set handlers, and None stands for one that Python did not install and cannot restore.
if threading.current_thread() is threading.main_thread() and _before is not None:
    signal.signal(signal.SIGTERM, _before)

__all__ = ["pycolmap"]
