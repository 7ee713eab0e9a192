"""A build finds damaged files of its scene and makes them again: "run the build again" is advice that works."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.experiments import CONFIG

from lexsplat.pipeline.build import build
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.folder import SCENE_FILES
from lexsplat.scenes.scene import open_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("color_encoders")]

TRAINED = replace(CONFIG, iterations=4)


@pytest.fixture(scope="module")
def whole(tiny_capture, tmp_path_factory) -> Path:
    """A scene with all kinds of files; they must not be changed."""
    scene = tmp_path_factory.mktemp("whole") / "scene"
    build(tiny_capture, scene, TRAINED)
    return scene


@pytest.fixture
def scene_copy(whole, tmp_path) -> Path:
    """A copy of the scene, to be damaged."""
    return shutil.copytree(whole, tmp_path / "scene")


def flip(path) -> None:
    """Change one byte in the middle of a file, which keeps its length."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x0F
    path.write_bytes(content)


def cut(path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("damage", [flip, cut])
@pytest.mark.parametrize("pattern", ["gaussians.ply", "language.safetensors"])
def test_a_damaged_file_is_refused_when_the_scene_is_opened(scene_copy, pattern, damage):
    damage(scene_copy / pattern)
    with pytest.raises(FileFormatError, match=f"{pattern}: .*; run the build again"):
        open_scene(scene_copy, device="cpu")


@pytest.mark.parametrize("damage", [flip, cut])
@pytest.mark.parametrize(
    "pattern", ["gaussians.ply", "language.safetensors", "codes/*.png", "checkpoints/codebook.safetensors"]
)
def test_a_build_makes_the_stage_of_a_damaged_file_again_and_names_the_file(
    scene_copy, whole, tiny_capture, caplog, pattern, damage
):
    file = min(scene_copy.glob(pattern))
    damage(file)
    folder = build(tiny_capture, scene_copy, TRAINED)
    (told,) = [message for message in caplog.messages if file.name in message]
    assert "runs again" in told
    name = file.relative_to(scene_copy)
    if name.suffix != ".safetensors":  # whose header is not compared: the tensors are
        assert file.read_bytes() == (whole / name).read_bytes()
    repaired, original = (open_scene(place, device="cpu") for place in (scene_copy, whole))
    for key, tensor in original.field.tensors().items():
        torch.testing.assert_close(repaired.field.tensors()[key], tensor, rtol=0, atol=0)
    assert told not in folder.record["warnings"], "what was repaired is no property of the scene"


@pytest.mark.parametrize("damage", [flip, cut])
def test_a_damaged_file_of_features_is_made_again_when_a_stage_needs_it(
    scene_copy, whole, tiny_capture, caplog, damage
):
    file = min(scene_copy.glob("checkpoints/features/*.clip.safetensors"))
    damage(file)
    (scene_copy / "language.safetensors").unlink()
    shutil.rmtree(scene_copy / "codes")  # so that the codebook, which reads features, is made again
    build(tiny_capture, scene_copy, TRAINED)
    assert file.read_bytes() == (whole / file.relative_to(scene_copy)).read_bytes()
    assert damage is cut or any(file.name in message for message in caplog.messages)
    open_scene(scene_copy, device="cpu")


def test_gaussians_that_come_out_different_get_a_language_of_their_own(scene_copy, tiny_capture, monkeypatch):
    """As on a GPU, where a repeated training does not repeat every bit."""
    from lexsplat.pipeline.geometry import Geometry

    make = Geometry.make

    def slightly_different(geometry, config, run):
        gaussians, facts = make(geometry, config, run)
        return replace(gaussians, means=gaussians.means + 1e-3), facts

    monkeypatch.setattr(Geometry, "make", slightly_different)
    before = (scene_copy / "language.safetensors").stat().st_mtime_ns
    flip(scene_copy / "gaussians.ply")
    build(tiny_capture, scene_copy, TRAINED)
    assert (scene_copy / "language.safetensors").stat().st_mtime_ns > before


def test_a_folder_that_was_built_without_checksums_opens_and_is_kept(scene_copy, tiny_capture):
    record = json.loads((scene_copy / "scene.json").read_text())
    del record["checksums"]
    (scene_copy / "scene.json").write_text(json.dumps(record))
    open_scene(scene_copy, device="cpu")
    before = (scene_copy / "gaussians.ply").stat().st_mtime_ns
    build(tiny_capture, scene_copy, TRAINED)
    assert (scene_copy / "gaussians.ply").stat().st_mtime_ns == before
    cut(scene_copy / "gaussians.ply")
    with pytest.raises(FileFormatError, match=r"run the build again$"):
        open_scene(scene_copy, device="cpu")


def test_the_remedy_for_a_damaged_record_works(scene_copy, tiny_capture):
    (scene_copy / "scene.json").write_text("{bad")
    with pytest.raises(FileFormatError) as refused:
        build(tiny_capture, scene_copy, TRAINED)
    for name in SCENE_FILES:
        assert name in refused.value.remedy
        (scene_copy / name).unlink()
    build(tiny_capture, scene_copy, TRAINED)
    open_scene(scene_copy, device="cpu")


@pytest.mark.parametrize("name", ["gaussians.ply", "language.safetensors"])
def test_a_damaged_scene_of_an_edit_which_no_build_makes_again_has_another_remedy(scene_copy, name):
    record = json.loads((scene_copy / "scene.json").read_text())
    (scene_copy / "scene.json").write_text(json.dumps({**record, "edits": ["delete mug"]}))
    flip(scene_copy / name)
    with pytest.raises(FileFormatError, match=f"{name}: .*; restore it from a copy, or edit and save"):
        open_scene(scene_copy, device="cpu")
