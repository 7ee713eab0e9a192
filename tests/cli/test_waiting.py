"""Progress of commands that are mostly quick."""

from lexsplat.cli.waiting import LateProgress
from lexsplat.runtime.progress import Event


def test_a_quick_stage_shows_nothing_and_a_slow_one_its_rate(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
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
