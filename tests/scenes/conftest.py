"""Fixtures of several modules about scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from lexsplat.scenes.library import Library


@pytest.fixture(scope="module")
def demo_library(tmp_path_factory) -> Library:
    """A library of the bundled scene; read-only."""
    from lexsplat.scenes.library import Library

    library = Library.create(tmp_path_factory.mktemp("demo") / "library")
    library.add("demo")
    return library
