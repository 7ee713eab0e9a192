import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps
from support.poses import move
from support.refusals import assert_reports, fails
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

from lexsplat.captures import PoseConfig, load_capture, poses_from_photos
from lexsplat.captures.sfm import counting, mapping, photos
from lexsplat.captures.sfm.preparation import find_photos, prepare_photos, turned_upright
from lexsplat.captures.sfm.pycolmap_import import quiet_pycolmap
from lexsplat.runtime.errors import CaptureError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_size_features")]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for index, camera in enumerate(room_cameras()):
        save(folder / f"{index}.png", room_photo(camera))
    save(folder / "unrelated.png", np.full((SIZE[1], SIZE[0], 3), 0.5))
    events, output, config = [], tmp_path_factory.mktemp("poses"), PoseConfig(max_features=FEW)
    return folder, poses_from_photos(folder, output, config, listener=events.append), events


def test_photos_are_registered_and_the_unregistered_one_is_named(room):
    _, poses, events = room
    assert poses.registered == tuple(f"{index}.png" for index in range(COUNT))
    assert poses.unregistered == ("unrelated.png",)
    assert "9 of 10 photos registered" in poses.note
    assert events[-1].done == events[-1].total
    assert events[-1].metrics == {"registered": 9, "photos": 10}


def test_photos_of_several_sizes_and_lenses_all_have_features(tmp_path):
    folder = tmp_path / "photos"
    for index, camera in enumerate(room_cameras()[:6]):
        photo = room_photo(camera)
        save(folder / f"{index}.png", (photo, photo[:, 40:-40], photo[::2, ::2])[index % 3])
    prepared = prepare_photos(folder, tmp_path / "out")
    assert len(prepared.lenses) == 3
    database = tmp_path / "database.db"
    with quiet_pycolmap(0):
        mapping.extract_features(database, prepared, PoseConfig(), 4 << 30, lambda done: None)
    with pycolmap.Database.open(database) as opened:
        counts = {
            each.name: opened.num_keypoints_for_image(each.image_id) for each in opened.read_all_images()
        }
    assert sorted(counts) == [f"{index}.png" for index in range(6)]
    assert min(counts.values()) > 30, counts  # of the photos of half the size


def test_each_unregistered_photo_has_its_reason(room, tmp_path):
    folder, poses, _ = room
    assert poses.note.endswith(
        "unregistered: unrelated.png (has nothing to match: blurred, dark or without texture)"
    )
    noise = np.random.default_rng(0).random((SIZE[1], SIZE[0], 3))
    for index in range(4):
        shutil.copy(folder / f"{index}.png", tmp_path)
    save(tmp_path / "noise.png", noise)
    found = poses_from_photos(tmp_path, tmp_path / "out", PoseConfig(max_features=FEW))
    assert found.note.endswith("unregistered: noise.png (matches no other photo)")


def test_progress_counts_the_pairs_of_photos(room):
    _, _, events = room
    pairs = [event for event in events if event.stage == "matching"]
    assert {event.total for event in pairs} == {45}, "ten photos"
    counts = [event.done for event in pairs]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, 45)


@pytest.mark.parametrize(("pairs", "number"), [("exhaustive", 45), ("sequential", 25)])
def test_the_number_of_pairs_is_the_one_that_pycolmap_matches(pairs, number, room, tmp_path, monkeypatch):
    folder, _, _ = room
    monkeypatch.setattr(counting, "_EVERY", 0.01)
    prepared, found, config = prepare_photos(folder, tmp_path), [], PoseConfig(pairs=pairs, max_features=300)
    database = tmp_path / "database.db"
    with quiet_pycolmap(0):
        mapping.extract_features(database, prepared, config, 1 << 30, lambda done: None)
        mapping.match_photos(
            database, 10, config, 0, 1 << 30, lambda done, total: found.append((done, total))
        )
    assert found[-1] == (number, number)
    with counting.counts_of(database) as counts:
        assert next(counts) == number
    assert len({done for done, _ in found}) > 2, "it is counted meanwhile"


