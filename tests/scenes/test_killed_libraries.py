"""A library survives kills at random moments of adding and removing: nothing is lost, nothing is left over."""

import json
import os
import subprocess
import sys

import pytest
from support import TESTS_ON_PATH

pytestmark = pytest.mark.slow


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forks")
def test_thirty_kills_lose_nothing(tmp_path):
    environment = {**os.environ, **TESTS_ON_PATH, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "support.killed_libraries", str(tmp_path), "30", "0"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=3000)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["kills"] == 30
    assert (report["wrong"], report["failed"]) == ([], [])
    # A record and codes for each of the three scenes, the segments of one of them, and no other file.
    assert report["files"] == ["kitchen"] * 3 + ["lab"] * 2 + ["office"] * 2
