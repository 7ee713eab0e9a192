"""Fixtures of several modules about scenes."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from lexsplat.scenes.library import Library


@pytest.fixture(scope="module")
def demo_library(demo_library_made, tmp_path_factory) -> Library:
    """A library of the bundled scene; read-only."""
    from lexsplat.scenes.library import Library

    return Library(shutil.copytree(demo_library_made, tmp_path_factory.mktemp("demo") / "library"))


@pytest.fixture(scope="session")
def published_demo(made_once) -> Path:
    """The folder of the published bundled scene; read-only."""
    from lexsplat.scenes.publishing import PublishOptions, publish
    from lexsplat.scenes.scene import open_scene

    return made_once(
        "published_demo",
        lambda target: publish(open_scene("demo"), target, PublishOptions(title="A table top")),
    )


@pytest.fixture(scope="session")
def light_demo(published_demo, made_once) -> Path:
    """The published bundled scene; its page draws few of the Gaussians, as software does so slowly; read-only."""

    def make(target: Path) -> None:
        shutil.copytree(published_demo, target)
        manifest = json.loads((target / "manifest.json").read_text())
        manifest["scene"]["budget"] = 2_000
        (target / "manifest.json").write_text(json.dumps(manifest))

    return made_once("light_demo", make)


@pytest.fixture
def room_encoders(monkeypatch) -> None:
    """The encoders of the small scenes of `library_scenes` in place of models."""
    from support.library_scenes import install

    install(monkeypatch)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """Three scenes and a library of them; read-only."""
    from support.library_scenes import OTHERS, THINGS, install, write_scene

    from lexsplat.scenes.library import Library

    root = tmp_path_factory.mktemp("rooms")
    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        write_scene(root / "kitchen")
        write_scene(root / "office", OTHERS)
        write_scene(root / "lab", (*OTHERS[:3], *THINGS[:2]), encoder="def")
        library = Library.create(root / "library")
        for name in ("kitchen", "office", "lab"):
            library.add(root / name)
    return root


@pytest.fixture
def rooms_copy(rooms, tmp_path) -> Path:
    """A copy of scenes and library that may be changed."""
    from support.library_scenes import copied

    return copied(rooms, tmp_path / "rooms")
