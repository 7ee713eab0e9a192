"""Progress of several scenes: the scene of each event and warning, even where workers build the scenes."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from lexsplat.runtime.files import write_file
from lexsplat.runtime.progress import Event, Listener

_WRITE_SECONDS = 1.0
_READ_SECONDS = 1.0


def named(name: str, listener: Listener) -> Listener:
    """A listener that adds the name of the scene to events."""
    return lambda event: listener(replace(event, scene=name))


@contextmanager
def named_messages(name: str) -> Iterator[None]:
    """Begin the notes and warnings inside the block with the name of the scene."""

    def add_name(record: logging.LogRecord) -> bool:
        record.msg, record.args = f"{name}: {record.getMessage()}", ()
        return True

    log = logging.getLogger("lexsplat")
    log.addFilter(add_name)
    try:
        yield
    finally:
        log.removeFilter(add_name)


class LastEvent:
    """A listener of a worker that keeps the last event in a file, which `relayed` reads in another process.

    Args:
        folder: A folder that both see.
        name: Name of the scene.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._path = _path(folder, name)
        self._stage, self._written = "", 0.0

    def __call__(self, event: Event) -> None:
        """Keep the event, if it is the first or last of its stage or a second has passed."""
        now = time.monotonic()
        if event.stage == self._stage and event.done < event.total and now - self._written < _WRITE_SECONDS:
            return
        self._stage, self._written = event.stage, now
        values = [event.stage, event.done, event.total, dict(event.metrics)]
        with contextlib.suppress(OSError):  # progress is worth no failure
            write_file(self._path, json.dumps(values))


@contextmanager
def relayed(folder: Path, names: Iterable[str], listener: Listener) -> Iterator[Callable[[str], None]]:
    """Send the events that `LastEvent` keeps on to a listener, in a thread; only the last one of each second.

    Yields:
        A function to call with the name of a scene that has ended; its file is removed.
    """
    known = dict.fromkeys(names, "")
    for name in known:  # of a killed command
        _path(folder, name).unlink(missing_ok=True)
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_READ_SECONDS):
            for name, before in list(known.items()):
                text = _read(folder, name)
                if text != before and name in known:
                    known[name] = text
                    with contextlib.suppress(ValueError):
                        stage, done, total, metrics = json.loads(text)
                        listener(Event(stage, done, total, metrics, name))

    def forget(name: str) -> None:
        known.pop(name, None)
        _path(folder, name).unlink(missing_ok=True)

    thread = threading.Thread(target=watch, name="progress of scenes", daemon=True)
    thread.start()
    try:
        yield forget
    finally:
        ended.set()
        thread.join()
        for name in list(known):
            forget(name)


def _path(folder: Path, name: str) -> Path:
    return folder / f".progress-{name}.json"


def _read(folder: Path, name: str) -> str:
    try:
        return _path(folder, name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
