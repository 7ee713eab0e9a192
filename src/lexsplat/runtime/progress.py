"""Progress events: stages send them, front ends display them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from lexsplat.runtime.user_cache import keep_seconds, last_seconds

NOTE = 25
"""Level of log records that every user of the command line sees and that are no warnings: licenses, estimates."""

logging.addLevelName(NOTE, "note")

log = logging.getLogger("lexsplat")

EXPECTED = "expected"
"""Metric of the first event of a stage that is not counted: the seconds that it will take, if they are known."""

SHORTEST_FORECAST = 2.0
"""Shortest stage with a forecast, in seconds."""


@dataclass(frozen=True)
class Event:
    """Progress of a stage.

    Args:
        stage: Name of the stage, such as "reconstruct".
        done: Finished units.
        total: All units; 1 for work that cannot be counted (`uncounted`).
        metrics: Numbers to show beside the bar, such as ``{"psnr": 31.2}``.
        scene: Name of the scene that the stage is of, where several are built.
    """

    stage: str
    done: int
    total: int
    metrics: Mapping[str, float] = field(default_factory=dict)
    scene: str = ""


Listener = Callable[[Event], None]
"""Receives events. It must return quickly and never raise."""


_Key = tuple[str, str]
"""Scene and stage."""


class Pace:
    """Rates and times left of stages, from their events."""

    def __init__(self) -> None:
        self._starts: dict[_Key, tuple[float, int]] = {}  # time and units done at the first event of a stage
        self._last: dict[_Key, Event] = {}

    def rate(self, event: Event) -> float:
        """Units a second since the first event of the stage; 0 at that event. A stage can start anew."""
        now, key = time.monotonic(), (event.scene, event.stage)
        last, self._last[key] = self._last.get(key), event
        if last is not None and (event.done < last.done or last.done >= last.total):
            del self._starts[key]
        started, done_before = self._starts.setdefault(key, (now, event.done))
        return (event.done - done_before) / (now - started) if now > started else 0.0

    def record(self, event: Event) -> dict[str, Any]:
        """The event as JSON data, with the rate and the seconds left; null where they are unknown."""
        rate = self.rate(event)
        numbers = {name: value if math.isfinite(value) else None for name, value in event.metrics.items()}
        left = numbers.pop(EXPECTED, None)
        if rate:
            left = (event.total - event.done) / rate
        return {
            "scene": event.scene or None,
            "stage": event.stage,
            "done": event.done,
            "total": event.total,
            "per_second": round(rate, 6) if rate else None,
            "seconds_left": None if left is None else round(left, 3),
            "metrics": numbers,
        }


def silent(event: Event) -> None:
    """A listener that ignores everything."""


@contextmanager
def uncounted(listener: Listener, stage: str, of: object = "") -> Iterator[None]:
    """Send the events of a stage that cannot be counted: its begin, and its end after the block.

    Args:
        listener: Receives the events. The first has the seconds that the same work took the last time, as metric
            `EXPECTED`.
        stage: Name of the stage.
        of: What the time depends on, such as the path of a scene.
    """
    work = f"{stage} {of}".rstrip()
    expected = last_seconds(work)
    listener(Event(stage, 0, 1, {} if expected is None else {EXPECTED: expected}))
    start = time.monotonic()
    try:
        yield
        keep_seconds(work, time.monotonic() - start)
    finally:
        listener(Event(stage, 1, 1))


def format_seconds(seconds: float) -> str:
    """A duration as "1:02:03" or "2:03"."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def duration(seconds: float) -> str:
    """The same with its unit: "1:02:03 hours" or "2:03 min"."""
    return f"{format_seconds(seconds)} {'hours' if round(seconds) >= 3600 else 'min'}"


def tell(stage: str, seconds: float, amount: str) -> None:
    """Log the estimated time of a stage of two seconds or more.

    Args:
        stage: Name of the stage.
        seconds: The forecast.
        amount: Amount of work, such as "2,000 iterations".
    """
    if seconds >= SHORTEST_FORECAST:
        log.log(NOTE, "%s: about %s for %s", stage, duration(seconds), amount)


class FirstUnits:
    """Estimates the time of a stage from its first units, if all units take about as long.

    Args:
        stage: Name of the stage.
        units: Plural of the unit, such as "photos".
        enough: Seconds that are measured, at least; more where the first units take longer than others.
        share: Share of the units that is measured, at least.
    """

    def __init__(self, stage: str, units: str, enough: float = 1.0, share: float = 0.0) -> None:
        self._stage, self._units, self._enough, self._share = stage, units, enough, share
        self._start, self._told = 0.0, False

    def __call__(self, done: int, total: int) -> None:
        """Receive the number of finished units, first 0; from the middle on, a forecast is of no use."""
        if not done:
            self._start, self._told = time.monotonic(), False
        seconds = time.monotonic() - self._start
        measured = seconds >= self._enough and done >= self._share * total
        if measured and 0 < done <= total / 2 and not self._told:
            self._told = True
            tell(self._stage, seconds / done * total, f"{total:,} {self._units}")


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """The warnings of lexsplat in this block, which are shown as well."""
    found: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: found.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    try:
        yield found
    finally:
        log.removeHandler(handler)


def warn_again(stage: Mapping[str, Any]) -> None:
    """Show the warnings of a stage that an earlier command finished, from its record."""
    for warning in stage.get("warnings", ()):
        log.warning("%s", warning)
