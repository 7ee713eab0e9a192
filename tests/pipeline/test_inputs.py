"""From photos alone, or a video, to a scene: by the command line, twice, and found again for evaluation."""

import json
import logging
import os
import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.rooms import (
    COUNT,
    FEW,
    SIZE,
    assert_same_up_to_a_similarity,
    room_cameras,
    room_photo,
    save_as_phone,
)
from support.written_captures import save

from lexsplat import cli
from lexsplat.captures import PoseConfig, load_annotations, load_capture, poses_from_photos
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.runtime.errors import SceneFolderError
from lexsplat.runtime.progress import Event
from lexsplat.scenes.folder import SceneFolder

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_size_features")]

QUICK = ["--device", "cpu", "--iterations", "2", "--downscale", "4", "--poses.max-features", str(FEW)]


def run(command: str, capture, output, *further: str) -> int:
    return cli.main([command, str(capture), "--output", str(output), *QUICK, *further])


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """The room as a phone stores it, with ground truth for one photo and a mask for another."""
    folder = tmp_path_factory.mktemp("phone")
    for index, camera in enumerate(room_cameras()):
        save_as_phone(folder / f"{index}.jpg", room_photo(camera), 6 if index % 2 else 1)
    save(folder / "unrelated.png", np.full((SIZE[1], SIZE[0], 3), 0.5))
    save(folder / "segmentations" / "3" / "wall.png", np.ones((SIZE[1], SIZE[0])))
    mask = np.ones((SIZE[1], SIZE[0]))
    mask[:40] = 0
    save(folder / "masks" / "5.png", mask)
    return folder


@pytest.fixture(scope="module")
def room_scene(photos, tmp_path_factory):
    output = tmp_path_factory.mktemp("scene") / "room"
    assert run("reconstruct", photos, output) == 0
    return output


def test_photos_alone_become_a_scene_of_upright_views(photos, room_scene):
    record = json.loads((room_scene / "scene.json").read_text())
    assert record["capture"] == str(photos)
    assert record["stages"]["poses"]["registered"] == COUNT
    assert record["stages"]["poses"]["unregistered"] == ["unrelated.png"]
    assert record["stages"]["poses"]["models"] == 1
    note = next(warning for warning in record["warnings"] if "photos registered" in warning)
    assert f"{COUNT} of {COUNT + 1} photos registered" in note
    assert "unregistered: unrelated.png" in note
    assert any("training photos are few" in warning for warning in record["warnings"])
    views = SceneFolder.open(room_scene).read_cameras()
    assert {name: view.split for name, view in views.items()} == {
        f"{index}.jpg": "test" if index == 3 else "train" for index in range(COUNT)
    }, "the photo with ground truth is held out"
    assert_same_up_to_a_similarity([views[f"{index}.jpg"].camera for index in range(COUNT)], room_cameras())


def test_a_finished_build_says_again_what_it_warned_of(photos, room_scene, caplog):
    assert run("reconstruct", photos, room_scene) == 0
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warned == json.loads((room_scene / "scene.json").read_text())["warnings"]


def test_reloading_finds_photos_ground_truth_and_masks(photos, room_scene, tmp_path):
    capture = reload_capture(SceneFolder.open(room_scene))
    assert len(capture.views) == COUNT
    assert capture.test_names == ("3.jpg",)
    assert list(load_annotations(capture).masks["3.jpg"]) == ["wall"]
    valid = {name: view.load_valid() for name, view in capture.views.items()}
    assert [name for name in valid if valid[name] is not None] == ["5.jpg"]
    assert 0.6 < valid["5.jpg"].mean() < 0.8
    moved = shutil.copytree(photos, tmp_path / "moved")
    assert reload_capture(SceneFolder.open(room_scene), moved).root == moved


def test_photos_are_registered_once_until_a_setting_changes(photos, room_scene, tmp_path):
    copy = shutil.copytree(room_scene, tmp_path / "copy")
    model = copy / "poses" / "sparse" / "0" / "images.bin"
    before = model.stat().st_mtime_ns
    assert run("reconstruct", photos, copy) == 0
    assert model.stat().st_mtime_ns == before
    assert run("reconstruct", photos, copy, "--poses.max-side", "239") == 0
    assert model.stat().st_mtime_ns != before


