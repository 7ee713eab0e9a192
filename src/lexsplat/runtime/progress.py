"""Progress events: stages send them, front ends display them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

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


def silent(event: Event) -> None:
    """A listener that ignores everything."""
