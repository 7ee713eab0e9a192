"""Builds into folders with edits: nothing that was edited is lost without a word."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.command_line import fails_in_one_line, modified
from support.experiments import CONFIG

from lexsplat import cli, open_scene
from lexsplat.pipeline.build import build
from lexsplat.runtime.errors import SceneFolderError
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import keep_previous, version_that_answers
from lexsplat.scenes.unsaved import outdated_steps, unsaved_steps

OLD = Path(__file__).parents[1] / "data" / "scene_d4e65b3" / "averaged"


def red_apple(editor: Editor):
    """What an edit may change."""
    return editor.scene.find("red apple", threshold=0.05)


@pytest.fixture
def old_copy(tmp_path) -> Path:
    """A small scene without segments."""
    return shutil.copytree(OLD, tmp_path / "scene")


@pytest.mark.parametrize("command", ["build", "reconstruct", "language"])
def test_a_saved_edit_is_not_built_over(old_copy, tmp_path, tiny_capture, capsys, command):
    editor = Editor(open_scene(old_copy, device="cpu"))
    editor.recolor(red_apple(editor), (0, 0, 1))
    saved = editor.save(tmp_path / "saved").root
    before = modified(saved)
    told = f"{saved}: expected a new folder or a scene without edits, found a scene with 1 edit"
    fails_in_one_line(capsys, [command, str(tiny_capture), "--output", str(saved)], told, "another --output")
    assert modified(saved) == before


@pytest.mark.slow
@pytest.mark.usefixtures("color_encoders")
def test_new_gaussians_are_refused_while_steps_are_unsaved_and_new_language_is_not(tiny_capture, tmp_path):
    config = replace(CONFIG, method="averaged", iterations=4)
    folder = build(tiny_capture, tmp_path / "scene", config)
    opened = open_scene(folder.root, device="cpu")
    editor = Editor(opened, folder.root / "edits.jsonl")
    everything = opened.selection(opened.gaussians.opacities > -1, opened.gaussians.opacities)
    editor.recolor(everything, (0, 0, 1))
    before = (folder.root / "scene.json").read_bytes()
    with pytest.raises(
        SceneFolderError, match=r"edits.jsonl: expected no unsaved steps .* found 1 step; .* save"
    ):
        build(tiny_capture, folder.root, replace(config, iterations=5))
    assert (folder.root / "scene.json").read_bytes() == before
    assert not (folder.root / "previous").exists()
    build(
        tiny_capture, folder.root, replace(config, features=replace(config.features, crop_sizes=(0.25, 0.5)))
    )
    assert unsaved_steps(SceneFolder.open(folder.root)) == 1, "they are for the same Gaussians"
    assert Editor(open_scene(folder.root, device="cpu"), folder.root / "edits.jsonl").steps


@pytest.mark.slow
@pytest.mark.usefixtures("color_encoders")
def test_a_rebuild_says_that_measurements_are_of_the_scene_before_it(tiny_capture, tmp_path, caplog):
    config = replace(CONFIG, method="averaged", iterations=4)
    scene = tmp_path / "scene"
    told = "metrics.json, report.html and heatmaps are of the scene before this build"
    build(tiny_capture, scene, config)
    (scene / "metrics.json").write_text("{}")
    build(tiny_capture, scene, config)
    assert told not in caplog.text, "nothing has changed"
    build(tiny_capture, scene, replace(config, iterations=5))
    assert told in caplog.text


def test_steps_for_earlier_gaussians_are_said_to_be_worthless_and_not_to_be_saved(old_copy, capsys):
    opened = open_scene(old_copy, device="cpu")
    editor = Editor(opened, old_copy / "edits.jsonl")
    editor.recolor(red_apple(editor), (0, 0, 1))
    folder = SceneFolder.open(old_copy)
    assert (unsaved_steps(folder), outdated_steps(folder)) == (1, 0)
    folder.record["stages"]["reconstruct"]["fingerprint"] = "of a later build"
    folder.save()
    assert (unsaved_steps(folder), outdated_steps(folder)) == (0, 1)
    assert cli.main(["info", str(old_copy)]) == 0
    told = capsys.readouterr()
    discard = f"no longer fits the scene, which was built again; lexsplat edit {old_copy} discard removes it"
    assert f"1, which {discard}" in told.out
    assert "save" not in told.out + told.err
    assert cli.main(["export", str(old_copy), str(old_copy / "a.ply")]) == 0
    assert f"note: 1 step of lexsplat edit {discard}" in capsys.readouterr().err


def test_info_describes_the_version_that_answers_and_names_the_rebuild(old_copy, tmp_path, capsys):
    folder = SceneFolder.open(old_copy)
    keep_previous(folder)
    folder.save()
    folder.reopen("language")
    folder.finish("reconstruct", "of a later build", 1.0, gaussians=3)
    assert version_that_answers(SceneFolder.open(old_copy)).content == old_copy / "previous"
    assert cli.main(["info", str(old_copy)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "rebuild is at work or was interrupted: wait for it, or run the build again" in told
    assert "gaussians 400 " in told
    assert cli.main(["info", str(old_copy), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rebuilding"] is True
    for command in (["find", str(old_copy), "red apple"], ["export", str(old_copy), str(tmp_path / "a.ply")]):
        assert cli.main(command) == 0
        assert (
            "note: this is the scene before a rebuild, which is at work or was interr"
            in capsys.readouterr().err
        )
