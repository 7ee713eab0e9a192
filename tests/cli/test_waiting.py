"""Progress of commands that are mostly quick."""

import signal
import time
from contextlib import suppress

import pytest

from lexsplat.cli import waiting
from lexsplat.cli.waiting import LateProgress
from lexsplat.runtime.progress import Event


@pytest.fixture
def now(monkeypatch) -> list[float]:
    """The time of the monotonic clock, to be changed."""
    clock = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    return clock


@pytest.fixture
def listener(now, capsys) -> LateProgress:
    """One that shows a slow stage, "page", after the first of six units."""
    late = LateProgress()
    late(Event("page", 0, 6))
    now[0] += 3.0
    late(Event("page", 1, 6))
    return late


def test_a_quick_stage_shows_nothing_and_a_slow_one_its_rate(now, capsys):
    listener = LateProgress()
    for done in range(1, 11):  # one second in all
        now[0] += 0.1
        listener(Event("words", done, 10))
    assert capsys.readouterr().err == ""
    for done in range(10):
        listener(Event("words", done, 10))
        now[0] += 1.0
    listener(Event("words", 10, 10))
    said = capsys.readouterr().err
    assert "words: 2/10" in said
    assert "1.0/s" in said
    assert "words: 10/10" in said


def test_a_stage_that_sends_nothing_is_shown_after_the_time(capsys):
    listener = LateProgress(patience=0.05)
    listener(Event("page", 0, 6))
    deadline = time.monotonic() + 20
    while "page: 0/6" not in (said := capsys.readouterr().err) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert "page: 0/6" in said
    listener(Event("page", 6, 6))
    assert "page: 6/6" in capsys.readouterr().err


def test_a_quick_stage_within_a_slow_one_does_not_end_its_progress(listener, now, capsys):
    listener(Event("words", 0, 2))
    listener(Event("words", 2, 2))
    now[0] += 20.0
    listener(Event("page", 2, 6))
    said = capsys.readouterr().err
    assert "page: 1/6" in said
    assert "page: 2/6" in said
    listener(Event("page", 6, 6))


def test_quick_stages_within_a_slow_one_are_not_shown_and_slow_ones_are(listener, now, capsys):
    for _ in range(20):  # each of one word
        listener(Event("words", 0, 1))
        listener(Event("words", 1, 1))
    said = capsys.readouterr().err
    assert "page: 1/6" in said
    assert "words" not in said
    listener(Event("words", 0, 2))
    now[0] += 5.0
    listener(Event("words", 1, 2))
    listener(Event("words", 2, 2))
    assert "words: 2/2" in capsys.readouterr().err
    listener(Event("page", 6, 6))


def test_a_silent_stage_within_a_slow_one_is_shown_after_the_time(capsys):
    listener = LateProgress(patience=0.05)
    listener(Event("page", 0, 6))
    said = ""
    for stage in ("page", "export"):
        listener(Event("export", 0, 1))
        deadline = time.monotonic() + 20
        while f"{stage}: 0" not in said and time.monotonic() < deadline:
            time.sleep(0.02)
            said += capsys.readouterr().err
        assert f"{stage}: 0" in said
    listener(Event("export", 1, 1))
    listener(Event("page", 6, 6))


def test_a_stage_that_failed_does_not_show_its_next_run_too_early(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    listener = LateProgress()
    listener(Event("words", 0, 2))  # then the encoder is missing
    now[0] += 1.5
    listener(Event("words", 0, 2))
    now[0] += 1.0
    listener(Event("words", 1, 2))
    listener(Event("words", 2, 2))
    assert capsys.readouterr().err == ""


def test_imports_that_take_long_are_shown_with_the_time_so_far_and_quick_ones_are_not(capsys, monkeypatch):
    with waiting.starting():
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(waiting, "LateProgress", lambda: LateProgress(patience=0.05))
    deadline = time.monotonic() + 20
    with waiting.starting():
        while "start: 0:0" not in (said := capsys.readouterr().err) and time.monotonic() < deadline:
            time.sleep(0.02)
    assert "so far" in said
    assert "start: took 0:0" in capsys.readouterr().err


@pytest.fixture
def ctrl_c():
    """Ctrl-C as in a terminal: a job in the background starts with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield lambda: signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, before)


def swallow(ctrl_c):
    """What torch makes of it while it imports numpy."""
    with suppress(KeyboardInterrupt):
        ctrl_c()


def fail_after(ctrl_c):
    swallow(ctrl_c)
    raise ImportError("cannot load module more than once per process")


@pytest.mark.parametrize("module", [swallow, fail_after])
def test_ctrl_c_ends_the_loading_whatever_a_module_makes_of_it(module, ctrl_c):
    with pytest.raises(KeyboardInterrupt), waiting.loading():
        module(ctrl_c)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_of_loading_without_ctrl_c_stays(ctrl_c):
    with pytest.raises(ImportError, match="no module"), waiting.loading():
        raise ImportError("no module named torch")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
