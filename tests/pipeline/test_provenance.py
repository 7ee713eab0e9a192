"""What a scene remembers of its capture and of the models it was made with, and what counts as a change."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
from support.written_captures import save, write_transforms

from lexsplat.captures import load_capture
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.provenance import hash_capture, model_identity, write_provenance
from lexsplat.scenes.folder import SceneFolder


def test_a_model_folder_is_found_from_any_working_folder(tmp_path, monkeypatch):
    write_transforms(tmp_path / "capture", ["a.png", "b.png"])
    (tmp_path / "models" / "clip").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    folder, scene = SceneFolder(tmp_path / "out"), load_capture(tmp_path / "capture")
    write_provenance(folder, scene, BuildConfig(clip="models/clip", dino="none"), hash_capture(scene)[0])
    recorded = json.loads((tmp_path / "out" / "scene.json").read_text())["config"]
    assert Path(recorded["clip"]) == tmp_path / "models" / "clip"
    assert recorded["dino"] == "none"
    write_provenance(folder, scene, BuildConfig(clip="some/name", dino="bundled"), hash_capture(scene)[0])
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
    monkeypatch.undo()
    os.utime(tmp_path / "clip" / "config.json", ns=(1, 1))
    changed = model_identity(str(tmp_path / "clip"), "clip")
    os.utime(tmp_path / "clip" / "config.json", ns=(1, 2))
    assert model_identity(str(tmp_path / "clip"), "clip") != changed, "files of equal size and another time"


def other_photo(capture, folder):
    save(capture.views["b.png"].image_path, np.full((48, 64, 3), 0.9))
    return capture


def other_view(capture, **changes):
    return dataclasses.replace(
        capture, views={**capture.views, "b.png": dataclasses.replace(capture.views["b.png"], **changes)}
    )


def other_camera(capture, folder):
    camera = capture.views["b.png"].camera
    return other_view(capture, camera=dataclasses.replace(camera, K=camera.K * [[1.01], [1], [1]]))


def other_mask(capture, folder):
    save(folder / "mask.png", np.ones((48, 64, 3)))
    return other_view(capture, ignore_path=folder / "mask.png")


def other_split(capture, folder):
    return dataclasses.replace(capture, test_names=("c.png",))


@pytest.mark.parametrize("change", [other_photo, other_camera, other_mask, other_split])
def test_the_fingerprint_follows_photos_cameras_masks_and_split(tmp_path, change):
    write_transforms(tmp_path / "capture", ["a.png", "b.png", "c.png"])
    capture = load_capture(tmp_path / "capture", test_every=0)
    before = hash_capture(capture)[1]
    assert hash_capture(change(capture, tmp_path))[1] != before


def test_a_changed_mask_changes_the_fingerprint(tmp_path):
    write_transforms(tmp_path / "capture", ["a.png", "b.png"])
    found = []
    for value in (0.0, 1.0):
        capture = other_mask(load_capture(tmp_path / "capture"), tmp_path)
        save(tmp_path / "mask.png", np.full((48, 64, 3), value))
        found.append(hash_capture(capture)[1])
    assert found[0] != found[1]


def test_the_record_names_the_capture_but_not_photos_that_were_prepared(tmp_path):
    write_transforms(tmp_path / "capture", ["a.png", "b.png"])
    folder, capture = SceneFolder(tmp_path / "out"), load_capture(tmp_path / "capture")
    write_provenance(folder, capture, BuildConfig(seed=7), hash_capture(capture)[0])
    assert folder.record["capture"] == str(tmp_path / "capture")
    assert folder.record["provenance"]["seed"] == 7
    assert set(folder.record["provenance"]["sources"]) == {"a.png", "b.png"}
    folder.record.update(images="photos", capture="what the user gave")
    write_provenance(folder, capture, BuildConfig(), hash_capture(capture)[0])
    assert folder.record["capture"] == "what the user gave"
