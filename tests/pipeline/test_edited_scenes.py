"""Builds into folders with edits: nothing that was edited is lost without a word."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.command_line import fails_in_one_line, modified

from lexsplat import open_scene
from lexsplat.scenes.editing import Editor

OLD = Path(__file__).parents[1] / "data" / "scene_d4e65b3" / "averaged"


def red_apple(editor: Editor):
    """What an edit may change."""
    return editor.scene.find("red apple", threshold=0.05)


@pytest.fixture
def scene(tmp_path) -> Path:
    """A small scene without segments."""
    return shutil.copytree(OLD, tmp_path / "scene")


@pytest.mark.parametrize("command", ["build", "reconstruct", "language"])
def test_a_saved_edit_is_not_built_over(scene, tmp_path, tiny_capture, capsys, command):
    editor = Editor(open_scene(scene, device="cpu"))
    editor.recolor(red_apple(editor), (0, 0, 1))
    saved = editor.save(tmp_path / "saved").root
    before = modified(saved)
    told = f"{saved}: expected a new folder or a scene without edits, found a scene with 1 edit"
    fails_in_one_line(capsys, [command, str(tiny_capture), "--output", str(saved)], told, "another --output")
    assert modified(saved) == before
