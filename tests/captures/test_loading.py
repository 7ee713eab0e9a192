"""A capture is read as it was written: cameras, split, images and masks."""

import json

import numpy as np
import pytest
from PIL import Image
from support.refusals import assert_reports, fails
from support.written_captures import (
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    cameras_around,
    save,
    shared_data,
    write_colmap,
    write_images,
    write_json,
    write_transforms,
)

from lexsplat.captures import load_annotations, load_capture, stem_of
from lexsplat.captures.images.reading import read_mask
from lexsplat.runtime.errors import CaptureError, FileFormatError


class TestTransforms:
    def test_views_have_the_cameras_that_were_written(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        capture = load_capture(tmp_path)
        assert list(capture.views) == NAMES
        for view, camera in zip(capture.views.values(), cameras_around(len(NAMES))):
            np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-9)
            np.testing.assert_allclose(view.camera.K, [[FOCAL, 0, 32], [0, FOCAL, 24], [0, 0, 1]])
            assert view.capture_size == (WIDTH, HEIGHT)
        assert capture.points.shape == (0, 3)
        positions = np.array([view.camera.position for view in capture.train_views])
        assert capture.extent == pytest.approx(
            1.1 * max(np.linalg.norm(positions - positions.mean(0), axis=1))
        )

    def test_the_json_file_itself_may_be_given(self, tmp_path):
        write_transforms(tmp_path, NAMES[:3])
        assert list(load_capture(tmp_path / "transforms.json").views) == NAMES[:3]

    def test_a_frame_overrides_the_intrinsics_at_the_top(self, tmp_path):
        document = write_transforms(tmp_path, NAMES[:3])
        document["frames"][1] |= {"fl_x": 70.0, "fl_y": 71.0, "cx": 20.0, "cy": 22.0, "w": 40, "h": 44}
        write_images(tmp_path / "images", NAMES[1:2], (40, 44))
        write_json(tmp_path, document)
        capture = load_capture(tmp_path)
        sizes = [(view.camera.width, view.camera.height) for view in capture.views.values()]
        assert sizes == [(64, 48), (40, 44), (64, 48)]
        np.testing.assert_allclose(capture.views[NAMES[1]].camera.K, [[70, 0, 20], [0, 71, 22], [0, 0, 1]])

    @pytest.mark.parametrize("fisheye", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
    def test_fisheye_cameras_are_undistorted_as_such(self, tmp_path, fisheye):
        write_transforms(tmp_path, NAMES[:2], k1=0.1, k2=0.01, **fisheye)
        lens = load_capture(tmp_path).views[NAMES[0]].lens
        assert lens.model == "OPENCV_FISHEYE"
        assert lens.params[4:] == (0.1, 0.01, 0.0, 0.0)

    def test_opencv_distortion_takes_opencv_order(self, tmp_path):
        numbers = {"k1": 0.01, "k2": 0.02, "p1": 0.003, "p2": 0.004, "k3": 0.05, "k4": 0.06}
        write_transforms(tmp_path, NAMES[:2], **numbers)
        lens = load_capture(tmp_path).views[NAMES[0]].lens
        assert lens.model == "FULL_OPENCV"
        assert lens.params[4:] == (0.01, 0.02, 0.003, 0.004, 0.05, 0.06, 0.0, 0.0)

    def test_a_pose_of_three_rows_and_one_with_scale_are_taken(self, tmp_path):
        document = write_transforms(tmp_path, NAMES[:2])
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])[:3]
            pose[:, :3] *= 2.5
            frame["transform_matrix"] = pose.tolist()
        write_json(tmp_path, document)
        for view, camera in zip(load_capture(tmp_path).views.values(), cameras_around(2)):
            np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-9)

    def test_frames_without_a_file_are_skipped_with_one_warning_that_lists_them(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        for name in (NAMES[2], NAMES[9]):
            (tmp_path / "images" / name).unlink()
        capture = load_capture(tmp_path)
        assert len(capture.views) == len(NAMES) - 2
        (warning,) = capture.warnings
        assert "2 of 17" in warning
        assert NAMES[2] in warning
        assert NAMES[9] in warning

    def test_nerfstudio_test_filenames_are_the_split(self, tmp_path):
        write_transforms(tmp_path, NAMES, test_filenames=[f"images/{NAMES[3]}", f"images/{NAMES[5]}"])
        assert load_capture(tmp_path).test_names == (NAMES[3], NAMES[5])

    def test_nerf_synthetic_has_its_split_image_sizes_and_white_background(self, tmp_path):
        rgba = np.zeros((20, 20, 4), np.uint8)
        rgba[:10] = [255, 0, 0, 255]
        rgba[10:, :10] = [0, 0, 255, 51]
        for part in ("train", "test"):
            frames = [
                {"file_path": f"./{part}/r_{i}", "transform_matrix": np.eye(4).tolist()} for i in (0, 1)
            ]
            write_json(tmp_path, {"camera_angle_x": np.pi / 2, "frames": frames}, f"transforms_{part}.json")
            for i in (0, 1):
                save(tmp_path / part / f"r_{i}.png", np.zeros((20, 20, 3)))
                Image.fromarray(rgba).save(tmp_path / part / f"r_{i}.png")
        capture = load_capture(tmp_path)
        assert capture.train_names == ("train/r_0.png", "train/r_1.png")
        assert capture.test_names == ("test/r_0.png", "test/r_1.png")
        assert capture.background == (1.0, 1.0, 1.0)
        view = capture.views["test/r_0.png"]
        assert view.stem == "test/r_0"
        np.testing.assert_allclose(view.camera.K, [[10, 0, 10], [0, 10, 10], [0, 0, 1]])
        image = view.load_image()
        np.testing.assert_allclose(image[0, 0], [1, 0, 0])
        np.testing.assert_allclose(image[15, 5], [0.8, 0.8, 1.0], atol=1e-6)
        np.testing.assert_allclose(image[15, 15], [1, 1, 1])
        assert view.load_valid() is None, "nothing is there: no mask, but white"

    def test_only_nerf_synthetic_has_a_white_background(self, tmp_path):
        document = write_transforms(tmp_path, NAMES[:2])
        rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        rgba[: HEIGHT // 2, :, 3] = 255
        for name in NAMES[:2]:
            Image.fromarray(rgba).save(tmp_path / "images" / name)
        assert load_capture(tmp_path).background == (0.0, 0.0, 0.0)
        intrinsics = {key: document.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
        for frame in document["frames"]:
            frame |= intrinsics
        write_json(tmp_path, document)
        capture = load_capture(tmp_path)
        assert capture.background == (0.0, 0.0, 0.0), "intrinsics of each frame are no reason for white"
        assert capture.views[NAMES[0]].load_image().max() == 0

    def test_fox_is_loaded_without_its_17_missing_frames(self):
        capture = load_capture(shared_data("fox"), downscale=8)
        assert len(capture.views) == 50
        assert len(capture.warnings) == 1
        assert capture.warnings[0].count(".jpg") == 17
        view = capture.views["0001.jpg"]
        image = view.load_image()
        assert image.shape == (view.camera.height, view.camera.width, 3) == (237, 133, 3)
        assert 0.4 < image.mean() < 0.7


class TestSplit:
    def test_every_eighth_view_counts_from_the_first(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        capture = load_capture(tmp_path)
        assert capture.test_names == (NAMES[0], NAMES[8], NAMES[16])
        assert sorted(capture.train_names + capture.test_names) == NAMES
        assert [view.name for view in capture.test_views] == list(capture.test_names)
        assert load_capture(tmp_path, test_every=5).test_names == tuple(NAMES[::5])
        assert load_capture(tmp_path, test_every=0).test_names == ()

    def test_views_with_segmentations_come_before_every_eighth(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        save(tmp_path / "segmentations" / "0004" / "red_apple.png", np.ones((HEIGHT, WIDTH)))
        assert load_capture(tmp_path).test_names == (NAMES[3],)

    @pytest.mark.parametrize(
        ("test_every", "told", "held_out"), [(5, "every 5th", NAMES[::5]), (0, "none", [])]
    )
    def test_ground_truth_for_every_view_holds_out_as_without(self, tmp_path, test_every, told, held_out):
        write_transforms(tmp_path, NAMES)
        for name in NAMES:
            save(tmp_path / "segmentations" / name[:-4] / "apple.png", np.ones((HEIGHT, WIDTH)))
        capture = load_capture(tmp_path, test_every=test_every)
        assert list(capture.test_names) == held_out
        assert capture.warnings[-1] == f"{tmp_path}: every view has ground truth; {told} is held out"

    def test_test_views_json_comes_before_segmentations(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        save(tmp_path / "segmentations" / "0004" / "apple.png", np.ones((HEIGHT, WIDTH)))
        write_json(tmp_path, ["0002", "0007"], "test_views.json")
        assert load_capture(tmp_path).test_names == (NAMES[1], NAMES[6])

    def test_given_names_come_before_all_and_may_be_stems(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        write_json(tmp_path, ["0002"], "test_views.json")
        assert load_capture(tmp_path, test_names=["0009.png", "0003"]).test_names == (NAMES[2], NAMES[8])
        assert load_capture(tmp_path, test_names=[]).test_names == ()

    def test_unknown_and_exhaustive_splits_are_refused(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        fails(tmp_path, "'0099'", "no view", test_names=["0099"])
        fails(tmp_path, "training view", test_names=NAMES)
        write_json(tmp_path, {"test": ["0001"]}, "test_views.json")
        fails(tmp_path, "test_views.json", "list of image stems", kind=FileFormatError)
        write_json(tmp_path, ["nowhere"], "test_views.json")
        fails(tmp_path, "test_views.json", "nowhere")
        with pytest.raises(ValueError, match="test_every"):
            load_capture(tmp_path, test_every=1)

    def test_a_single_view_is_a_training_view(self, tmp_path):
        write_transforms(tmp_path, NAMES[:1])
        assert load_capture(tmp_path).train_names == (NAMES[0],)


class TestImages:
    def one(self, tmp_path, name="a.png"):
        write_transforms(tmp_path, [name, "z.png"])
        return tmp_path / "images" / name

    @pytest.mark.parametrize(
        ("mode", "value", "expected"),
        [
            ("L", 51, 0.2),
            ("RGB", (51, 51, 51), 0.2),
            ("RGBA", (51, 51, 51, 255), 0.2),
            ("LA", (51, 255), 0.2),
            ("P", 51, None),
            ("1", 1, 1.0),
            ("I;16", 13107, 0.2),
            ("F", 0.2, 0.2),
            ("CMYK", (0, 0, 0, 204), 0.2),
        ],
    )
    def test_every_mode_becomes_rgb_in_0_to_1(self, tmp_path, mode, value, expected):
        suffix = "tif" if mode in ("F", "CMYK") else "png"
        path = self.one(tmp_path, f"a.{suffix}")
        image = Image.new(mode, (WIDTH, HEIGHT), value)
        if mode == "P":
            image, expected = Image.new("RGB", (WIDTH, HEIGHT), (51, 51, 51)).convert("P"), 0.2
        image.save(path)
        loaded = load_capture(tmp_path).views[path.name].load_image()
        assert loaded.shape == (HEIGHT, WIDTH, 3)
        assert loaded.dtype == np.float32
        np.testing.assert_allclose(loaded, expected, atol=0.003)

    def test_exif_orientation_is_ignored_because_poses_refer_to_stored_pixels(self, tmp_path):
        path = self.one(tmp_path, "a.jpg")
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        pixels[: HEIGHT // 2] = 255
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(pixels).save(path, exif=exif, quality=95)
        image = load_capture(tmp_path).views["a.jpg"].load_image()
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert image[:20].min() > 0.9
        assert image[-20:].max() < 0.1

    def test_photos_scaled_after_the_cameras_were_computed_scale_the_camera(self, tmp_path):
        write_transforms(tmp_path, NAMES[:2], w=259, h=195, fl_x=240.0, fl_y=240.0, cx=129.5, cy=97.5)
        write_images(tmp_path / "images", NAMES[:2], (65, 49))  # 259 / 4 and 195 / 4, rounded up
        view = load_capture(tmp_path).views[NAMES[0]]
        assert view.capture_size == (65, 49)
        assert view.camera.K[0, 0] == pytest.approx(240 * 65 / 259)
        assert view.camera.K[1, 2] == pytest.approx(24.5)

    def test_downscale_and_size_set_what_is_loaded(self, tmp_path):
        write_transforms(tmp_path, NAMES[:2])
        view = load_capture(tmp_path, downscale=2.5).views[NAMES[1]]
        assert (view.camera.width, view.camera.height) == (26, 19)
        assert view.camera.K[0, 0] == pytest.approx(FOCAL * 26 / WIDTH)
        assert view.load_image().shape == (19, 26, 3)
        assert view.load_image((8, 5)).shape == (5, 8, 3)
        np.testing.assert_allclose(view.load_image(), 0.5, atol=0.01)
        for bad in (0, -1, float("nan")):
            with pytest.raises(ValueError, match="downscale"):
                load_capture(tmp_path, downscale=bad)

    def test_a_photo_of_another_aspect_is_refused(self, tmp_path):
        path = self.one(tmp_path)
        save(path, np.zeros((WIDTH, HEIGHT, 3)))
        fails(tmp_path, str(path), "64x48", "48x64", "rotated")
        save(path, np.zeros((HEIGHT, WIDTH - 4, 3)))
        fails(tmp_path, str(path), "64x48", "60x48")

    def test_an_unreadable_photo_is_reported_when_the_capture_is_loaded(self, tmp_path):
        path = self.one(tmp_path)
        for content in (b"", b"no image", b"\x89PNG\r\n\x1a\n"):
            path.write_bytes(content)
            fails(tmp_path, str(path), "image")

    @pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "bmp"])
    def test_a_truncated_photo_is_reported_when_it_is_read(self, tmp_path, suffix):
        path = self.one(tmp_path, f"a.{suffix}")
        noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        whole = path.read_bytes()
        view = load_capture(tmp_path).views[path.name]
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(CaptureError) as caught:
            view.load_image()
        assert_reports(caught.value, str(path))

    def test_a_photo_that_changed_or_vanished_after_loading_is_reported(self, tmp_path):
        path = self.one(tmp_path)
        view = load_capture(tmp_path).views["a.png"]
        save(path, np.zeros((10, 10, 3)))
        with pytest.raises(CaptureError) as caught:
            view.load_image()
        assert_reports(caught.value, str(path), "64x48", "10x10")
        path.unlink()
        with pytest.raises(CaptureError) as caught:
            view.load_image()
        assert_reports(caught.value, str(path), "no such file")

    def test_a_decompression_bomb_is_refused(self, tmp_path, monkeypatch):
        path = self.one(tmp_path)
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
        fails(tmp_path, str(path), "pixels")

    def test_masked_pixels_are_ignored(self, tmp_path):
        self.one(tmp_path)
        mask = np.zeros((HEIGHT, WIDTH))
        mask[:, :32] = 1
        save(tmp_path / "masks" / "a.png.png", mask)
        views = load_capture(tmp_path, downscale=2).views
        np.testing.assert_array_equal(views["a.png"].load_valid(), mask[::2, ::2] > 0)
        assert views["z.png"].load_valid() is None

    def test_masks_that_leave_nothing_are_told_and_refused_if_no_photo_is_left(self, tmp_path):
        self.one(tmp_path)
        save(tmp_path / "masks" / "a.png.png", np.zeros((HEIGHT, WIDTH)))
        (warning,) = load_capture(tmp_path).warnings
        assert "1 of 2 photos take no part, because their masks are black: a.png" in warning
        assert "invert them" in warning
        labels = np.ones((HEIGHT, WIDTH), np.uint16)  # dark, but not black: they count
        Image.fromarray(labels).save(tmp_path / "masks" / "z.png.png")
        assert len(load_capture(tmp_path).warnings) == 1
        save(tmp_path / "masks" / "z.png.png", np.zeros((HEIGHT, WIDTH)))
        fails(tmp_path, "masks with white pixels", "only black ones")


class TestMasks:
    def capture(self, root, names, **masks):
        write_transforms(root, names)
        for folder, size in masks.items():
            save(root / "segmentations" / folder.replace("__", "/") / "red_apple.png", np.ones(size[::-1]))
        return root

    def test_masks_are_found_by_view_and_prompt(self, tmp_path):
        self.capture(tmp_path, NAMES, **{"0004": (64, 48)})
        save(tmp_path / "segmentations" / "0004" / "pot.png", np.zeros((48, 64)))
        masks = load_annotations(load_capture(tmp_path)).masks
        assert {name: list(prompts) for name, prompts in masks.items()} == {"0004.png": ["pot", "red apple"]}
        assert read_mask(masks["0004.png"]["red apple"]).all()
        assert not read_mask(masks["0004.png"]["pot"]).any()

    def test_a_capture_without_masks_has_none(self, tmp_path):
        write_transforms(tmp_path, NAMES)
        capture = load_capture(tmp_path)
        assert load_annotations(capture).masks == {}

    def test_equal_stems_in_subfolders_need_the_subfolder(self, tmp_path):
        names = ["left/0001.png", "right/0001.png", "right/0002.png"]
        self.capture(tmp_path, names, left__0001=(64, 48), **{"0002": (64, 48)})
        assert list(load_annotations(load_capture(tmp_path)).masks) == ["left/0001.png", "right/0002.png"]
        save(tmp_path / "segmentations" / "0001" / "x.png", np.ones((48, 64)))
        with pytest.raises(CaptureError) as caught:
            load_annotations(load_capture(tmp_path))
        assert_reports(caught.value, "2 views")

    def test_a_mask_whose_stem_matches_no_view_is_reported(self, tmp_path):
        capture = load_capture(self.capture(tmp_path, NAMES, **{"0004": (64, 48), "0099": (64, 48)}))
        with pytest.raises(CaptureError) as caught:
            load_annotations(capture)
        assert_reports(caught.value, str(tmp_path / "segmentations" / "0099"), "no view")

    def test_a_mask_of_another_aspect_is_refused_and_a_scaled_one_accepted(self, tmp_path):
        capture = load_capture(self.capture(tmp_path, NAMES, **{"0004": (32, 24)}))
        assert list(load_annotations(capture).masks) == ["0004.png"]
        save(tmp_path / "segmentations" / "0004" / "bad.png", np.ones((48, 48)))
        with pytest.raises(CaptureError) as caught:
            load_annotations(capture)
        assert_reports(caught.value, "bad.png", "64x48", "48x48")

    @pytest.mark.parametrize(("high", "dtype"), [(1, np.uint8), (255, np.uint8), (65535, np.uint16)])
    def test_masks_of_any_depth(self, tmp_path, high, dtype):
        ground_truth = np.random.default_rng(0).random((9, 7)) > 0.5
        Image.fromarray((ground_truth * high).astype(dtype)).save(tmp_path / "m.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), ground_truth)

    def test_masks_drawn_on_distorted_photos_are_undistorted_like_them(self, tmp_path):
        write_transforms(tmp_path, NAMES[:3], k1=-0.2)
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        disk = ((x - 12) ** 2 + (y - 12) ** 2 < 64).astype(float)
        save(tmp_path / "images" / NAMES[0], np.repeat(disk[..., None], 3, 2))
        save(tmp_path / "segmentations" / "0001" / "disk.png", disk)
        capture = load_capture(tmp_path)
        view = capture.views[NAMES[0]]
        mask = view.load_mask(load_annotations(capture).masks[NAMES[0]]["disk"])
        assert mask.shape == view.capture_size[::-1]
        seen = view.load_image(view.capture_size)[..., 0] > 0.5
        assert (mask != seen).mean() < 0.01
        # Barrel distortion draws corners inwards; undone, the disk near the corner grows.
        assert mask.sum() > 1.1 * disk.sum()


def test_colmap_is_preferred_because_it_has_points(tmp_path):
    write_transforms(tmp_path, NAMES[:3])
    write_colmap(tmp_path, NAMES[:3])
    assert len(load_capture(tmp_path).points)
    assert not len(load_capture(tmp_path / "transforms.json").points)


def test_stems_keep_folders_and_dots():
    assert [stem_of(n) for n in ("a.png", "b/a.x.jpg", ".hidden", "b.c/a")] == [
        "a",
        "b/a.x",
        ".hidden",
        "b.c/a",
    ]


def test_names_in_other_alphabets_are_kept(tmp_path):
    names = ["größe 1.png", "猫.png", "a#b.png"]
    write_transforms(tmp_path, names)
    assert list(load_capture(tmp_path, test_names=["猫"]).views) == sorted(names)
    assert json.loads((tmp_path / "transforms.json").read_text())["frames"]
