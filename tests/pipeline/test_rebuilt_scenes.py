"""Queries to a scene during a rebuild: the old answer or the new one, never a mix, never none."""

from __future__ import annotations

import itertools
import shutil
import threading

import pytest
import torch
from support.tiny_capture import QUICK_BUILD

from lexsplat import cli, open_scene
from lexsplat.language.methods.averaged import Averaged
from lexsplat.runtime.errors import FileFormatError, SceneFolderError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import drop_previous, keep_previous

pytestmark = pytest.mark.slow


@pytest.fixture
def built_copy(built, tmp_path):
    return shutil.copytree(built, tmp_path / "scene")


class Builder:
    """Makes versions of a scene as a build does, each with its own Gaussians, language and fingerprints.

    All have the same number of Gaussians, so that shapes alone do not reveal a mix.
    """

    def __init__(self, root) -> None:
        self.folder = SceneFolder.open(root)
        self.gaussians = self.folder.read_gaussians()
        self.tensors, self.metadata = read_tensors(self.folder.language_path)
        self.start = self.gaussians.means.clone()

    def begin(self, version: int) -> None:
        """The first half: new Gaussians beside the language of the old ones."""
        self.start_anew()
        self.reconstruct(version)

    def start_anew(self) -> None:
        """What a build does before it makes its first file."""
        keep_previous(self.folder)
        self.folder.save()
        self.folder.reopen("reconstruct")

    def reconstruct(self, version: int) -> None:
        self.gaussians.means.copy_(self.start + version)
        self.folder.write_gaussians(self.gaussians)
        self.folder.finish("reconstruct", f"version {version}", 0.0)

    def end(self, version: int) -> None:
        """The second half: the language that belongs to them."""
        self.folder.reopen("language")
        own = torch.full(self.tensors["uncertainties"].shape, float(version))
        tensors = {**self.tensors, "uncertainties": own}
        metadata = {**self.metadata, "reconstruction": f"version {version}"}
        write_tensors(self.folder.language_path, tensors, metadata)
        self.folder.finish("language", f"language {version}", 0.0)
        self.folder.record.pop("building")
        self.folder.save()
        drop_previous(self.folder)


def version_of(scene, start) -> tuple[int, int]:
    """The version of the Gaussians and that of the language."""
    moved = float((scene.gaussians.means - start).mean())
    return round(moved), round(float(scene.field.uncertainties.mean()))


def test_the_previous_scene_answers_during_a_rebuild(built_copy):
    builder = Builder(built_copy)
    builder.begin(1)
    builder.end(1)
    builder.begin(2)
    opened = open_scene(built_copy, device="cpu")
    assert version_of(opened, builder.start) == (1, 1)
    assert opened.folder.root == built_copy, "what is written goes to the scene itself"
    builder.end(2)
    assert version_of(open_scene(built_copy, device="cpu"), builder.start) == (2, 2)
    assert not list(built_copy.glob("*previous*"))


def test_gaussians_that_change_during_opening_are_detected(built_copy, monkeypatch):
    builder = Builder(built_copy)
    builder.begin(1)
    builder.end(1)
    read = SceneFolder.read_gaussians
    begun = []

    def as_if_a_build_began(folder):
        if not begun:
            begun.append(builder.begin(2))
        return read(folder)

    monkeypatch.setattr(SceneFolder, "read_gaussians", as_if_a_build_began)
    assert version_of(open_scene(built_copy, device="cpu"), builder.start) == (1, 1)
    assert begun


def test_without_a_previous_scene_a_partial_rebuild_is_refused(built_copy):
    builder = Builder(built_copy)
    builder.begin(1)
    shutil.rmtree(built_copy / "previous")  # as if the folder was copied without it
    with pytest.raises(SceneFolderError, match="language of an earlier reconstruction"):
        open_scene(built_copy, device="cpu")


def test_the_previous_scene_has_the_permissions_of_the_scene(built_copy):
    built_copy.chmod(0o755)
    keep_previous(SceneFolder.open(built_copy))
    assert (built_copy / "previous").stat().st_mode & 0o777 == 0o755


def test_an_interrupted_build_leaves_the_last_complete_scene(built_copy):
    builder = Builder(built_copy)
    builder.begin(1)
    builder.end(1)
    builder.begin(2)
    again = Builder(
        built_copy
    )  # another build goes on: what it finds is not whole and must not replace what is kept
    again.begin(3)
    assert version_of(open_scene(built_copy, device="cpu"), builder.start) == (1, 1)


