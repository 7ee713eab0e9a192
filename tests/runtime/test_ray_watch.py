"""The end of a cluster is told in one line, also where Ray ends the process from within its own code."""

import socket
import subprocess
import sys
import time

import pytest

from lexsplat.runtime import ray_watch
from lexsplat.runtime.ray_watch import ClusterLostError, HeadWatch

pytestmark = pytest.mark.slow

ENDS = """
import os, sys
from lexsplat.runtime import ray_watch
ray_watch.WITNESS_SECONDS = 2
with ray_watch.HeadWatch("127.0.0.1:PORT"):
    END
"""


@pytest.fixture
def head():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(64)
        yield listening


def told(head, end: str) -> str:
    script = ENDS.replace("PORT", str(head.getsockname()[1])).replace("END", end)
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120).stderr


def test_a_process_that_ray_ends_because_the_head_is_gone_leaves_one_line(head):
    port = head.getsockname()[1]
    head.close()
    script = ENDS.replace("PORT", str(port)).replace("END", "os._exit(1)")
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1
    assert ended.stderr == f"error: {ClusterLostError.by()}\n"
    assert "run the same command again" in ended.stderr


@pytest.mark.parametrize("end", ["pass", "os._exit(1)", "sys.exit(3)"])
def test_a_process_that_ends_while_the_head_answers_leaves_no_line(head, end):
    assert told(head, end) == ""


def test_the_head_counts_as_gone_after_the_grace_time_and_not_before(head, monkeypatch):
    monkeypatch.setattr(ray_watch, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(ray_watch, "GRACE_SECONDS", 1.5)
    with HeadWatch(f"127.0.0.1:{head.getsockname()[1]}") as watch:
        time.sleep(2.0)
        assert list(watch.guarded(iter([1, 2]))) == [1, 2]
        head.close()
        end = time.monotonic() + 30
        while not watch.lost and time.monotonic() < end:
            time.sleep(0.1)
        with pytest.raises(ClusterLostError, match="no node that answers; finished work is kept"):
            next(watch.guarded(iter([1])))


def test_without_an_address_nothing_is_watched():
    with HeadWatch(None) as watch:
        assert list(watch.guarded(iter([1]))) == [1]