def test_estimated_poses_are_the_true_ones_up_to_a_similarity(room):
    folder, poses, _ = room
    capture = load_capture(poses.root, images=folder, test_every=0)
    found = [capture.views[f"{index}.png"].camera for index in range(COUNT)]
    assert_same_up_to_a_similarity(found, room_cameras())
    assert len(capture.points) == poses.points > 200
    assert poses.images == folder, "photos that need nothing are not copied"
    assert not (poses.root / "images").exists()
    assert not (poses.root / ".poses").exists(), "what was worked with is gone"


def test_a_mis_registered_photo_is_registered_again(room, tmp_path, monkeypatch):
    folder, _, _ = room
    original, moved = pycolmap.incremental_mapping, []

    def misled_once(*arguments, **options):
        found = original(*arguments, **options)
        if not moved:
            moved.extend(
                number for number in found[0].reg_image_ids() if found[0].image(number).name == "4.png"
            )
            move(found[0], moved[0])
        return found

    monkeypatch.setattr(pycolmap, "incremental_mapping", misled_once)
    poses = poses_from_photos(folder, tmp_path / "poses", PoseConfig(max_features=FEW))
    assert moved, "there was something to put right"
    capture = load_capture(poses.root, images=folder, test_every=0)
    assert_same_up_to_a_similarity(
        [capture.views[f"{index}.png"].camera for index in range(COUNT)], room_cameras()
    )


def test_folders_that_are_not_captures_are_refused(tmp_path):
    for folder, found in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "found 0")):
        with pytest.raises(CaptureError) as caught:
            poses_from_photos(folder, tmp_path / "out")
        assert_reports(caught.value, str(folder), found)


def test_photos_that_do_not_overlap_leave_no_output(tmp_path):
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", np.full((60, 80, 3), 0.3 * index))
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "out")
    assert_reports(caught.value, "3 photos, none of which")
    assert not (tmp_path / "out").exists()
    (tmp_path / "photos" / "1.png").write_bytes(b"no image")
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "out")
    assert_reports(caught.value, "1.png")
    fails(tmp_path / "photos", "lexsplat poses")


def smooth(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width] / 40
    return np.stack([0.5 + 0.4 * np.sin(x + 2 * y), 0.5 + 0.4 * np.cos(2 * x - y), 0.3 + 0.01 * x], -1)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_rotated_as_by_pillow(tmp_path, orientation):
    save_as_phone(tmp_path / "a.jpg", smooth(30, 50), orientation)
    with Image.open(tmp_path / "a.jpg") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
        np.testing.assert_array_equal(turned_upright(np.asarray(image), orientation), expected)
    assert expected.shape == (30, 50, 3)


