"""A damaged capture is refused in one line that names the file, what was expected and what to do."""

import numpy as np
import pytest
from support.refusals import fails
from support.written_captures import NAMES, write_images, write_json, write_transforms

from lexsplat.captures import load_capture
from lexsplat.runtime.errors import FileFormatError


class TestBadCaptures:
    def test_missing_and_empty_folders(self, tmp_path):
        fails(tmp_path / "nowhere", "nowhere", "no such folder")
        fails(tmp_path, str(tmp_path), "empty folder")
        (tmp_path / "notes.txt").write_text("x")
        fails(tmp_path, "neither cameras nor photos")
        fails(tmp_path / "notes.txt", "a file")
        (tmp_path / "walk.mp4").touch()
        fails(tmp_path, "neither cameras nor photos, but walk.mp4; give ", "walk.mp4")

    def test_photos_without_cameras_point_to_poses(self, tmp_path):
        write_images(tmp_path, NAMES[:3])
        fails(tmp_path, "3 photos without cameras", f"lexsplat poses {tmp_path}")

    def test_no_photo_at_all(self, tmp_path):
        write_transforms(tmp_path, NAMES[:3], images=False)
        fails(tmp_path, "3 images without a file")
        write_json(tmp_path, {"frames": []})
        fails(tmp_path, "0 images")

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, "0.1", None, [1], 10**400])
    def test_a_pose_that_is_not_numbers_names_the_image(self, tmp_path, value):
        document = write_transforms(tmp_path, NAMES[:3])
        document["frames"][1]["transform_matrix"][0][3] = value
        write_json(tmp_path, document)
        if value == "0.1":  # numpy reads it, and so it is a number
            load_capture(tmp_path)
        else:
            fails(tmp_path, "transforms.json", NAMES[1])

    @pytest.mark.parametrize(
        "pose", [np.zeros((4, 4)), np.diag([1, 1, -1, 1]), np.diag([1, 2, 1, 1]), np.eye(3)]
    )
    def test_a_pose_that_is_no_rotation_names_the_image(self, tmp_path, pose):
        document = write_transforms(tmp_path, NAMES[:3])
        document["frames"][1]["transform_matrix"] = pose.tolist()
        write_json(tmp_path, document)
        fails(tmp_path, "transforms.json", NAMES[1])

    @pytest.mark.parametrize(
        "change",
        [
            {"fl_x": float("nan")},
            {"fl_x": "wide"},
            {"fl_x": True},
            {"fl_x": 0},
            {"fl_x": -5.0, "fl_y": -5.0},
            {"fl_x": 10**400},
            {"fl_x": None, "fl_y": None},
            {"w": 1e12, "h": 1e12},
            {"w": 0},
            {"w": -64},
            {"cx": [1]},
            {"k1": float("inf")},
            {"k1": 1e300},
            {"camera_model": "EQUIRECTANGULAR"},
            {"camera_model": 7},
            {"equirectangular": True},
            {"ftheta_p0": 0.1},
        ],
    )
    def test_invalid_intrinsics_are_refused(self, tmp_path, change):
        write_transforms(tmp_path, NAMES[:2], **change)
        fails(tmp_path, "transforms.json")

    @pytest.mark.parametrize(
        "content", [b"", b"{", b"[]", b'{"frames": 3}', b"\xff\xfe", b"[" * 100_000, b"3"]
    )
    def test_a_file_that_is_no_transforms_json(self, tmp_path, content):
        (tmp_path / "transforms.json").write_bytes(content)
        fails(tmp_path, "transforms.json", kind=FileFormatError)

    @pytest.mark.parametrize("frame", [3, None, {}, {"file_path": 7}])
    def test_frames_of_the_wrong_kind(self, tmp_path, frame):
        document = write_transforms(tmp_path, NAMES[:2])
        write_json(tmp_path, {**document, "frames": [*document["frames"], frame]})
        fails(tmp_path, "transforms.json", "file_path")

    @pytest.mark.parametrize(
        "name", ["../a.png", "images/../../a.png", "/etc/a.png", "..\\a.png", "C:\\a.png", "", "a\0"]
    )
    def test_names_that_leave_the_capture(self, tmp_path, name):
        document = write_transforms(tmp_path, NAMES[:2])
        document["frames"][1]["file_path"] = name
        write_json(tmp_path, document)
        fails(tmp_path, "transforms.json", "inside the capture")

    def test_the_same_image_twice(self, tmp_path):
        document = write_transforms(tmp_path, NAMES[:3])
        document["frames"][1]["file_path"] = document["frames"][0]["file_path"]
        write_json(tmp_path, document)
        fails(tmp_path, NAMES[0], "twice")
