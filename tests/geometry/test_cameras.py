import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lexsplat.geometry.cameras import OPENGL_TO_OPENCV, Camera, camera_extent, look_at

K = np.array([[100.0, 0, 32], [0, 110.0, 24], [0, 0, 1]])
unit = st.floats(-1, 1)


def project(camera: Camera, point: np.ndarray) -> np.ndarray:
    local = camera.viewmat @ np.append(point, 1.0)
    return (camera.K @ local[:3])[:2] / local[2]


def test_look_at_centers_the_target_and_orients_up():
    camera = look_at([3, 1, 2], [0.5, 0, 0], [0, 0, 1], 64, 48, 0.9)
    assert project(camera, np.array([0.5, 0, 0])) == pytest.approx([32, 24])
    assert project(camera, np.array([0.5, 0, 0.1]))[1] < 24  # image y points down
    assert np.linalg.det(camera.viewmat[:3, :3]) == pytest.approx(1)


def test_look_at_spans_the_vertical_field_of_view():
    camera = look_at([0, 0, 0], [0, 0, 1], [0, -1, 0], 64, 48, np.pi / 2)
    assert project(camera, np.array([0, 1.0, 1.0]))[1] == pytest.approx(48)  # 45 degrees down: the lower edge


@pytest.mark.slow
@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_position_and_forward_agree_with_the_inverse_of_the_pose(position, offset):
    position = np.array(position)
    direction = np.add(offset, (0, 0, 2.0))
    camera = look_at(position, position + direction, [0, 1, 0], 8, 8, 1.0)
    pose = np.linalg.inv(camera.viewmat)
    assert camera.position == pytest.approx(pose[:3, 3], abs=1e-9)
    assert camera.forward == pytest.approx(direction / np.linalg.norm(direction), abs=1e-9)
    assert camera.forward == pytest.approx(pose[:3, 2], abs=1e-9)


@pytest.mark.slow
@given(st.lists(st.tuples(unit, unit, st.floats(-3, 3)), min_size=1, max_size=5))
def test_points_are_projected_as_by_hand_and_those_behind_are_in_no_image(offsets):
    camera = look_at([3, 1, 2], [0.5, 0, 0], [0, 0, 1], 64, 48, 0.9)
    points = np.array(offsets)
    assert camera.world(camera.local(points)) == pytest.approx(points, abs=1e-9)
    pixels, depths, inside = camera.project(points)
    for point, pixel, depth, shown in zip(points, pixels, depths, inside):
        assert depth == pytest.approx((point - camera.position) @ camera.forward, abs=1e-9)
        expected = project(camera, point)
        apart = np.abs([*expected, *(expected - [64, 48]), depth]).min()  # from the borders
        assert apart < 1e-5 or shown == (depth > 0 and 0 <= expected[0] < 64 and 0 <= expected[1] < 48)
        if depth > 1e-3:
            assert pixel == pytest.approx(expected, abs=1e-6)


def test_opengl_identity_looks_along_minus_z_with_y_up():
    camera = Camera(64, 48, K, OPENGL_TO_OPENCV)  # its own inverse
    assert camera.forward == pytest.approx([0, 0, -1])
    assert project(camera, np.array([0, 0, -1.0])) == pytest.approx([32, 24])
    assert project(camera, np.array([0.1, 0.1, -1.0])) == pytest.approx([42, 13])  # right and up in the image


@given(st.integers(1, 300), st.integers(1, 300))
def test_resizing_preserves_relative_image_positions(width, height):
    camera = Camera(64, 48, K, np.eye(4))
    point = np.array([0.1, -0.05, 1.0])
    before = project(camera, point) / [64, 48]
    resized = camera.resized(width, height)
    assert (resized.width, resized.height) == (width, height)
    assert project(resized, point) / [width, height] == pytest.approx(before)