def test_copied_photos_keep_their_cameras_and_a_replaced_photo_of_the_same_size_does_not(
    photos, room_scene, tmp_path
):
    copy = shutil.copytree(room_scene, tmp_path / "copy")
    moved = shutil.copytree(photos, tmp_path / "moved", copy_function=shutil.copyfile)  # with other times
    model = copy / "poses" / "sparse" / "0" / "images.bin"
    before = model.stat().st_mtime_ns
    assert run("reconstruct", moved, copy) == 0
    assert model.stat().st_mtime_ns == before
    photo = moved / "unrelated.png"
    size = photo.stat().st_size
    save(photo, np.zeros((SIZE[1], SIZE[0], 3)))
    content = photo.read_bytes()
    photo.write_bytes(content + bytes(size - len(content)))  # readers ignore what follows the image
    assert photo.stat().st_size == size
    assert run("reconstruct", moved, copy) == 0
    assert model.stat().st_mtime_ns != before


def test_an_output_that_is_the_photos_folder_is_refused(photos, capsys):
    assert run("reconstruct", photos, photos) == 1
    assert "--output" in capsys.readouterr().err
    assert not (photos / "poses").exists()
    assert run("reconstruct", photos / "walk.mp4", photos.parent / "nothing") == 1
    assert "walk.mp4: expected a video, found no such file" in capsys.readouterr().err


def test_a_run_that_was_stopped_goes_on_with_its_features(tmp_path):
    folder, output, config = tmp_path / "photos", tmp_path / "out", PoseConfig(max_features=FEW)
    for index, camera in enumerate(room_cameras()):
        save(folder / f"{index}.png", room_photo(camera))

    def stop(event: Event) -> None:
        if event.stage == "poses" and event.done == COUNT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        poses_from_photos(folder, output, config, listener=stop)
    assert (output / ".poses" / "database.db").is_file()
    assert not (output / "sparse").exists()
    # Nothing is left to be seen in the photos: what is registered now is registered by features that were kept.
    for file in folder.iterdir():
        times, size = file.stat().st_mtime_ns, file.stat().st_size
        Image.new("RGB", SIZE).save(file)
        file.write_bytes(file.read_bytes().ljust(size, b"\0"))
        os.utime(file, ns=(times, times))
    poses = poses_from_photos(folder, output, config)
    assert len(poses.registered) == COUNT
    views = load_capture(output, images=folder, test_every=0).views
    assert_same_up_to_a_similarity([views[f"{i}.png"].camera for i in range(COUNT)], room_cameras())
    assert not (output / ".poses").exists()


def test_a_video_becomes_a_scene_that_needs_the_video_no_more(tmp_path):
    av = pytest.importorskip("av", reason="needs the extra `video` (PyAV)")
    video = tmp_path / "walk.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(10), options={"qscale": "2", "flags": "+qscale"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for camera in room_cameras():
            pixels = (room_photo(camera) * 255).astype(np.uint8)
            for _ in range(2):  # every picture twice: of the two, one is enough
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    output = tmp_path / "scene"
    assert run("reconstruct", video, output, "--frames", str(COUNT)) == 0
    frames = sorted(path.name for path in (output / "poses" / "images").glob("*.jpg"))
    assert len(frames) == COUNT
    assert len({int(name[6:12]) // 2 for name in frames}) == COUNT
    assert len(SceneFolder.open(output).read_cameras()) >= COUNT - 1
    video.unlink()
    capture = reload_capture(SceneFolder.open(output))
    assert next(iter(capture.views.values())).load_image().shape[2] == 3


def test_photos_that_are_gone_are_reported(tmp_path):
    folder = tmp_path / "photos"
    for index, camera in enumerate(room_cameras()[:5]):
        save(folder / f"{index}.png", room_photo(camera))
    assert run("reconstruct", folder, tmp_path / "scene", "--test-every", "0") == 0
    shutil.rmtree(folder)
    with pytest.raises(SceneFolderError, match="--capture"):
        reload_capture(SceneFolder.open(tmp_path / "scene"))
