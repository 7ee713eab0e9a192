"""A process that is forked from one that has asked a scene answers as that one does."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os
import torch
import lexsplat

torch.set_num_threads(2)
scene = lexsplat.open_scene("demo", device="cpu")
view = next(iter(scene.views))
ask = lambda: (scene.find("duck").num_gaussians, round(float(scene.relevancy(["apple"], view).mean()), 5))
expected = ask()
for opened in ("before", "again"):
    if os.fork() == 0:
        scene = lexsplat.open_scene("demo", device="cpu") if opened == "again" else scene
        scene.find("banana")
        os._exit(0 if ask() == expected else 3)
    _, status = os.wait()
    print(opened, os.waitstatus_to_exitcode(status))
"""


@pytest.fixture(scope="module")
def statuses() -> dict[str, int]:
    """The exit status of each fork, by when it opened the scene."""
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return {opened: int(status) for opened, status in map(str.split, done.stdout.splitlines())}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize("opened", ["before", "again"])
def test_a_forked_process_answers_as_its_parent_does(statuses, opened):
    assert statuses[opened] == 0