def test_a_scene_being_rebuilt_is_neither_evaluated_nor_edited(built_copy, capsys):
    builder = Builder(built_copy)
    builder.begin(1)
    for command in (["evaluate"], ["edit"]):
        arguments = [str(built_copy), *(["delete", "--select", "red ball"] if command == ["edit"] else [])]
        assert cli.main([*command, *arguments]) == 1
        assert "a build that is running or was interrupted" in capsys.readouterr().err
    assert cli.main(["query", str(built_copy), "red ball", "--json"]) == 0


def test_a_build_keeps_the_previous_scene_until_it_is_complete(built_copy, tiny_capture, monkeypatch):
    seen = []

    def stop(*_, **__):
        seen.append(open_scene(built_copy, device="cpu").folder.content.name)
        raise KeyboardInterrupt

    before = open_scene(built_copy, device="cpu").gaussians.means
    monkeypatch.setattr(Averaged, "fit", stop)
    changed = [*QUICK_BUILD, "--seed", "5"]
    assert cli.main(["build", str(tiny_capture), "--output", str(built_copy), *changed]) == 130
    assert seen == ["previous"]
    assert torch.equal(open_scene(built_copy, device="cpu").gaussians.means, before)
    monkeypatch.undo()
    assert cli.main(["build", str(tiny_capture), "--output", str(built_copy), *changed]) == 0
    assert not (built_copy / "previous").exists()
    assert not torch.equal(open_scene(built_copy, device="cpu").gaussians.means, before)


def test_a_reader_whose_version_the_next_build_replaces_reads_again(built_copy, monkeypatch):
    builder = Builder(built_copy)
    builder.begin(1)
    builder.end(1)
    builder.start_anew()
    whole, calls = SceneFolder.read_gaussians, itertools.count()

    def while_one_build_ends_and_another_starts(folder):
        if next(calls) == 0:
            builder.reconstruct(2)
            builder.end(2)
            builder.start_anew()
        return whole(folder)

    monkeypatch.setattr(SceneFolder, "read_gaussians", while_one_build_ends_and_another_starts)
    assert version_of(open_scene(built_copy, device="cpu"), builder.start) == (2, 2)
    assert next(calls) == 2, "it reads again"


@pytest.mark.parametrize("times", [1, 9])
def test_what_fails_once_is_read_again_and_what_fails_twice_is_damage(built_copy, monkeypatch, times):
    whole, calls = SceneFolder.read_gaussians, itertools.count()

    def damaged_at_first(folder):
        if next(calls) < times:
            raise FileFormatError(
                folder.gaussians_path, expected="a PLY", found="noise", remedy="build again"
            )
        return whole(folder)

    monkeypatch.setattr(SceneFolder, "read_gaussians", damaged_at_first)
    if times == 1:
        assert len(open_scene(built_copy, device="cpu").gaussians)
        return
    with pytest.raises(FileFormatError, match="noise"):
        open_scene(built_copy, device="cpu")
    assert next(calls) == 2


def test_builds_that_outrun_a_reader_are_reported_and_not_taken_for_damage(built_copy, monkeypatch):
    builder, version = Builder(built_copy), itertools.count(1)

    def as_if_builds_never_rest(folder):
        number = next(version)
        builder.begin(number)
        builder.end(number)
        raise FileFormatError(folder.gaussians_path, expected="a PLY", found="no file", remedy="build again")

    monkeypatch.setattr(SceneFolder, "read_gaussians", as_if_builds_never_rest)
    with pytest.raises(
        SceneFolderError, match="builds that changed it 5 times; ask again when they are done"
    ):
        open_scene(built_copy, device="cpu")


def test_many_questions_beside_many_builds_see_one_version_each(built_copy):
    builder = Builder(built_copy)
    builder.begin(1)
    builder.end(1)
    stop, answered = threading.Event(), threading.Event()
    wrong, seen, refused = [], [], []

    def ask() -> None:
        while not stop.is_set():
            try:
                opened = open_scene(built_copy, device="cpu")
            except SceneFolderError as error:
                refused.append(str(error))
                continue
            except Exception as error:  # would end this thread without a word
                wrong.append(error)
                return
            versions = version_of(opened, builder.start)
            seen.append(versions[0])
            answered.set()
            if versions[0] != versions[1]:
                wrong.append(versions)

    askers = [threading.Thread(target=ask) for _ in range(3)]
    for asker in askers:
        asker.start()
    try:
        version = 1
        while len(seen) < 60 and not wrong and version < 2000:
            version += 1
            for step in (builder.begin, builder.end):
                step(version)
                answered.wait(1)  # a busy machine slows readers and builder alike
                answered.clear()
    finally:
        stop.set()
        for asker in askers:
            asker.join()
    assert not wrong
    assert all("ask again when they are done" in said for said in refused)
    assert len(seen) >= 60
    assert version_of(open_scene(built_copy, device="cpu"), builder.start) == (version, version)
