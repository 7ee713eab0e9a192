"""Progress of commands that are mostly quick."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from lexsplat.runtime.progress import Event

if TYPE_CHECKING:
    from lexsplat.cli.progress import ProgressBars

_PATIENCE = 2.0


class LateProgress:
    """A listener that shows a stage if it is not finished after two seconds, and nothing before.

    Args:
        patience: Seconds without anything shown.
    """

    def __init__(self, patience: float = _PATIENCE) -> None:
        self._patience = patience
        self._starts: dict[str, float] = {}
        self._bars: ProgressBars | None = None

    def __call__(self, event: Event) -> None:
        """Receive one event."""
        start = self._starts.setdefault(event.stage, time.monotonic())
        finished = event.done >= event.total
        if self._bars is None and not finished and time.monotonic() - start >= self._patience:
            from lexsplat.cli.progress import ProgressBars

            self._bars = ProgressBars().__enter__()
        if self._bars is not None:
            self._bars(event)
        if finished:
            del self._starts[event.stage]
        if finished and self._bars is not None:
            self._bars.__exit__(None, None, None)
            self._bars = None
