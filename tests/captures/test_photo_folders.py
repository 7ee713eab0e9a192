"""What a folder of photos holds besides photos: hidden files, masks that are none, copies, and gray photos."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.refusals import assert_reports
from support.rooms import room_cameras, room_photo
from support.written_captures import save, write_transforms

from lexsplat.captures import load_capture, poses_from_photos
from lexsplat.captures.ground_truth.layouts import load_annotations
from lexsplat.captures.loading import is_photo_folder
from lexsplat.captures.sfm.preparation import find_photos, photo_folder, prepare_photos
from lexsplat.captures.sfm.remarks import copies_of
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import _photos_fingerprint, preview_capture
from lexsplat.runtime.errors import CaptureError

APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        "
"""The beginning of the files that macOS writes beside others."""


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Four color photos of noise, ``0.png`` to ``3.png``."""
    for index in range(4):
        save(tmp_path / "photos" / f"{index}.png", np.random.default_rng(index).random((30, 40, 3)))
    return tmp_path / "photos"


def notes_of(photos, tmp_path, word: str) -> list[str]:
    return [note for note in prepare_photos(photos, tmp_path / "out").notes if word in note]


# -- hidden files


def test_hidden_files_are_no_photos_and_are_counted(photos, tmp_path):
    assert notes_of(photos, tmp_path, "hidden") == []
    (photos / "._0.png").write_bytes(APPLE_DOUBLE)
    (photos / ".thumbnails").mkdir()
    save(photos / ".thumbnails" / "1.png", np.zeros((8, 8, 3)))
    (photos / ".DS_Store").write_bytes(b"no image")
    (photos / "._walk.mov").write_bytes(APPLE_DOUBLE)
    prepared = prepare_photos(photos, tmp_path / "out")
    assert prepared.names == ("0.png", "1.png", "2.png", "3.png")
    assert [note for note in prepared.notes if "hidden" in note] == [
        f"{photos}: 2 hidden files are left out: ._0.png, .thumbnails/1.png"
    ]
    assert not any("video" in note for note in prepared.notes)


def test_a_folder_within_a_hidden_one_is_read(tmp_path):
    save(tmp_path / ".cache" / "photos" / "0.png", np.zeros((8, 8, 3)))
    assert find_photos(tmp_path / ".cache" / "photos") == ["0.png"]


def test_a_folder_with_nothing_but_hidden_photos_is_none_of_photos(tmp_path):
    (tmp_path / "._0.jpg").write_bytes(APPLE_DOUBLE)
    assert not is_photo_folder(tmp_path)
    save(tmp_path / "images" / "0.png", np.zeros((8, 8, 3)))
    assert photo_folder(tmp_path) == tmp_path / "images"


def test_hidden_files_are_no_masks_and_are_counted(photos, tmp_path):
    save(photos / "masks" / "0.png", np.ones((30, 40, 3)))
    (photos / "masks" / "._0.png").write_bytes(APPLE_DOUBLE)
    place = photos / "masks"
    notes = prepare_photos(photos, tmp_path / "out").notes
    assert [note for note in notes if str(place) in note] == [f"{place}: 1 hidden file is left out: ._0.png"]


def test_hidden_files_change_no_poses(photos, tmp_path):
    def key() -> str:
        return _photos_fingerprint(photos, photos, tmp_path / "scene", BuildConfig())

    save(photos / "masks" / "0.png", np.ones((30, 40, 3)))
    before = key()
    for name in ("._0.png", "masks/._0.png", "masks/.DS_Store"):
        (photos / name).write_bytes(APPLE_DOUBLE)
    assert key() == before


def test_hidden_files_are_no_ground_truth(tmp_path):
    write_transforms(tmp_path, ["a.png", "b.png", "c.png"])
    mask = np.zeros((48, 64, 3))
    mask[10:20, 10:20] = 1
    save(tmp_path / "segmentations" / "a" / "mug.png", mask)
    (tmp_path / "segmentations" / "a" / "._mug.png").write_bytes(APPLE_DOUBLE)
    (tmp_path / "segmentations" / "b").mkdir()
    (tmp_path / "segmentations" / "b" / "._mug.png").write_bytes(APPLE_DOUBLE)
    capture = load_capture(tmp_path)
    assert capture.test_names == ("a.png",)
    found = load_annotations(capture)
    assert found is not None
    assert {name: list(masks) for name, masks in found.masks.items()} == {"a.png": ["mug"]}


# -- masks


@pytest.mark.parametrize(
    ("mask", "wanted"), [("0.jpg", "0.png"), ("0.png.jpg", "0.png.png"), ("1.webp", "1.png")]
)
def test_a_mask_of_a_photo_that_is_no_png_is_told_to_be_one(photos, tmp_path, mask, wanted):
    save(photos / "masks" / mask, np.ones((30, 40, 3)))
    (note,) = notes_of(photos, tmp_path, "mask")
    assert note == f"{photos / 'masks'}: 1 mask is ignored: masks must be PNG, such as {wanted}; found {mask}"


def test_a_mask_of_no_photo_is_told_to_be_one(photos, tmp_path):
    save(photos / "masks" / "nowhere.jpg", np.ones((30, 40, 3)))
    (note,) = notes_of(photos, tmp_path, "mask")
    assert note.endswith("1 mask matches no photo and is ignored: nowhere.jpg")