def test_rotated_photos_are_copied_upright_and_keep_their_focal_length(tmp_path):
    """COLMAP's rule for a focal length on 35 mm film: the diagonals of film (43.27 mm) and image correspond."""
    folder = tmp_path / "photos"
    for index, orientation in enumerate((1, 6, 3, 8)):
        save_as_phone(folder / "day" / f"{index}.jpg", smooth(120, 160), orientation, 28)
    save_as_phone(folder / "zoomed.jpg", smooth(120, 160), 6, 56)
    save_as_phone(folder / "unknown.jpg", smooth(120, 160), 1, None)
    prepared = prepare_photos(folder, tmp_path / "out")
    assert prepared.images == tmp_path / "out" / "images"
    assert prepared.names == tuple(find_photos(folder))
    for name in prepared.names:
        copy = Image.open(prepared.images / name)
        assert copy.getexif().get(0x0112, 1) == 1
        assert np.abs(np.asarray(copy) / 255 - smooth(120, 160)).mean() < 0.01
    groups = {frozenset(group) for group in prepared.lenses}
    assert groups == {
        frozenset(f"day/{index}.jpg" for index in range(4)),
        frozenset({"zoomed.jpg"}),
        frozenset({"unknown.jpg"}),
    }
    database_path = tmp_path / "database.db"
    pycolmap.Database.open(database_path).close()
    for group in prepared.lenses:
        pycolmap.import_images(database_path, prepared.images, pycolmap.CameraMode.SINGLE, list(group))
    database = pycolmap.Database.open(database_path)
    cameras = {image.name: database.read_camera(image.camera_id) for image in database.read_all_images()}
    database.close()
    for name, focal in (("day/1.jpg", 28), ("day/0.jpg", 28), ("zoomed.jpg", 56)):
        assert (cameras[name].width, cameras[name].height) == (160, 120)
        assert cameras[name].has_prior_focal_length
        assert cameras[name].focal_length == pytest.approx(focal * 200 / 43.2666, rel=1e-3)
    assert not cameras["unknown.jpg"].has_prior_focal_length
    before = {name: (prepared.images / name).stat().st_mtime_ns for name in prepared.names}
    again = prepare_photos(folder, tmp_path / "out")
    assert again.names == prepared.names
    assert before == {name: (prepared.images / name).stat().st_mtime_ns for name in prepared.names}


def test_photos_of_other_formats_are_converted_under_unique_names(tmp_path):
    folder = tmp_path / "photos"
    save(folder / "a.png", smooth(40, 60))
    pixels = (smooth(40, 60) * 255).astype(np.uint8)
    Image.fromarray(pixels).convert("CMYK").save(folder / "b.jpg")
    Image.fromarray(pixels).save(folder / "a.webp", lossless=True)
    Image.fromarray(pixels).convert("RGBA").save(folder / "c.png")
    prepared = prepare_photos(folder, tmp_path / "out")
    assert prepared.names == ("a.jpg", "a.png", "b.jpg", "c.png")
    for name in prepared.names:
        with Image.open(prepared.images / name) as image:
            assert image.mode == "RGB"
            assert np.abs(np.asarray(image) / 255 - smooth(40, 60)).mean() < 0.03, name


def test_masks_ground_truth_and_the_output_are_not_photos(tmp_path):
    for name in ("1.png", "walk/2.png", "masks/1.png", "segmentations/1/mug.png", "out/heatmaps/mug/1.png"):
        save(tmp_path / name, np.zeros((8, 8, 3)))
    assert find_photos(tmp_path, tmp_path / "out") == ["1.png", "walk/2.png"]


@pytest.fixture(scope="module")
def phone(tmp_path_factory):
    """The room as photographed by a phone: rotated, with a masked sticker on the lens; uses the global mapper."""
    folder = tmp_path_factory.mktemp("phone")
    sticker = np.random.default_rng(5).random((90, 70, 3)).repeat(2, 0)[:90].repeat(2, 1)[:, :70]
    for index, camera in enumerate(room_cameras()):
        photo = room_photo(camera)
        if index == 4:  # without the sticker
            save_as_phone(folder / "images" / f"{index}.jpg", photo, 6)
            continue
        photo[-90:, -70:] = sticker
        save_as_phone(folder / "images" / f"{index}.jpg", photo, (6, 8, 3)[index % 3])
        mask = np.ones((SIZE[1], SIZE[0]))
        mask[-90:, -70:] = 0
        # Half of the masks have COLMAP's names and are nearly black; others have stems as names and half the size.
        if index % 2:
            save(folder / "masks" / f"{index}.jpg.png", mask * 3 / 255)
        else:
            save(folder / "masks" / f"{index}.png", mask[::2, ::2])
    save(folder / "masks" / "nobody.png", np.ones((4, 4)))
    config = PoseConfig(mapper="global", max_features=FEW)
    return folder, poses_from_photos(folder, tmp_path_factory.mktemp("poses"), config)


