"""Progress as bars in a terminal, as plain lines elsewhere, as lines of JSON; all state rate and time left."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from datetime import timedelta
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

from lexsplat.runtime.progress import EXPECTED, Event, Listener, Pace, format_seconds

_SECONDS_BETWEEN_LINES = 15.0
_ENDS = ("finished", "failed")
"""Stages by which events say that a scene of several has ended."""


def _speed(task: Task) -> float | None:
    """Units a second: of the last seconds, or of the whole stage where units take longer."""
    return task.finished_speed or task.speed or task.fields["rate"] or None


class _RateColumn(ProgressColumn):
    """The column of the rate."""

    def render(self, task: Task) -> Text:
        return Text(format_rate(_speed(task)), style="dim")


class _TimeLeftColumn(TimeRemainingColumn):
    """The column of the time left."""

    def render(self, task: Task) -> Text:
        speed, left = _speed(task), task.remaining
        if expected := task.fields["expected"]:  # of a stage that is not counted, from the last time
            left, speed = expected - (task.elapsed or 0.0), 1.0
            if left < 0:  # it takes longer
                return Text("")
        elif task.time_remaining is not None or speed is None or left is None:
            return super().render(task)
        return Text(str(timedelta(seconds=int(left / speed))), style="progress.remaining")


def format_rate(per_second: float | None) -> str:
    """A rate in words: "12.3/s", or "4.1 s each" below one per second; "" if unknown."""
    if not per_second:
        return ""
    return f"{per_second:.1f}/s" if per_second >= 1 else f"{1 / per_second:.1f} s each"


class ProgressBars:
    """A listener (see `lexsplat.runtime.progress`) that shows stages with rate and time left on standard error.

    Use it as a context manager, and call the instance with events.
    """

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._began: dict[str, float] = {}
        self._tasks: dict[str, TaskID] = {}
        self._pace = Pace()
        self._last_line: dict[str, float] = {}
        self._progress = Progress(
            TextColumn("{task.description:<13}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            _RateColumn(),
            TimeElapsedColumn(),
            _TimeLeftColumn(),
            TextColumn("[dim]{task.fields[metrics]}"),
            console=self.console,
            # What is piped is data and stays on standard output, which is None if it is closed.
            redirect_stdout=sys.stdout is not None and sys.stdout.isatty(),
            disable=not self.console.is_terminal,
        )

    def __enter__(self) -> ProgressBars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def add(self, event: Event, began: float) -> None:
        """Show the first event of a stage that began earlier, at a time of the monotonic clock."""
        self._began[event.stage] = began
        self(event)

    def __call__(self, event: Event) -> None:
        """Show one event."""
        kept = bool(event.metrics.get("kept"))
        shown = {name: value for name, value in event.metrics.items() if name not in ("kept", EXPECTED)}
        numbers = " ".join(f"{name} {value:.5g}" for name, value in shown.items())
        text = "kept from the last run" if kept else numbers
        rate = self._pace.rate(event)
        if self.console.is_terminal:
            self._draw(event, text, rate)
        elif not (event.scene and event.stage in _ENDS):
            self._print_line(event, text, rate)

    def _draw(self, event: Event, text: str, rate: float) -> None:
        """A bar for each stage; of several scenes, a bar for each scene under way, with its present stage."""
        if event.scene and event.stage in _ENDS:
            if event.scene in self._tasks:
                self._progress.remove_task(self._tasks.pop(event.scene))
            return
        key, title = (event.scene, f"{event.scene}: {event.stage}") if event.scene else (event.stage,) * 2
        total = event.total if event.total > 1 or event.done else None  # None draws a pulse
        if key not in self._tasks:
            self._tasks[key] = self._progress.add_task(title, total=total, metrics="", rate=0.0, expected=0.0)
        task = next(task for task in self._progress.tasks if task.id == self._tasks[key])
        if (
            event.done < task.completed or task.description != title
        ):  # the stage starts anew, or the next one does
            self._progress.reset(task.id, description=title)
        if event.stage in self._began:
            task.start_time = self._began.pop(event.stage)
        task.total = total  # `update` keeps the old one where it gets None
        self._progress.update(task.id, completed=event.done, metrics=text, rate=rate)
        task.fields["expected"] = 0.0 if event.done else event.metrics.get(EXPECTED, 0.0)

    def _print_line(self, event: Event, text: str, rate: float) -> None:
        now = time.monotonic()
        name = f"{event.scene}: {event.stage}" if event.scene else event.stage
        if event.total == 1 and not event.done:
            past = now - self._began.setdefault(name, now)
            line, left = f"{format_seconds(past)} so far", event.metrics.get(EXPECTED, 0.0) - past
            line += f", about {format_seconds(left)} left" if left > 0.5 else ""
        elif event.total == 1 and name in self._began:
            line = f"took {format_seconds(now - self._began.pop(name))}"
        else:
            line = self._counted(event, name, now, rate)
        if line:
            self.console.print(f"{name}: {line} {text}".rstrip(), highlight=False, soft_wrap=True)

    def _counted(self, event: Event, name: str, now: float, rate: float) -> str:
        """Units, rate and time left; empty where the last line of the stage is recent."""
        is_first = name not in self._last_line
        is_due = now - self._last_line.get(name, 0.0) >= _SECONDS_BETWEEN_LINES
        if not (is_first or is_due or event.done >= event.total):
            return ""
        self._last_line[name] = now
        speed = format_rate(rate)
        if rate and event.done < event.total:
            speed += f", {format_seconds((event.total - event.done) / rate)} left"
        return f"{event.done}/{event.total} {speed}".rstrip()


@contextmanager
def shown_progress(form: str) -> Iterator[Listener]:
    """A listener that shows progress as "bars" on standard error, or as "json" lines on standard output."""
    if form == "bars":
        with ProgressBars() as bars:
            yield bars
        return
    pace, output = Pace(), sys.stdout

    def print_event(event: Event) -> None:
        print(json.dumps(pace.record(event)), file=output, flush=True)

    with redirect_stdout(sys.stderr):  # Ray prints there when a node is lost
        yield print_event
