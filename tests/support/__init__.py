"""Captures, scenes, reference implementations and pretended devices shared by the tests."""

import os
from pathlib import Path

TESTS_ON_PATH = {
    "PYTHONPATH": os.pathsep.join(
        filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")])
    )
}
"""Environment of a script of this folder that a test runs in a separate process."""
