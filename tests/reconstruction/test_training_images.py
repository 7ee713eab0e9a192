"""Training photos: file and cache give the same values, and the cache never exceeds its size."""

import numpy as np
import pytest
import torch

from lexsplat.captures import load_capture
from lexsplat.reconstruction.image_losses import ssim_target
from lexsplat.reconstruction.photos import TrainingImages

PHOTO_BYTES = 96 * 72 * 3
MOMENT_BYTES = 2 * 4 * PHOTO_BYTES


@pytest.fixture(scope="module")
def views(tiny_capture):
    return load_capture(tiny_capture).train_views


@pytest.mark.parametrize("memory", [0, 2 * PHOTO_BYTES, 10 * PHOTO_BYTES + MOMENT_BYTES, 1 << 30])
def test_targets_do_not_depend_on_the_cache_size_which_is_never_exceeded(views, memory):
    images = TrainingImages(views, memory=memory)
    for _ in range(2):
        for view in views:
            target = images.target(view.name)
            expected = ssim_target(torch.from_numpy(np.round(view.load_image() * 255)).float() / 255)
            assert torch.equal(target.image, expected.image)
            assert torch.equal(target.mean, expected.mean)
            assert torch.equal(target.variance, expected.variance)
            assert images.cached_bytes <= memory


def test_a_photo_that_fits_is_read_once(views, monkeypatch):
    reads = []
    view_type = type(views[0])
    original = view_type.load_image
    monkeypatch.setattr(
        view_type, "load_image", lambda self, size: reads.append(self.name) or original(self, size)
    )
    images = TrainingImages(views, memory=2 * PHOTO_BYTES)
    for _ in range(3):
        for view in views[:4]:
            images.target(view.name)
    assert [reads.count(view.name) for view in views[:4]] == [1, 1, 3, 3]


def test_downscaled_images_and_cameras_agree(views):
    images = TrainingImages(views, memory=1 << 20, shrink=2.0)
    camera = images.camera(views[0].name)
    assert (camera.width, camera.height) == (48, 36)
    assert images.target(views[0].name).image.shape == (36, 48, 3)
    np.testing.assert_allclose(camera.K[:2], views[0].camera.K[:2] / 2)


def test_views_without_a_mask_use_all_pixels(views):
    assert TrainingImages(views, memory=0).valid(views[0].name) is None


def test_reduced_photos_are_kept_in_a_folder_with_the_same_bits(views, tmp_path, monkeypatch):
    name = views[0].name
    expected = TrainingImages(views, memory=0, shrink=2.0).target(name).image
    for _ in range(2):  # written, then read
        assert torch.equal(
            TrainingImages(views, memory=0, shrink=2.0, folder=tmp_path).target(name).image, expected
        )
    (kept,) = tmp_path.iterdir()
    assert kept.stat().st_size < PHOTO_BYTES / 4 + 200
    monkeypatch.setattr(type(views[0]), "load_image", None)
    assert torch.equal(
        TrainingImages(views, memory=0, shrink=2.0, folder=tmp_path).target(name).image, expected
    )


@pytest.mark.parametrize("damage", [b"", b"no array", "short", "other size"])
def test_a_damaged_kept_photo_is_made_again(damage, views, tmp_path):
    name = views[0].name
    expected = TrainingImages(views, memory=0, shrink=2.0, folder=tmp_path).target(name).image
    (kept,) = tmp_path.iterdir()
    whole = kept.read_bytes()
    if damage == "other size":
        np.save(kept, np.zeros((3, 3, 3), np.uint8))
    else:
        kept.write_bytes(whole[:-9] if damage == "short" else damage)
    assert torch.equal(
        TrainingImages(views, memory=0, shrink=2.0, folder=tmp_path).target(name).image, expected
    )
    assert kept.read_bytes() == whole


def test_photos_of_full_size_are_not_kept(views, tmp_path):
    TrainingImages(views, memory=0, folder=tmp_path).target(views[0].name)
    assert not list(tmp_path.iterdir())
