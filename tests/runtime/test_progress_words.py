"""What is said of times beforehand, and the events of work that cannot be counted."""

import pytest

from lexsplat.runtime.progress import NOTE, Event, FirstUnits, duration, tell, uncounted


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def test_a_time_is_told_in_words_from_two_seconds_on(caplog):
    with caplog.at_level(NOTE, "lexsplat"):
        for seconds in (1.9, 2.0, 125.4, 3723.4):
            tell("language", seconds, "60 views")
    assert caplog.messages == [
        "language: about 0:02 min for 60 views",
        "language: about 2:05 min for 60 views",
        "language: about 1:02:03 hours for 60 views",
    ]
    assert [duration(seconds) for seconds in (3599.4, 3599.6)] == ["59:59 min", "1:00:00 hours"]


def test_the_first_units_tell_the_time_of_all_once(clock, caplog):
    told = FirstUnits("matching", "pairs")
    with caplog.at_level(NOTE, "lexsplat"):
        for done in range(0, 101, 2):  # four pairs a second
            told(done, 100)
            clock[0] += 0.5
        assert caplog.messages == ["matching: about 0:25 min for 100 pairs"]
        for done in (0, 4):  # once more, a hundred times as slow
            told(done, 100)
            clock[0] += 100.0
    assert caplog.messages[1:] == ["matching: about 41:40 min for 100 pairs"]


def test_a_share_of_the_units_can_be_asked_for_before_the_time_is_told(clock, caplog):
    told = FirstUnits("mapping", "photos", share=0.2)
    with caplog.at_level(NOTE, "lexsplat"):
        for done in range(8):
            told(done, 30)
            clock[0] += 10.0 if done < 6 else 1.0
    assert caplog.messages == ["mapping: about 5:00 min for 30 photos"], "six photos in a minute"


def test_nothing_is_told_when_half_is_done_before_a_second_has_passed(clock, caplog):
    told = FirstUnits("matching", "pairs")
    with caplog.at_level(NOTE, "lexsplat"):
        for done, at in ((0, 100.0), (9, 100.5), (11, 103.0)):
            clock[0] = at
            told(done, 20)
    assert caplog.messages == []


def test_work_that_cannot_be_counted_ends_also_if_it_fails():
    events = []
    with pytest.raises(KeyError), uncounted(events.append, "export"):
        raise KeyError
    assert events == [Event("export", 0, 1), Event("export", 1, 1)]
