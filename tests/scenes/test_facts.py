"""Facts about scenes, from their records and files."""

from __future__ import annotations

import pytest

from lexsplat import cli, open_scene
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.facts import scene_facts
from lexsplat.scenes.folder import SceneFolder


@pytest.mark.slow
def test_facts_of_an_edited_scene_are_those_of_its_files(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lexsplat.scenes.editing.keep_for", lambda *_: None)  # no question is asked of it
    opened = open_scene("demo", device="cpu")
    editor = Editor(opened)
    editor.delete(opened.find("red apple"))
    editor.recolor(editor.scene.find("mug"), "red")
    saved = editor.save(tmp_path / "saved")
    facts = scene_facts(SceneFolder.open(saved.root))
    written = open_scene(saved.root, device="cpu").field
    assert facts["segments"] == written.segments.levels.shape[1]
    assert facts["edits"] == [str(step) for step in editor.steps]
    assert cli.main(["info", str(saved.root)]) == 0
    assert f" edits {editor.steps[0]}; {editor.steps[1]}" in " ".join(capsys.readouterr().out.split())
