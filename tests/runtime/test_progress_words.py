"""What is said of times beforehand, and the events of work that cannot be counted."""

import json

import pytest

from lexsplat.runtime import user_cache
from lexsplat.runtime.progress import NOTE, Event, FirstUnits, Pace, duration, tell, uncounted


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


@pytest.fixture
def own_cache_of_seconds(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(user_cache, "_done", set())
    return tmp_path / "lexsplat" / "waits" / "seconds.json"


def done_in(seconds, clock, of):
    """The first event of uncounted work that takes so long in a process of its own."""
    events = []
    user_cache._done.clear()
    with uncounted(events.append, "scene", of):
        clock[0] += seconds
    return events[0]


def test_work_that_cannot_be_counted_is_expected_to_take_as_long_as_the_last_time(
    clock, own_cache_of_seconds
):
    assert done_in(7.0, clock, "attic") == Event("scene", 0, 1)
    assert done_in(9.0, clock, "attic") == Event("scene", 0, 1, {"expected": 7.0})
    assert done_in(1.0, clock, "bath") == Event("scene", 0, 1)
    assert done_in(1.0, clock, "attic").metrics == {"expected": 9.0}
    record = Pace().record(Event("scene", 0, 1, {"expected": 9.0}))
    assert (record["seconds_left"], record["metrics"]) == (9.0, {})


def test_work_that_failed_or_was_quick_says_nothing_about_the_next_time(clock, own_cache_of_seconds):
    def fail():
        with uncounted(lambda event: None, "scene", "attic"):
            clock[0] += 30
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert done_in(0.9, clock, "attic") == done_in(0.1, clock, "attic") == Event("scene", 0, 1)
    assert not own_cache_of_seconds.exists()
    done_in(30.0, clock, "attic")
    assert done_in(0.1, clock, "attic").metrics == {"expected": 30.0}
    assert done_in(0.1, clock, "attic").metrics == {}, "the last time it was quick"


def test_of_several_times_in_one_process_the_first_is_kept(clock, own_cache_of_seconds):
    done_in(4.0, clock, "attic")
    for seconds in (0.0, 9.0):  # the modules are loaded
        with uncounted(lambda event: None, "scene", "attic"):
            clock[0] += seconds
    assert done_in(1.0, clock, "attic").metrics == {"expected": 4.0}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[1]",
        '{"scene attic": "x", "scene": true}',
        "{" * 9000,
        "NaN",
        '{"scene attic": 1e300}',
        f'{{"scene attic": 1{"0" * 400}}}',
        '{"scene attic": -3}',
    ],
)
def test_a_damaged_file_of_seconds_counts_as_none(clock, own_cache_of_seconds, content):
    own_cache_of_seconds.parent.mkdir(parents=True)
    own_cache_of_seconds.write_text(content)
    assert done_in(3.0, clock, "attic") == Event("scene", 0, 1)
    assert done_in(3.0, clock, "attic").metrics == {"expected": 3.0}


def test_seconds_that_cannot_be_kept_are_not_missed(clock, own_cache_of_seconds):
    own_cache_of_seconds.parents[1].write_text("a file where the folder should be")
    assert done_in(3.0, clock, "attic") == done_in(3.0, clock, "attic") == Event("scene", 0, 1)


def test_the_oldest_of_many_seconds_give_way(clock, own_cache_of_seconds):
    for number in range(300):
        done_in(2.0, clock, number)
    assert len(json.loads(own_cache_of_seconds.read_text())) == 256
    assert done_in(2.0, clock, 299).metrics == {"expected": 2.0}
    assert done_in(2.0, clock, 0).metrics == {}
