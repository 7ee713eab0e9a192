"""Progress drawn in a terminal, or told in plain lines where there is none."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from lexsplat.runtime.progress import Event

_SECONDS_BETWEEN_LINES = 15.0


class _RateColumn(ProgressColumn):
    """Units a second, or seconds a unit where that reads better."""

    def render(self, task: Task) -> Text:
        return Text(format_rate(task.finished_speed or task.speed), style="dim")


def format_rate(per_second: float | None) -> str:
    """A rate for people: "12.3/s", or "4.1 s each" below one a second, "" if unknown."""
    if not per_second:
        return ""
    return f"{per_second:.1f}/s" if per_second >= 1 else f"{1 / per_second:.1f} s each"


class ProgressBars:
    """A listener (see `lexsplat.runtime.progress`) that shows stages with rate and time left on standard error.

    Use it as a context manager; call the instance with events.
    """

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._tasks: dict[str, TaskID] = {}
        self._last_line: dict[str, float] = {}
        self._progress = Progress(
            TextColumn("{task.description:<13}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            _RateColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("[dim]{task.fields[metrics]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )

    def __enter__(self) -> ProgressBars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Show one event."""
        kept = bool(event.metrics.get("kept"))
        numbers = " ".join(f"{name} {value:.5g}" for name, value in event.metrics.items() if name != "kept")
        text = "kept from the last run" if kept else numbers
        if self.console.is_terminal:
            self._draw(event, text)
        else:
            self._say(event, text)

    def _draw(self, event: Event, text: str) -> None:
        if event.stage not in self._tasks:
            self._tasks[event.stage] = self._progress.add_task(event.stage, total=event.total, metrics="")
        self._progress.update(self._tasks[event.stage], completed=event.done, total=event.total, metrics=text)

    def _say(self, event: Event, text: str) -> None:
        now = time.monotonic()
        started = event.stage not in self._last_line
        due = now - self._last_line.get(event.stage, 0.0) >= _SECONDS_BETWEEN_LINES
        if started or due or event.done >= event.total:
            self._last_line[event.stage] = now
            self.console.print(f"{event.stage}: {event.done}/{event.total} {text}".rstrip(), highlight=False)