def test_downscaling_rounds_sizes_to_at_least_one_pixel():
    camera = Camera(799, 532, K, np.eye(4))
    assert (camera.downscaled(4).width, camera.downscaled(4).height) == (200, 133)
    assert (camera.downscaled(10_000).width, camera.downscaled(10_000).height) == (1, 1)
    with pytest.raises(ValueError, match="downscale"):
        camera.downscaled(0)


def test_a_longer_side_is_brought_within_a_limit_and_a_shorter_one_stays():
    camera = Camera(799, 532, K, np.eye(4))
    assert (camera.within(400).width, camera.within(400).height) == (400, 266)
    assert (camera.within(800).width, camera.within(800).height) == (799, 532)


def test_extent_is_the_radius_times_1_1_and_1_for_a_point():
    views = [look_at([r, 0, 0], [0, 9, 0], [0, 0, 1], 8, 8, 1.0) for r in (-2, 2)]
    assert camera_extent(views) == pytest.approx(2.2)
    assert camera_extent(views[:1]) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.eye(2)}, "K must be"),
        ({"viewmat": np.eye(3)}, "viewmat must be"),
        ({"viewmat": np.full((4, 4), np.nan)}, "NaN or infinity"),
        ({"K": np.diag([np.inf, 1, 1])}, "NaN or infinity"),
        ({"width": 0}, "image size"),
        ({"K": np.diag([-1.0, 1, 1])}, "focal"),
        ({"K": np.diag([1.0, 1, 2])}, "K must be"),
        ({"K": np.eye(3) + 0.01 * np.eye(3, k=1)}, "K must be"),  # skew
        ({"K": K.T}, "K must be"),
        ({"viewmat": np.zeros((4, 4))}, "rotation"),
        ({"viewmat": np.diag([2.0, 2, 2, 1])}, "rotation"),
        ({"viewmat": np.diag([-1.0, 1, 1, 1])}, "rotation"),  # a mirror
        ({"viewmat": np.eye(4)[[1, 0, 2, 3]]}, "rotation"),  # a mirror
        ({"viewmat": np.eye(4) + np.eye(4, k=-3)}, "row"),
        ({"width": "320"}, "whole"),
        ({"height": 240.5}, "whole"),
        ({"height": np.inf}, "whole"),
        ({"height": None}, "whole"),
    ],
)
def test_invalid_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{"width": 4, "height": 4, "K": np.eye(3), "viewmat": np.eye(4), **change})


def test_poses_rounded_by_other_programs_are_accepted():
    rounded = np.round(look_at([3, 1, 2], [0.5, 0, 0], [0, 0, 1], 64, 48, 0.9).viewmat, 4)
    camera = Camera(64, 48, K + 1e-3 * np.eye(3, k=1), rounded)
    assert camera.resized(6400, 4800).viewmat == pytest.approx(rounded)


@pytest.mark.parametrize("kind", [float, np.float32, np.int64, np.uint16])
def test_whole_sizes_of_any_type_become_int(kind):
    camera = Camera(kind(64), kind(48), K, np.eye(4))
    assert (type(camera.width), type(camera.height)) == (int, int)
    assert (camera.width, camera.height) == (64, 48)


@pytest.mark.parametrize("fov_y", [46, 0, -0.5, np.pi, np.nan, "0.8"])
def test_a_field_of_view_beyond_half_a_turn_is_refused(fov_y):
    with pytest.raises(ValueError, match=r"fov_y: expected .*radians"):
        look_at([0, 0, 0], [0, 0, 1], [0, -1, 0], 64, 48, fov_y)


@pytest.mark.filterwarnings("error")
def test_a_viewing_direction_that_is_none_is_refused():
    with pytest.raises(ValueError, match="position and target"):
        look_at([1, 2, 3], [1, 2, 3], [0, 0, 1], 64, 48, 1.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -2), (0, 1e-9, 1), (0, 0, 0)])
def test_an_up_direction_parallel_to_the_view_is_refused(up):
    with pytest.raises(ValueError, match=r"up: expected .*parallel"):
        look_at([1, 2, 3], [1, 2, 0], up, 64, 48, 1.0)
