"""Captures, scenes, references and pretended devices that the tests share."""

import os
from pathlib import Path

TESTS_ON_PATH = {
    "PYTHONPATH": os.pathsep.join(
        filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")])
    )
}
"""Environment of a script in this folder that a test runs in a process of its own."""
