"""What a scene remembers of the models it was made with."""

import json
from pathlib import Path

from support.written_captures import write_transforms

from lexsplat.captures import load_capture
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.provenance import model_identity, write_provenance
from lexsplat.scenes.folder import SceneFolder


def test_a_model_folder_is_found_from_any_working_folder(tmp_path, monkeypatch):
    write_transforms(tmp_path / "capture", ["a.png", "b.png"])
    (tmp_path / "models" / "clip").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    folder, scene = SceneFolder(tmp_path / "out"), load_capture(tmp_path / "capture")
    write_provenance(folder, scene, BuildConfig(clip="models/clip", dino="none"))
    recorded = json.loads((tmp_path / "out" / "scene.json").read_text())["config"]
    assert Path(recorded["clip"]) == tmp_path / "models" / "clip"
    assert recorded["dino"] == "none"
    write_provenance(folder, scene, BuildConfig(clip="some/name", dino="bundled"))
    recorded = json.loads((tmp_path / "out" / "scene.json").read_text())["config"]
    assert (recorded["clip"], recorded["dino"]) == ("some/name", "bundled")


def test_a_model_folder_is_identified_by_its_files(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "config.json").write_text("{}")
    before = model_identity("~/clip", "clip")
    assert any("config.json" in part for part in before)
    (tmp_path / "clip" / "config.json").write_text("{ }")
    assert model_identity("~/clip", "clip") != before
