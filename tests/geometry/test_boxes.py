"""Upright boxes and the up direction, compared with values computed by hand and with point counts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.tilted_cameras import UP, cameras

from lexsplat.geometry.boxes import Box, fit_box, gravity_up
from lexsplat.geometry.cameras import look_at


def turned(angle: float, center=(0.0, 0.0, 0.0), halves=(1.0, 0.5, 0.25)) -> Box:
    axes = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return Box(np.array(center, float), axes, np.array(halves, float))


@given(st.floats(0, 1.5), st.integers(0, 5))
@settings(max_examples=20)
def test_a_box_around_a_rotated_block_has_the_size_and_center_of_the_block(angle, seed):
    rng = np.random.default_rng(seed)
    block = turned(angle, center=(1.0, -2.0, 3.0))
    points = block.center + (rng.uniform(-1, 1, (4000, 3)) * block.half_sizes) @ block.axes
    found = fit_box(points, UP, trim=0.0)
    assert np.sort(found.half_sizes[:2]) == pytest.approx([0.5, 1.0], rel=0.06)
    assert found.half_sizes[2] == pytest.approx(0.25, rel=0.02)
    assert found.center == pytest.approx(block.center, abs=0.05)
    assert np.linalg.det(found.axes) == pytest.approx(1.0)


def test_a_few_far_points_do_not_move_a_box():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (1000, 3))
    stray = np.vstack([points, [[50.0, 0, 0], [0, 40.0, 0]]])
    assert fit_box(stray, UP).half_sizes == pytest.approx(fit_box(points, UP).half_sizes, rel=0.05)


def test_points_of_zero_weight_are_ignored():
    points = np.vstack([np.random.default_rng(0).uniform(-1, 1, (500, 3)), np.full((200, 3), 9.0)])
    weights = np.r_[np.ones(500), np.zeros(200)]
    assert fit_box(points, UP, weights).half_sizes.max() < 1.5


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 2, -0.5)])
def test_up_is_estimated_from_level_cameras(up):
    found = gravity_up(cameras(up))
    assert found.reliable
    assert found.direction == pytest.approx(np.asarray(up) / np.linalg.norm(up), abs=1e-6)


def test_up_is_estimated_from_parallel_cameras():
    row = [look_at([x, -4.0, 0.0], [x, 0.0, 0.0], UP, 64, 48, 0.8) for x in (-1.0, 0.0, 1.0)]
    assert gravity_up(row).direction == pytest.approx(UP, abs=1e-6)


def test_randomly_rotated_cameras_do_not_determine_up():
    assert not gravity_up(cameras((0, 0, 1), roll=50.0, count=40)).reliable


def test_boxes_without_extent_are_refused():
    with pytest.raises(ValueError, match="M > 0"):
        fit_box(np.zeros((0, 3)), UP)
    with pytest.raises(ValueError, match="at least one camera"):
        gravity_up([])
