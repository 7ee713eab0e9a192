"""Fixtures of several modules about the repository."""

import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture(scope="module")
def training_tools():
    """The modules of the tools that made the bundled encoders and captures can be imported."""
    folders = [str(TOOLS / "train_encoders"), str(TOOLS / "demo_scene")]
    sys.path[:0] = folders
    yield
    for folder in folders:
        sys.path.remove(folder)
