"""Progress events: stages send them, front ends display them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

NOTE = 25
"""Level of log records that every user of the command line sees and that are no warnings: licenses, estimates."""

logging.addLevelName(NOTE, "note")


@dataclass(frozen=True)
class Event:
    """Progress of a stage.

    Args:
        stage: Name of the stage, such as "reconstruct".
        done: Finished units.
        total: All units.
        metrics: Numbers to show beside the bar, such as ``{"psnr": 31.2}``.
    """

    stage: str
    done: int
    total: int
    metrics: Mapping[str, float] = field(default_factory=dict)


Listener = Callable[[Event], None]
"""Receives events. It must return quickly and never raise."""


class Pace:
    """Rates and times left of stages, from their events."""

    def __init__(self) -> None:
        self._starts: dict[str, tuple[float, int]] = {}  # time and units done at the first event of a stage
        self._done: dict[str, int] = {}
        self._ended: set[str] = set()

    def rate(self, event: Event) -> float:
        """Units a second since the first event of the stage; 0 at that event. The next scene starts a stage anew."""
        now = time.monotonic()
        before = self._done.get(event.stage, 0)
        if event.done < before or event.stage in self._ended:
            del self._starts[event.stage]
        self._ended.discard(event.stage)
        if event.done >= event.total:
            self._ended.add(event.stage)
        self._done[event.stage] = event.done
        started, done_before = self._starts.setdefault(event.stage, (now, event.done))
        return (event.done - done_before) / (now - started) if now > started else 0.0

    def record(self, event: Event) -> dict[str, Any]:
        """The event as JSON data, with the rate and the seconds left; null where they are unknown."""
        rate = self.rate(event)
        left = (event.total - event.done) / rate if rate else None
        numbers = {name: value if math.isfinite(value) else None for name, value in event.metrics.items()}
        return {
            "stage": event.stage,
            "done": event.done,
            "total": event.total,
            "per_second": round(rate, 6) if rate else None,
            "seconds_left": None if left is None else round(left, 3),
            "metrics": numbers,
        }


def silent(event: Event) -> None:
    """A listener that ignores everything."""
