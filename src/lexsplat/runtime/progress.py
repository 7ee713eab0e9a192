"""Progress as events: work reports, front ends draw. Nothing here prints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Event:
    """How far a stage is.

    Args:
        stage: Name of the stage, such as "reconstruct".
        done: Units finished.
        total: Units in all.
        metrics: Numbers worth showing beside the bar, such as ``{"psnr": 31.2}``.
    """

    stage: str
    done: int
    total: int
    metrics: Mapping[str, float] = field(default_factory=dict)


Listener = Callable[[Event], None]
"""What a front end passes in. It must return quickly and never raise."""


def silent(event: Event) -> None:
    """A listener that ignores everything."""