def test_rotated_photos_get_the_true_upright_cameras(phone):
    _, poses = phone
    assert len(poses.registered) == COUNT, poses.note
    capture = load_capture(poses.root, images=poses.images, test_every=0)
    found = [capture.views[f"{index}.jpg"].camera for index in range(COUNT)]
    assert {(view.lens.width, view.lens.height) for view in capture.views.values()} == {SIZE}
    assert_same_up_to_a_similarity(found, room_cameras())


def test_masked_pixels_yield_no_features(phone):
    _, poses = phone
    model = pycolmap.Reconstruction(poses.root / "sparse" / "0")
    for image in model.images.values():
        places = np.array([point.xy for point in image.points2D])
        assert len(places) > 100
        if image.name == "4.jpg":
            continue
        hidden = (places[:, 0] > SIZE[0] - 68) & (places[:, 1] > SIZE[1] - 88)
        assert not hidden.any()
    assert any("nobody.png" in note for note in poses.notes)
    valid = load_capture(poses.root, images=poses.images, test_every=0).views["0.jpg"].load_valid()
    assert not valid[-88:, -68:].any()
    assert valid[:80].all()


def test_photos_left_over_by_sequential_matching_are_matched_with_all(tmp_path, monkeypatch):
    """Each photo is matched with the next one only, which has no features: every second photo is blank."""
    monkeypatch.setattr(photos, "EXHAUSTIVE_LIMIT", 3)
    monkeypatch.setattr(mapping, "SEQUENTIAL_OVERLAP", 1)
    paths, cameras = (tmp_path / "photos", tmp_path / "out"), room_cameras()
    for index, camera in enumerate(cameras):
        save(tmp_path / "photos" / f"{index}.png", room_photo(camera))
        save(tmp_path / "photos" / f"{index}blank.png", np.full((SIZE[1], SIZE[0], 3), index / 9))
    with pytest.raises(CaptureError, match="none of which could be registered"):
        poses_from_photos(*paths, PoseConfig(pairs="sequential", max_features=FEW))
    poses = poses_from_photos(*paths, PoseConfig(max_features=FEW))
    assert poses.registered == tuple(f"{index}.png" for index in range(COUNT))
    assert (
        f'found by the mapper "{poses.mapper}" after all pairs of the unregistered photos were matched'
        in poses.note
    )
    views = load_capture(poses.root, images=poses.images, test_every=0).views
    assert_same_up_to_a_similarity([views[f"{index}.png"].camera for index in range(COUNT)], cameras)


def test_a_mask_of_another_aspect_is_refused_before_any_work(tmp_path):
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", smooth(40, 60) / (index + 1))
    save(tmp_path / "photos" / "masks" / "1.png", np.ones((60, 40)))
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "out")
    assert_reports(caught.value, "1.png", "60x40", "40x60")
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "photos")
    assert_reports(caught.value, "--output")


def three_photos(folder, suffix: str = ".jpg") -> None:
    for index in range(3):
        save(folder / f"{index}{suffix}", np.random.default_rng(index).random((96, 128, 3)))


def test_a_truncated_photo_is_refused_before_any_work(tmp_path):
    """pycolmap would use the gray half as image content, and training would fail on the photo later."""
    three_photos(tmp_path / "photos")
    path = tmp_path / "photos" / "1.jpg"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError) as caught:
        prepare_photos(tmp_path / "photos", tmp_path / "output")
    assert_reports(caught.value, "1.jpg", "damaged", "truncated")
    assert not (tmp_path / "output").exists()


def test_all_photos_that_cannot_be_read_are_named_at_once(tmp_path):
    three_photos(tmp_path / "photos")
    for name in ("x.jpg", "y.jpg"):
        (tmp_path / "photos" / name).write_bytes(f"no img {name[0]}".encode())
    with pytest.raises(CaptureError, match="2 that are not, the first: 8 bytes") as error:
        prepare_photos(tmp_path / "photos", tmp_path / "output")
    assert "x.jpg" in str(error.value)
    assert "y.jpg" in str(error.value)


