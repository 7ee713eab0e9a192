"""Scene folder: whole files or none, stages that know what they were made from."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.forks import PROCESSES

from lexsplat.geometry.cameras import look_at
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.runtime.files import atomic_path
from lexsplat.scenes.folder import SceneFolder, refuse_within_scene
from lexsplat.scenes.views import StoredView, view_named


def test_a_stage_is_finished_only_for_the_same_inputs(tmp_path):
    folder = SceneFolder(tmp_path)
    folder.finish("reconstruct", "abc", 1.5, gaussians=10)
    again = SceneFolder.open(tmp_path)
    assert again.is_finished("reconstruct", "abc")
    assert not again.is_finished("reconstruct", "abd")
    assert not again.is_finished("language", "abc")
    again.reopen("reconstruct")
    assert not SceneFolder.open(tmp_path).is_finished("reconstruct", "abc")


def test_cameras_and_code_maps_survive(tmp_path):
    folder = SceneFolder(tmp_path)
    camera = look_at([0, -3, 1], [0, 0, 0], [0, 0, 1], 32, 24, 0.8)
    folder.write_cameras({"a/b.jpg": (camera, "test")})
    view = folder.read_cameras()["a/b.jpg"]
    assert (view.split, view.camera.width, view.camera.height) == ("test", 32, 24)
    np.testing.assert_array_equal(view.camera.viewmat, camera.viewmat)
    codes = np.arange(256, dtype=np.uint8).reshape(8, 32)
    folder.write_code_map("a/b.jpg", codes)
    np.testing.assert_array_equal(folder.read_code_map("a/b.jpg"), codes)


def test_the_error_for_a_folder_without_a_scene_names_the_build_command(tmp_path):
    with pytest.raises(SceneFolderError, match=r"lexsplat build CAPTURE --output SCENE"):
        SceneFolder.open(tmp_path / "nowhere")


def test_the_error_for_splats_names_the_command_that_makes_a_scene_of_them(tmp_path):
    splats = tmp_path / "my room.ply"
    splats.write_bytes(b"ply\n")
    with pytest.raises(SceneFolderError, match=r"lexsplat language --splats '.*my room.ply' --output SCENE"):
        SceneFolder.open(splats)


def test_another_format_version_is_refused(tmp_path):
    (tmp_path / "scene.json").write_text(json.dumps({"format_version": 99, "stages": {}}))
    with pytest.raises(SceneFolderError, match="format_version 1, found 99"):
        SceneFolder.open(tmp_path)


def _hold(root: str, ready, release) -> None:
    with SceneFolder(Path(root)).locked():
        ready.set()
        release.wait(30)


@pytest.mark.slow
def test_a_second_build_is_refused_with_the_process_of_the_first(tmp_path):
    ready, release = PROCESSES.Event(), PROCESSES.Event()
    process = PROCESSES.Process(target=_hold, args=(str(tmp_path), ready, release))
    process.start()
    try:
        assert ready.wait(60)
        with pytest.raises(SceneFolderError, match=str(process.pid)), SceneFolder(tmp_path).locked():
            pass
    finally:
        release.set()
        process.join(30)
    with SceneFolder(tmp_path).locked():
        pass


def test_a_build_removes_only_temporary_files_of_dead_processes(tmp_path):
    dead = PROCESSES.Process(target=int)
    dead.start()
    dead.join()
    folder = SceneFolder(tmp_path / "scene")
    folder.root.mkdir()
    left = folder.root / "codes" / f".a.png.{dead.pid}.1.tmp"
    left.parent.mkdir()
    left.write_bytes(b"half")
    others = folder.root / ".notes.tmp"
    others.write_text("not ours")
    with atomic_path(folder.root / "text.safetensors") as being_written:
        being_written.write_bytes(b"a query writes this while a build begins")
        with folder.locked():
            pass
        assert being_written.exists()
    assert not left.exists()
    assert others.exists()


def test_a_working_directory_with_other_files_is_no_output(tmp_path, monkeypatch):
    """An empty name, as of a variable that is not set, means it."""
    monkeypatch.chdir(tmp_path)
    SceneFolder(Path("")).refuse_foreign_files()
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SceneFolderError, match=r"the working directory .*; give --output a name"):
        SceneFolder(Path("")).refuse_foreign_files()
    (tmp_path / "scene.json").write_text("{}")
    folder = SceneFolder(tmp_path / "elsewhere")
    folder.root.mkdir()
    folder.refuse_foreign_files()


def views_of(*names: str) -> dict[str, StoredView]:
    camera = look_at([0, -3, 1], [0, 0, 0], [0, 0, 1], 32, 24, 0.8)
    return {name: StoredView(name, camera, "train") for name in names}


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("x.jpg", "x.jpg"),
        ("x", "x.jpg"),
        ("a.b", "a.b.png"),
        ("left/0001", "left/0001.jpg"),
        ("0001.png", "right/0001.png"),
        ("0002", "right/0002.png"),
    ],
)
def test_a_view_is_named_with_or_without_its_folder_and_its_suffix(name, found):
    views = views_of("x.jpg", "a.b.png", "left/0001.jpg", "right/0001.png", "right/0002.png")
    assert view_named(views, name).name == found


@pytest.mark.parametrize(
    ("name", "views", "found"),
    [
        ("photos_of_another_capture/view_033", ("view_033.jpg",), "no match"),
        ("left/0001", ("right/0001.jpg",), "no match"),
        ("x.v2", ("x.jpg",), "no match"),
        ("x.png", ("x.jpg",), "no match"),
        ("0001", ("left/0001.jpg", "right/0001.jpg"), "2 matches"),
        ("", ("x.jpg",), "no match"),
    ],
)
def test_a_folder_or_suffix_that_is_given_must_be_that_of_the_view(name, views, found):
    with pytest.raises(QueryError, match=f"found {found}; the scene has {len(views)} views, such as "):
        view_named(views_of(*views), name)


def test_nothing_else_is_written_into_a_scene(tmp_path):
    SceneFolder(tmp_path / "scene").save()
    refuse_within_scene(tmp_path / "page")
    refuse_within_scene(tmp_path / "scene")  # a build goes on there
    for path in (tmp_path / "scene" / "page", tmp_path / "scene" / "a" / "b"):
        with pytest.raises(
            SceneFolderError, match=rf"found one in the scene {tmp_path / 'scene'}; give a folder"
        ):
            refuse_within_scene(path)
