"""Questions to a scene while it is rebuilt: the old answer, the new one, or one line; never a mix of both."""

from __future__ import annotations

import shutil
import threading

import pytest
import torch

from lexsplat import open_scene
from lexsplat.errors import SceneFolderError
from lexsplat.scene_folder import SceneFolder
from lexsplat.tensor_files import read_tensors, write_tensors


@pytest.fixture
def scene(built, tmp_path):
    return shutil.copytree(built, tmp_path / "scene")


class Builder:
    """Makes another version of a scene, as a build does: each has its own Gaussians, language, and fingerprints.

    All versions have as many Gaussians, so that numbers alone give no mix away.
    """

    def __init__(self, root) -> None:
        self.folder = SceneFolder.open(root)
        self.gaussians = self.folder.read_gaussians()
        self.tensors, self.metadata = read_tensors(self.folder.language_path)
        self.start = self.gaussians.means.clone()

    def begin(self, version: int) -> None:
        """The first half: new Gaussians beside the language of the old ones."""
        self.folder.reopen("reconstruct")
        self.gaussians.means.copy_(self.start + version)
        self.folder.write_gaussians(self.gaussians)
        self.folder.finish("reconstruct", f"version {version}", 0.0)

    def end(self, version: int) -> None:
        """The second half: the language that belongs to them."""
        self.folder.reopen("embed")
        tensors = {**self.tensors, "uncertainties": torch.full_like(self.tensors["uncertainties"], version)}
        metadata = {**self.metadata, "reconstruction": f"version {version}"}
        write_tensors(self.folder.language_path, tensors, metadata)
        self.folder.finish("embed", f"language {version}", 0.0)


def version_of(scene, start) -> tuple[int, int]:
    """The version of the Gaussians and that of the language."""
    moved = float((scene.gaussians.means - start).mean())
    return round(moved), round(float(scene.field.uncertainties.mean()))


def test_gaussians_that_change_while_a_scene_is_opened_are_told(scene, monkeypatch):
    builder = Builder(scene)
    builder.begin(1)
    builder.end(1)
    read = SceneFolder.read_gaussians

    def as_if_a_build_began(folder):
        builder.begin(2)
        return read(folder)

    monkeypatch.setattr(SceneFolder, "read_gaussians", as_if_a_build_began)
    with pytest.raises(SceneFolderError, match="files that change; the scene is being rebuilt"):
        open_scene(scene, device="cpu")
    monkeypatch.undo()
    with pytest.raises(SceneFolderError, match="being rebuilt"):
        open_scene(scene, device="cpu")
    builder.end(2)
    assert version_of(open_scene(scene, device="cpu"), builder.start) == (2, 2)


def test_many_questions_beside_many_builds_see_one_version_each(scene):
    builder = Builder(scene)
    builder.begin(1)
    builder.end(1)
    stop, wrong, seen = threading.Event(), [], []

    def ask() -> None:
        while not stop.is_set():
            try:
                opened = open_scene(scene, device="cpu")
            except SceneFolderError as error:
                seen.append(str(error))
                continue
            versions = version_of(opened, builder.start)
            seen.append(versions[0])
            if versions[0] != versions[1]:
                wrong.append(versions)

    askers = [threading.Thread(target=ask) for _ in range(3)]
    for asker in askers:
        asker.start()
    try:
        version = 1
        while len(seen) < 60 and not wrong:
            version += 1
            builder.begin(version)
            builder.end(version)
    finally:
        stop.set()
        for asker in askers:
            asker.join()
    assert not wrong
    assert all("\n" not in said for said in seen if isinstance(said, str))
    assert version_of(open_scene(scene, device="cpu"), builder.start) == (version, version)
