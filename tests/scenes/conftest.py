"""Fixtures of several modules about scenes."""

import pytest

from lexsplat.scenes.library import Library


@pytest.fixture(scope="module")
def demo_library(tmp_path_factory) -> Library:
    """A library of the bundled scene; read-only."""
    library = Library.create(tmp_path_factory.mktemp("demo") / "library")
    library.add("demo")
    return library
