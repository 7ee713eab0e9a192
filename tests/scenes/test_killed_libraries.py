"""A library survives kills at random moments of adding and removing: nothing is lost, nothing is left over."""

import json
import os

import pytest
from support import killed_libraries
from support.forked_commands import Command

pytestmark = pytest.mark.slow


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forks")
def test_thirty_kills_lose_nothing(tmp_path):
    with Command(str(tmp_path), "30", "0", program=killed_libraries.main) as killing:
        done = killing.ended(seconds=3000)
    assert done.status == 0, done.err[-2000:]
    report = json.loads(done.out.splitlines()[-1])
    assert (report["wrong"], report["failed"]) == ([], []), done.err[-2000:]
    assert report["kills"] == 30
    # A record and codes for each of the three scenes, the segments of one of them, and no other file.
    assert report["files"] == ["kitchen"] * 3 + ["lab"] * 2 + ["office"] * 2
