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
        self._done: dict[_Key, int] = {}
        self._ended: set[_Key] = set()

    def rate(self, event: Event) -> float:
        """Units a second since the first event of the stage; 0 at that event. A stage can start anew."""
        now, key = time.monotonic(), (event.scene, event.stage)
        if event.done < self._done.get(key, 0) or key in self._ended:
            del self._starts[key]
        self._ended.discard(key)
        if event.done >= event.total:
            self._ended.add(key)
        self._done[key] = event.done
        started, done_before = self._starts.setdefault(key, (now, event.done))
        return (event.done - done_before) / (now - started) if now > started else 0.0

    def record(self, event: Event) -> dict[str, Any]:
        """The event as JSON data, with the rate and the seconds left; null where they are unknown."""
        rate = self.rate(event)
        left = (event.total - event.done) / rate if rate else None
        numbers = {name: value if math.isfinite(value) else None for name, value in event.metrics.items()}
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
