"""Fixtures of several modules about reconstruction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints


@pytest.fixture(scope="module")
def capture(tiny_capture) -> Capture:
    """The tiny capture at its full size; read-only."""
    from lexsplat.captures import load_capture

    return load_capture(tiny_capture)


@pytest.fixture(scope="module")
def points(capture) -> InitialPoints:
    """Its initial points; read-only."""
    from lexsplat.captures.sfm.triangulation import initial_points

    return initial_points(capture)