def test_a_tiny_photo_is_no_damaged_one(tmp_path):
    three_photos(tmp_path / "photos")
    Image.new("RGB", (4, 4)).save(tmp_path / "photos" / "tiny.jpg")
    assert "tiny.jpg" in prepare_photos(tmp_path / "photos", tmp_path / "output").names


def test_images_of_formats_that_are_not_read_are_named(tmp_path):
    three_photos(tmp_path / "photos")
    Image.new("L", (8, 8)).save(tmp_path / "photos" / "moving.gif")
    (note,) = prepare_photos(tmp_path / "photos", tmp_path / "output").notes
    assert "moving.gif is left out: its format is not read; save as JPEG or PNG" in note
    for path in (tmp_path / "photos").glob("*.jpg"):
        path.unlink()
    with pytest.raises(CaptureError, match=r"found 0; moving\.gif is left out"):
        prepare_photos(tmp_path / "photos", tmp_path / "output")


def test_a_video_beside_photos_is_left_out_and_one_alone_is_to_be_given_itself(tmp_path):
    folder = tmp_path / "photos"
    three_photos(folder)
    (folder / "walk.MP4").touch()
    (note,) = prepare_photos(folder, tmp_path / "out").notes
    assert note.startswith(f"{folder}: walk.MP4 is left out: a video is given by itself")
    for path in folder.glob("*.jpg"):
        path.unlink()
    with pytest.raises(CaptureError, match=r"found 0; walk\.MP4 is left out.*; give .*photos/walk\.MP4$"):
        prepare_photos(folder, tmp_path / "out")


def test_photos_that_differ_in_their_endings_only_are_noted(tmp_path):
    (tmp_path / "photos/in").mkdir(parents=True)
    for index, name in enumerate(("c01.png", "c01.jpg", "in/c02.png", "in/c02.webp", "c02.png")):
        Image.new("L", (8, 8), index).save(tmp_path / "photos" / name)
    twins = prepare_photos(tmp_path / "photos", tmp_path / "out").notes[0]
    told = (
        "2 pairs of photos with one name and two endings, such as c01.jpg and c01.png: the same shot twice?"
    )
    assert told in twins


@pytest.mark.parametrize("name", [b"a\nb.jpg", b"a\\b.jpg", b"\xff\xfe.jpg", b"sub\x7f/a.jpg"])
def test_names_that_camera_files_cannot_hold_are_refused_before_any_work(tmp_path, name):
    three_photos(tmp_path / "photos")
    path = Path(os.fsdecode(os.fsencode(tmp_path / "photos") + b"/" + name))
    path.parent.mkdir(exist_ok=True)
    shutil.copy(tmp_path / "photos" / "0.jpg", path)
    with pytest.raises(CaptureError) as caught:
        prepare_photos(tmp_path / "photos", tmp_path / "output")
    assert_reports(caught.value, "photos", "rename")
    str(caught.value).encode("utf-8")


@pytest.mark.parametrize(
    "name", ["100%.jpg", "%s.jpg", "\U0001f600.jpg", "[red]{x}.jpg", "2.JPG", "a'b \"c.jpg"]
)
def test_photos_may_have_unusual_names(tmp_path, name):
    three_photos(tmp_path / "photos")
    (tmp_path / "photos" / "0.jpg").rename(tmp_path / "photos" / name)
    assert name in prepare_photos(tmp_path / "photos", tmp_path / "output").names


def test_invalid_settings_are_refused():
    with pytest.raises(ValueError, match="max_side"):
        PoseConfig(max_side=10)
    assert PoseConfig().compares_all(80)
    assert not PoseConfig().compares_all(81)
    assert not PoseConfig(pairs="sequential").compares_all(5)
    assert PoseConfig(pairs="exhaustive").compares_all(500)