@pytest.mark.slow
def test_a_photo_without_a_pose_is_told_to_have_a_black_mask_or_to_be_transparent(tmp_path):
    folder = tmp_path / "photos"
    for index, camera in enumerate(room_cameras()[:6]):
        save(folder / f"{index}.png", room_photo(camera))
    save(folder / "masks" / "5.png", np.zeros((180, 240, 3)))
    with Image.open(folder / "4.png") as image:
        image.putalpha(0)
        image.save(folder / "4.png")
    found = poses_from_photos(folder, tmp_path / "out")
    assert found.unregistered == ("4.png", "5.png")
    assert found.reasons["5.png"] == "has a mask that is black throughout: black is ignored, white is used"
    assert found.reasons["4.png"] == "is transparent wherever it is not masked"


def test_masks_that_leave_nothing_of_any_photo_are_refused(photos, tmp_path):
    for index in range(4):
        save(photos / "masks" / f"{index}.png", np.zeros((30, 40, 3)))
    with pytest.raises(CaptureError) as caught:
        prepare_photos(photos, tmp_path / "out")
    assert_reports(caught.value, str(photos), "masked throughout", "invert them")
    assert not (tmp_path / "out" / "masks").exists()


def test_the_mask_of_a_photo_without_a_pose_is_no_mistake(tmp_path):
    write_transforms(tmp_path, ["a.png", "b.png"])
    save(tmp_path / "images" / "unposed.png", np.zeros((48, 64, 3)))
    save(tmp_path / "masks" / "unposed.png", np.ones((48, 64)))
    assert load_capture(tmp_path).warnings == ()
    save(tmp_path / "masks" / "nowhere.png", np.ones((48, 64)))
    (warning,) = load_capture(tmp_path).warnings
    assert warning.endswith("1 mask matches no photo and is ignored: nowhere.png")


# -- copies


def test_exact_copies_of_photos_are_left_out_with_one_note(photos, tmp_path):
    content = (photos / "1.png").read_bytes()
    for name in ("1 copy.png", "1 (2).png"):
        (photos / name).write_bytes(content)
    prepared = prepare_photos(photos, tmp_path / "out")
    assert prepared.names == ("0.png", "1.png", "2.png", "3.png")
    assert [note for note in prepared.notes if "cop" in note] == [
        f"{photos}: 2 photos are exact copies of another one and left out, such as 1 (2).png, a copy of 1.png"
    ]
    capture = preview_capture(photos, tmp_path / "scene", BuildConfig(test_every=2))
    assert capture is not None
    assert set(capture.views) == {"0.png", "1.png", "2.png", "3.png"}


def test_photos_of_one_size_whose_bytes_differ_in_the_middle_are_no_copies(tmp_path):
    content = bytearray(np.random.default_rng(0).bytes(400_000))
    (tmp_path / "a.bmp").write_bytes(content)
    (tmp_path / "c.bmp").write_bytes(content)
    content[200_000] ^= 1
    (tmp_path / "b.bmp").write_bytes(content)
    assert copies_of(tmp_path, ["a.bmp", "b.bmp", "c.bmp"]) == {"c.bmp": "a.bmp"}


def test_files_of_different_sizes_are_not_read(photos, monkeypatch):
    def refuse(path):
        raise AssertionError(path)

    monkeypatch.setattr("lexsplat.captures.sfm.remarks.file_sample", refuse)
    for index in range(4):
        (photos / f"{index}.png").write_bytes(b"0" * (100 + index))
    assert copies_of(photos, find_photos(photos)) == {}


def test_copies_do_not_count_as_photos(tmp_path):
    for index in range(4):
        save(tmp_path / f"{index}.png", np.full((30, 40, 3), 0.5 * (index > 2)))
    with pytest.raises(CaptureError) as caught:
        prepare_photos(tmp_path, tmp_path / "out")
    assert_reports(caught.value, "at least 3 photos", "found 2; 2 photos are exact copies")


def test_the_mask_of_a_copy_is_no_mistake(photos, tmp_path):
    (photos / "1 copy.png").write_bytes((photos / "1.png").read_bytes())
    for name in ("1.png", "1 copy.png"):
        save(photos / "masks" / name, np.ones((30, 40, 3)))
    assert notes_of(photos, tmp_path, "no photo") == []


def test_copies_among_photos_with_cameras_are_told(tmp_path):
    write_transforms(tmp_path, ["a.png", "b.png", "c.png"])
    assert load_capture(tmp_path).warnings == ()
    (tmp_path / "images" / "b.png").write_bytes((tmp_path / "images" / "c.png").read_bytes())
    capture = load_capture(tmp_path)
    (warning,) = capture.warnings
    assert "1 photo is an exact copy of another one, such as c.png, a copy of b.png" in warning
    assert set(capture.views) == {"a.png", "b.png", "c.png"}, "each has a camera"


# -- gray photos


@pytest.mark.parametrize("kind", ["L", "RGB", "jpg", "LA"])
def test_gray_photos_among_color_ones_are_named_in_one_note(photos, tmp_path, kind):
    assert notes_of(photos, tmp_path, "gray") == []
    suffix = "jpg" if kind == "jpg" else "png"
    pixels = (np.random.default_rng(9).random((30, 40)) * 255).astype(np.uint8)
    Image.fromarray(pixels).convert("RGB" if kind == "jpg" else kind).save(photos / f"gray.{suffix}")
    (note,) = notes_of(photos, tmp_path, "gray among color ones")
    assert note.startswith(f"{photos}: 1 photo is gray among color ones: gray.{suffix};")


def test_a_capture_of_gray_photos_needs_no_note(photos, tmp_path):
    for index in range(4):
        with Image.open(photos / f"{index}.png") as image:
            image.convert("L").save(photos / f"{index}.png")
    assert notes_of(photos, tmp_path, "gray") == []
