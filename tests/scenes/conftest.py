"""Fixtures of several modules about scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from lexsplat.scenes.library import Library


@pytest.fixture(scope="module")
def demo_library(tmp_path_factory) -> Library:
    """A library of the bundled scene; read-only."""
    from lexsplat.scenes.library import Library

    library = Library.create(tmp_path_factory.mktemp("demo") / "library")
    library.add("demo")
    return library


@pytest.fixture(scope="session")
def published_demo(made_once) -> Path:
    """The folder of the published bundled scene; read-only."""
    from lexsplat.scenes.publishing import PublishOptions, publish
    from lexsplat.scenes.scene import open_scene

    return made_once(
        "published_demo",
        lambda target: publish(open_scene("demo"), target, PublishOptions(title="A table top")),
    )
