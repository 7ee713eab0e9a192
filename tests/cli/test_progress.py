"""Progress on standard error: rate and time left, in bars and in lines."""

import io
import json

import pytest
from rich.console import Console

from lexsplat.cli import progress
from lexsplat.cli.progress import ProgressBars, format_rate, format_seconds
from lexsplat.runtime.progress import Event, Pace


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_lines_state_rate_and_time_left(clock, capsys):
    with ProgressBars() as bars:
        bars(Event("reconstruct", 1000, 3000))  # continued from a checkpoint
        for done in range(1100, 3001, 100):
            clock[0] += 10
            bars(Event("reconstruct", done, 3000, {"psnr": 21.5}))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "reconstruct: 1000/3000"
    assert lines[1] == "reconstruct: 1200/3000 10.0/s, 3:00 left psnr 21.5"
    assert lines[-1] == "reconstruct: 3000/3000 10.0/s psnr 21.5"
    assert len(lines) == 11


def test_stages_that_are_kept_are_one_line(clock, capsys):
    with ProgressBars() as bars:
        bars(Event("features", 9, 9, {"kept": 1.0}))
    assert capsys.readouterr().err == "features: 9/9 kept from the last run\n"


def test_bars_in_a_terminal_state_rate_and_time_left(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        for done in range(1, 4):
            bars(Event("reconstruct", done, 100, {"psnr": 20.0}))
    assert "3/100" in screen.getvalue()
    assert "psnr 20" in screen.getvalue()


def test_a_bar_of_units_that_take_long_states_rate_and_time_left_after_the_first(clock, monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        bars(Event("poses", 0, 25))
        clock[0] += 40.0
        bars(Event("poses", 8, 25))
    assert "5.0 s each" in screen.getvalue()
    assert "0:01:25" in screen.getvalue()
    assert "-:--:--" not in screen.getvalue().split("8/25")[-1]


def test_what_is_printed_into_a_pipe_stays_on_standard_output_while_bars_show(monkeypatch, capsys):
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda **_: Console(file=screen, force_terminal=True))
    with ProgressBars() as bars:
        bars(Event("start", 0, 1))
        print("usage: lexsplat build CAPTURE")
    assert capsys.readouterr().out == "usage: lexsplat build CAPTURE\n"
    assert "usage" not in screen.getvalue()


def test_what_cannot_be_counted_pulses_after_a_counted_stage(monkeypatch):
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=io.StringIO(), force_terminal=True, width=120)
    )
    bars = ProgressBars()
    bars(Event("calibrate", 24, 24))
    bars(Event("calibrate", 0, 1))
    assert [task.total for task in bars._progress.tasks] == [None]


def test_a_stage_of_the_next_scene_starts_anew(clock, monkeypatch, capsys):
    screen = io.StringIO()

    def events(bars):
        for _ in range(2):
            for done in range(0, 101, 10):
                clock[0] += 10
                bars(Event("features", done, 100))
                yield

    with ProgressBars() as bars:
        list(events(bars))
    lines = capsys.readouterr().err.splitlines()
    assert lines.count("features: 100/100 1.0/s") == 2
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        for number, _ in enumerate(events(bars)):
            if number in (10, 15):
                assert bars._progress.tasks[0].finished == (number == 10)


def test_each_scene_under_way_has_a_bar_with_its_present_stage(monkeypatch, capsys):
    events = [
        Event("scenes", 0, 2), Event("features", 1, 9, scene="attic"), Event("features", 2, 9, scene="bath"),
        Event("average", 1, 4, scene="attic"), Event("failed", 1, 1, scene="bath"),
    ]  # fmt: skip
    with ProgressBars() as bars:
        for event in events:
            bars(event)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["scenes: 0/2", "attic: features: 1/9", "bath: features: 2/9", "attic: average: 1/4"]
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        for event in events:
            bars(event)
        shown = [(task.description, task.completed, task.total) for task in bars._progress.tasks]
    assert shown == [("scenes", 0, 2), ("attic: average", 1, 4)]


def test_the_rate_of_a_stage_leaves_out_the_time_since_an_earlier_scene_was_kept(clock):
    pace = Pace()
    pace.rate(Event("reconstruct", 1, 1, {"kept": 1.0}))
    clock[0] += 1000
    assert pace.rate(Event("reconstruct", 10, 100)) == 0.0
    clock[0] += 10
    assert pace.rate(Event("reconstruct", 20, 100)) == pytest.approx(1.0)


def test_work_that_cannot_be_counted_states_the_time_so_far(clock, monkeypatch, capsys):
    with ProgressBars() as bars:
        bars.add(Event("export", 0, 1), 98.0)  # it began two seconds ago
        clock[0] += 5
        bars(Event("export", 1, 1))
        bars(Event("views", 1, 1))
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["export: 0:02 so far", "export: took 0:07", "views: 1/1"]
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        bars.add(Event("export", 0, 1), 98.0)
        assert bars._progress.tasks[0].total is None
        assert bars._progress.tasks[0].start_time == 98.0
        bars(Event("export", 1, 1))
        assert bars._progress.tasks[0].finished


def test_work_that_took_a_while_the_last_time_states_the_time_left(clock, monkeypatch, capsys):
    begun = Event("export", 0, 1, {"expected": 9.0})
    with ProgressBars() as bars:
        bars.add(begun, 98.0)  # it began two seconds ago
        bars(Event("export", 1, 1))
        bars.add(begun, 88.0)  # and once more, for longer than expected
    assert capsys.readouterr().err.splitlines() == [
        "export: 0:02 so far, about 0:07 left",
        "export: took 0:02",
        "export: 0:12 so far",
    ]
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, _environ={})
    )
    with ProgressBars() as bars:
        bars.add(begun, 98.0)
        (task,) = bars._progress.tasks
        left = progress._TimeLeftColumn()
        monkeypatch.setattr(task, "_get_time", lambda: 100.0)
        assert left.render(task).plain == "0:00:07"
        monkeypatch.setattr(task, "_get_time", lambda: 120.0)
        assert left.render(task).plain == "", "it takes longer than the last time"
        bars(Event("export", 1, 1))
        assert task.finished
    assert "expected" not in screen.getvalue()


def test_what_ray_prints_is_not_among_the_lines_of_json(capsys):
    with progress.shown_progress("json") as listener:
        listener(Event("blocks", 1, 4))
        print("(raylet) Raylet is terminated.")
    said = capsys.readouterr()
    assert [json.loads(line)["stage"] for line in said.out.splitlines()] == ["blocks"]
    assert said.err == "(raylet) Raylet is terminated.\n"


def test_rates_and_durations_in_words():
    assert [format_rate(rate) for rate in (None, 0.0, 12.34, 0.25)] == ["", "", "12.3/s", "4.0 s each"]
    assert [format_seconds(seconds) for seconds in (5, 65, 3723.4)] == ["0:05", "1:05", "1:02:03"]
