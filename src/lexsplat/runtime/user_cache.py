"""The user's folder for what can be computed again, and in it the seconds that work took the last time."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from threading import get_ident

_MOST = 256
"""Pieces of work whose seconds are kept; the oldest give way."""
_WORTH_KEEPING = 1.0
"""Shortest time that is kept, in seconds."""
_LONGEST = 1e7
"""Longest time in seconds that is believed: a third of a year."""
_MOST_BYTES = 1 << 20
"""Largest file that is read."""

_done = set[str]()
"""What this process has done."""


def user_cache() -> Path:
    """The user's folder for files that can be recomputed: ``$XDG_CACHE_HOME/lexsplat``, by default
    ``~/.cache/lexsplat``.

    Raises:
        RuntimeError: If the user has no home directory.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    return Path(home).expanduser() / "lexsplat"


def last_seconds(work: str) -> float | None:
    """Seconds that this work took the last time; None if it is not known."""
    return _kept().get(work)


def keep_seconds(work: str, seconds: float) -> None:
    """Keep the time that this work took, unless it was short. A folder that cannot be written keeps nothing.

    Of several times in one process the first counts: later ones find modules loaded.
    """
    if work in _done:
        return
    _done.add(work)
    kept = _kept()
    before = kept.pop(work, None)
    if seconds >= _WORTH_KEEPING:
        kept[work] = round(seconds, 2)
    elif before is None:
        return
    # Not by `lexsplat.runtime.files`, which loads torch: the time of loading it is among what is kept.
    with suppress(OSError, RuntimeError, ValueError):
        path = user_cache() / "waits" / "seconds.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}-{get_ident()}.tmp")
        temporary.write_text(json.dumps(dict(list(kept.items())[-_MOST:])), "utf-8")
        temporary.replace(path)


def _kept() -> dict[str, float]:
    """All that is kept; nothing where the file is missing or holds anything else."""
    with suppress(OSError, RuntimeError, ValueError, RecursionError):
        path = user_cache() / "waits" / "seconds.json"
        found = json.loads(path.read_text("utf-8")) if path.stat().st_size <= _MOST_BYTES else {}
        if isinstance(found, dict):
            return {work: float(each) for work, each in found.items() if _is_time(each)}
    return {}


def _is_time(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < _LONGEST
