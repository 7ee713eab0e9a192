"""A process that is forked from one that has asked a scene answers as that one does."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, sys
import torch
import lexsplat

torch.set_num_threads(2)
scene = lexsplat.open_scene("demo", device="cpu")
view = next(iter(scene.views))
ask = lambda: (scene.find("duck").num_gaussians, round(float(scene.relevancy(["apple"], view).mean()), 5))
expected = ask()
if os.fork() == 0:
    scene = lexsplat.open_scene("demo", device="cpu") if sys.argv[1] == "again" else scene
    scene.find("banana")
    os._exit(0 if ask() == expected else 3)
_, status = os.wait()
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize("opened", ["before", "again"])
def test_a_forked_process_answers_as_its_parent_does(opened):
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM, opened], timeout=100, check=False)
    assert done.returncode == 0
