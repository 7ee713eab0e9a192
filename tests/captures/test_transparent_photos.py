"""Transparent pixels of photos are ignored, as masked ones are."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.refusals import assert_reports
from support.written_captures import HEIGHT, WIDTH, save, write_transforms

from lexsplat.captures import Lens, load_capture
from lexsplat.captures.capture import View
from lexsplat.captures.images.reading import read_mask, transparency_of
from lexsplat.captures.images.undistortion import pinhole_of
from lexsplat.captures.sfm.preparation import prepare_photos
from lexsplat.features.extraction import pixels_hash
from lexsplat.geometry.cameras import Camera
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import _photos_fingerprint
from lexsplat.pipeline.provenance import hash_capture
from lexsplat.runtime.errors import CaptureError

NAMES = ["a.png", "b.png", "c.png"]
SEEN = np.s_[10:40, 6:50]
"""The rectangle in which the photos are opaque."""


def colors(seed: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Random colors ``[H, W, 3]``, uint8."""
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


def rectangle(size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Whether each pixel ``[H, W]`` is opaque."""
    seen = np.zeros(size[::-1], bool)
    seen[SEEN] = True
    return seen


def save_rgba(path, pixels: np.ndarray, alpha: np.ndarray, **options) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.dstack([pixels, alpha.astype(np.uint8)])).save(path, **options)


@pytest.fixture
def capture_folder(tmp_path: Path) -> Path:
    """A transforms.json with three photos, of which ``a.png`` is transparent outside the rectangle."""
    write_transforms(tmp_path, NAMES)
    save_rgba(tmp_path / "images" / "a.png", colors(), rectangle() * 255)
    return tmp_path


def test_transparent_pixels_of_a_capture_with_cameras_are_masked(capture_folder):
    capture = load_capture(capture_folder)
    valid = capture.views["a.png"].load_valid()
    assert valid is not None
    np.testing.assert_array_equal(valid, rectangle())
    assert capture.views["b.png"].load_valid() is None
    (warning,) = (each for each in capture.warnings if "transparent" in each)
    assert "1 photo" in warning
    assert "a.png" in warning


def test_what_lies_under_transparent_pixels_changes_no_pixel(capture_folder):
    first = load_capture(capture_folder).views["a.png"].load_image()
    np.testing.assert_allclose(first[rectangle()], colors()[rectangle()] / 255, atol=1e-6)
    painted = np.where(rectangle()[..., None], colors(), colors(1))
    save_rgba(capture_folder / "images" / "a.png", painted, rectangle() * 255)
    np.testing.assert_array_equal(load_capture(capture_folder).views["a.png"].load_image(), first)


def test_opaque_alpha_changes_nothing(tmp_path):
    write_transforms(tmp_path, NAMES)
    Image.fromarray(colors()).save(tmp_path / "images" / "a.png")
    plain = load_capture(tmp_path)
    save_rgba(tmp_path / "images" / "a.png", colors(), np.full((HEIGHT, WIDTH), 255))
    opaque = load_capture(tmp_path)
    assert opaque.warnings == plain.warnings
    assert opaque.views["a.png"].load_valid() is None
    assert not opaque.views["a.png"].is_masked
    np.testing.assert_array_equal(opaque.views["a.png"].load_image(), plain.views["a.png"].load_image())


def test_a_pixel_that_is_more_opaque_than_half_has_the_color_that_the_photo_stores(tmp_path):
    write_transforms(tmp_path, NAMES)
    alpha = np.full((HEIGHT, WIDTH), 128)
    alpha[:, :9] = 127
    save_rgba(tmp_path / "images" / "a.png", colors(), alpha)
    view = load_capture(tmp_path).views["a.png"]
    valid = view.load_valid()
    assert valid is not None
    np.testing.assert_array_equal(valid, alpha == 128)
    np.testing.assert_allclose(view.load_image()[:, 9:], colors()[:, 9:] / 255, atol=1e-6)


@pytest.mark.parametrize("scale", [1, 2])
def test_a_mask_and_transparency_are_both_ignored(capture_folder, scale):
    mask = np.ones((HEIGHT // scale, WIDTH // scale))
    mask[: 24 // scale] = 0
    save(capture_folder / "masks" / "a.png", mask)
    valid = load_capture(capture_folder).views["a.png"].load_valid()
    expected = rectangle()
    expected[:24] = False
    np.testing.assert_array_equal(valid, expected)


def test_a_mask_of_the_undistorted_photo_is_combined_with_the_transparency_of_the_photo(tmp_path):
    lens = Lens("SIMPLE_RADIAL", WIDTH, HEIGHT, (60.0, WIDTH / 2, HEIGHT / 2, -0.2))
    width, height, K = pinhole_of(lens)
    assert (width, height) != (WIDTH, HEIGHT)
    save_rgba(tmp_path / "a.png", colors(), rectangle() * 255)
    mask = np.ones((height, width))
    mask[: height // 2] = 0
    save(tmp_path / "mask.png", mask)
    view = View("a.png", tmp_path / "a.png", Camera(width, height, K, np.eye(4)), (width, height), lens)
    transparent = dataclasses.replace(view, ignores_transparent=True).load_valid()
    masked = dataclasses.replace(view, ignore_path=tmp_path / "mask.png").load_valid()
    both = dataclasses.replace(view, ignore_path=tmp_path / "mask.png", ignores_transparent=True)
    assert transparent is not None
    assert masked is not None
    assert (transparent & masked).any()
    np.testing.assert_array_equal(both.load_valid(), transparent & masked)
    first = both.load_image()
    painted = np.where(rectangle()[..., None], colors(), colors(1))
    save_rgba(tmp_path / "a.png", painted, rectangle() * 255)
    np.testing.assert_array_equal(both.load_image(), first)


@pytest.mark.parametrize("kind", ["RGBA", "LA", "P", "key color"])
def test_transparency_is_read_from_channels_palettes_and_key_colors(tmp_path, kind):
    gray = np.where(rectangle(), colors()[..., 0] | 1, 0).astype(np.uint8)
    path = tmp_path / "a.png"
    if kind in ("RGBA", "LA"):
        image = Image.merge(
            "LA", [Image.fromarray(gray), Image.fromarray(rectangle().astype(np.uint8) * 255)]
        )
        image.convert(kind).save(path)
    else:
        Image.fromarray(gray).convert("P" if kind == "P" else "L").save(path, transparency=0)
    assert (transparency_of(path).least, transparency_of(path).most) == (0, 255)
    assert transparency_of(path).hides
    assert not transparency_of(path).hides_all
    Image.fromarray(gray).save(path)
    assert not transparency_of(path).is_any, "the file has changed"


def test_a_photo_that_is_transparent_throughout_is_named_and_a_capture_of_such_photos_is_refused(tmp_path):
    write_transforms(tmp_path, NAMES)
    save_rgba(tmp_path / "images" / "b.png", colors(), np.zeros((HEIGHT, WIDTH)))
    warnings = load_capture(tmp_path).warnings
    assert any("transparent throughout" in each and "b.png" in each for each in warnings)
    for name in NAMES:
        save_rgba(tmp_path / "images" / name, colors(), np.zeros((HEIGHT, WIDTH)))
    with pytest.raises(CaptureError) as caught:
        load_capture(tmp_path)
    assert_reports(caught.value, str(tmp_path), "only transparent ones", "without an alpha channel")


def test_what_was_made_before_transparency_counted_is_made_again(capture_folder):
    capture = load_capture(capture_folder, test_every=0)
    view = capture.views["a.png"]
    before = dataclasses.replace(view, ignores_transparent=False)
    assert pixels_hash(view, (8, 8)) != pixels_hash(before, (8, 8))
    old = dataclasses.replace(capture, views={**capture.views, "a.png": before})
    assert hash_capture(capture)[1] != hash_capture(old)[1]


# -- photos without cameras


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three photos, of which ``a.png`` is stored rotated and is transparent outside the rectangle."""
    folder = tmp_path / "photos"
    exif = Image.Exif()
    exif[0x0112] = 6  # upright after a turn by 90 degrees clockwise
    save_rgba(folder / "a.png", colors(), rectangle() * 255, exif=exif)
    for seed, name in enumerate(NAMES[1:], start=1):
        Image.fromarray(colors(seed)).save(folder / name)
    return folder


def test_poses_write_masks_of_transparent_pixels_upright(photos, tmp_path):
    prepared = prepare_photos(photos, tmp_path / "out")
    assert prepared.masks is not None
    upright = np.rot90(rectangle(), -1)
    np.testing.assert_array_equal(read_mask(prepared.masks / "a.png.png"), upright)
    assert [path.name for path in prepared.masks.iterdir()] == ["a.png.png"]
    copy = np.asarray(Image.open(prepared.images / "a.png"))
    np.testing.assert_array_equal(copy[upright], np.rot90(colors(), -1)[upright])
    (note,) = (note for note in prepared.notes if "transparent" in note)
    assert "1 photo" in note
    assert "a.png" in note


def test_poses_combine_a_mask_with_transparency(photos, tmp_path):
    mask = np.ones((WIDTH, HEIGHT))  # of the upright photo
    mask[:30] = 0
    save(photos / "masks" / "a.png", mask)
    prepared = prepare_photos(photos, tmp_path / "out")
    assert prepared.masks is not None
    expected = np.rot90(rectangle(), -1).copy()
    expected[:30] = False
    np.testing.assert_array_equal(read_mask(prepared.masks / "a.png.png"), expected)
    assert any("1 of 3 photos are masked" in note for note in prepared.notes)


def test_poses_write_no_mask_of_opaque_alpha(photos, tmp_path):
    save_rgba(photos / "a.png", colors(), np.full((HEIGHT, WIDTH), 255))
    prepared = prepare_photos(photos, tmp_path / "out")
    assert prepared.masks is None
    assert not any("transparent" in note for note in prepared.notes)


def test_poses_are_estimated_again_only_where_transparent_pixels_count_now(photos, tmp_path, monkeypatch):
    def key() -> str:
        return _photos_fingerprint(photos, photos, tmp_path / "scene", BuildConfig())

    with_transparency = key()
    monkeypatch.setattr(
        "lexsplat.pipeline.inputs.transparency_of", lambda path: transparency_of(photos / "b.png")
    )
    before = key()
    assert with_transparency != before
    monkeypatch.undo()
    save_rgba(photos / "a.png", colors(), np.full((HEIGHT, WIDTH), 255))
    opaque = key()
    monkeypatch.setattr(
        "lexsplat.pipeline.inputs.transparency_of", lambda path: transparency_of(photos / "b.png")
    )
    assert key() == opaque
