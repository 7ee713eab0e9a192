"""Upright boxes and the up direction, compared with values computed by hand and with point counts."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.tilted_cameras import UP, cameras

from lexsplat.geometry import boxes
from lexsplat.geometry.boxes import Box, fit_box, gravity_up, representatives, trimmed_box
from lexsplat.geometry.cameras import look_at


def turned(angle: float, center=(0.0, 0.0, 0.0), halves=(1.0, 0.5, 0.25)) -> Box:
    axes = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return Box(np.array(center, float), axes, np.array(halves, float))


def uniform(rng, count, low, high):
    return rng.uniform(low, high, (count, 3))


def on_box(rng, count):
    """The surface of a box of 2 by 1 by 0.8."""
    halves, side = np.array([1.0, 0.5, 0.4]), rng.choice(3, count, p=np.array([0.4, 0.8, 1.0]) / 2.2)
    points = uniform(rng, count, -halves, halves)
    points[np.arange(count), side] = rng.choice([-1, 1], count) * halves[side]
    return points


def on_sphere(rng, count):
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * 0.5


def on_ring(rng, count):
    """A ring that lies: 1 wide, 0.1 high."""
    around, across = rng.uniform(0, 2 * np.pi, (2, count))
    out = 0.45 + 0.05 * np.cos(across)
    return np.stack([out * np.cos(around), out * np.sin(around), 0.05 * np.sin(across)], 1)


def mug_with_handle(rng, count):
    """A cylinder of radius 0.4 with a handle that reaches 0.25 beyond it, a tenth of the points."""
    around = rng.uniform(0, 2 * np.pi, count)
    body = np.stack([0.4 * np.cos(around), 0.4 * np.sin(around), rng.uniform(-0.5, 0.5, count)], 1)
    bow = rng.uniform(-np.pi / 2, np.pi / 2, count // 10)
    thick = rng.normal(0, 0.02, len(bow))
    handle = np.stack([0.4 + 0.25 * np.cos(bow), thick, 0.3 * np.sin(bow)], 1)
    return np.concatenate([body[: count - len(handle)], handle])


def on_plate(rng, count):
    """A cloth of 2 by 1.4, 0.02 thick."""
    return uniform(rng, count, [-1, -0.7, -0.01], [1, 0.7, 0.01])


SHAPES = {"box": on_box, "sphere": on_sphere, "ring": on_ring, "mug": mug_with_handle, "plate": on_plate}


def rotated(points, angle):
    return points @ turned(angle).axes


@pytest.mark.slow
@given(st.floats(0, 1.5), st.integers(0, 5))
@settings(max_examples=20)
def test_a_box_around_a_rotated_block_has_the_size_and_center_of_the_block(angle, seed):
    rng = np.random.default_rng(seed)
    block = turned(angle, center=(1.0, -2.0, 3.0))
    points = block.center + (rng.uniform(-1, 1, (4000, 3)) * block.half_sizes) @ block.axes
    for found in (fit_box(points, UP), trimmed_box(points, UP, 0.0)):
        assert np.sort(found.half_sizes[:2]) == pytest.approx([0.5, 1.0], rel=0.12)
        assert found.half_sizes[2] == pytest.approx(0.25, rel=0.02)
        assert found.center == pytest.approx(block.center, abs=0.05)
        assert np.linalg.det(found.axes) == pytest.approx(1.0)


@pytest.mark.parametrize("strays", [0.0, 0.002, 0.005, 0.01])
@pytest.mark.parametrize("shape", SHAPES)
@given(angle=st.floats(0, 1.5), seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_a_box_has_the_size_of_the_shape_whatever_few_strays_lie_around_it(shape, strays, angle, seed):
    rng = np.random.default_rng(seed)
    points = SHAPES[shape](rng, 1000)
    far = uniform(rng, int(strays * 1000), -3.0, 3.0)
    found = fit_box(rotated(np.concatenate([points, far]), angle), UP)
    exact = trimmed_box(rotated(points, angle), UP, 0.0)
    # Angles come in steps of two degrees, which makes long things wider.
    assert np.sort(found.half_sizes[:2]) == pytest.approx(np.sort(exact.half_sizes[:2]), rel=0.12)
    assert found.half_sizes[2] == pytest.approx(exact.half_sizes[2], rel=0.1)
    assert found.center == pytest.approx(exact.center, abs=0.1)


def test_a_thin_thing_stays_thin_though_strays_lie_near_it():
    rng = np.random.default_rng(0)
    near = uniform(rng, 60, [-1, -0.7, -0.05], [1, 0.7, 0.05])
    points = np.concatenate([on_plate(rng, 940), near])
    assert 2 * fit_box(points, UP).half_sizes[2] == pytest.approx(0.02, rel=0.15)
    assert 2 * trimmed_box(points, UP, 0.01).half_sizes[2] > 0.04


@pytest.mark.parametrize("share", [0.03, 0.06])
def test_a_sparse_part_belongs_to_the_box(share):
    rng = np.random.default_rng(0)
    leaves, pot = on_sphere(rng, 1000), uniform(rng, int(share * 1000), [-0.2, -0.2, -0.9], [0.2, 0.2, -0.5])
    found = fit_box(np.concatenate([leaves, pot]), UP)
    assert found.center[2] - found.half_sizes[2] < -0.7
    assert found.center[2] + found.half_sizes[2] == pytest.approx(0.5, abs=0.02)


@given(st.integers(0, 1000), st.integers(1, 300))
@settings(max_examples=40, deadline=None)
def test_an_end_is_where_a_stretch_is_dense_unless_many_lie_far_beyond(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * rng.uniform(0.1, 2, 3) * rng.choice([1, 1, 1, 4], (count, 1))
    found = fit_box(points, UP)
    along = np.sort(points @ found.axes.T, axis=0)
    few = (
        count - 1 - int(0.01 * count) - max(int(np.ceil(0.01 * count)) - 1, 0)
    )  # steps between the trimmed ends
    first = max(int(np.ceil(0.01 * count)) - 1, 0)
    near = 0.03 * (along[first + few] - along[first]).max()
    for column, middle, half in zip(along.T, found.axes @ found.center, found.half_sizes):
        stretch = 0.03 * (column[int(0.95 * count)] - column[int(0.05 * count)])
        low = next(v for v in column if ((column >= v) & (column - v <= stretch)).sum() >= 0.0075 * count)
        high = next(
            v for v in column[::-1] if ((column <= v) & (v - column <= stretch)).sum() >= 0.0075 * count
        )
        low, high = min(low, column[first] + near), max(high, column[first + few] - near)
        assert [middle - half, middle + half] == pytest.approx([low, high], abs=1e-9)


def test_gaussians_count_one_standard_deviation_beyond_their_centers():
    found = fit_box(np.array([[1.0, 2.0, 3.0]]), UP, np.diag([0.1, 0.2, 0.3])[None])
    assert found.center == pytest.approx([1, 2, 3])
    assert np.abs(found.axes.T @ found.half_sizes) == pytest.approx([0.1, 0.2, 0.3])
    rng = np.random.default_rng(0)
    points, spread = uniform(rng, 1000, -1.0, 1.0), np.full((1000, 3, 3), np.eye(3) * 0.1)
    gained = fit_box(points, UP, spread).half_sizes - fit_box(points, UP).half_sizes
    assert gained == pytest.approx([0.1] * 3, abs=0.02)


@pytest.mark.slow
@given(st.lists(st.floats(0, 5), min_size=1, max_size=60), st.integers(1, 200))
def test_representatives_are_as_many_as_each_point_weighs(weights, most):
    weights = np.array(weights)
    with patch.object(boxes, "SAMPLE", most):
        chosen = representatives(weights)
    assert len(chosen) == min(most, 2 * len(weights))
    if weights.sum() > 1e-3:
        expected = weights / weights.sum() * len(chosen)
        assert np.abs(np.bincount(chosen, minlength=len(weights)) - expected).max() <= 1 + 1e-6


def test_a_gaussian_more_or_less_does_not_move_the_thin_end_of_a_table():
    random = np.random.default_rng(0)
    dense = random.uniform((-1, -0.6, 0), (1, 0.6, 0.02), (5500, 3))
    thin = random.uniform(
        (-1, 0.6, 0), (1, 0.8, 0.02), (110, 3)
    )  # 2 % of the points on a seventh of the length
    table = random.permutation(np.concatenate([dense, thin]))
    sizes = []
    for gone in range(12):
        left = np.delete(table, np.arange(gone) * 7, 0)
        sizes.append(fit_box(left[representatives(np.ones(len(left)))], UP).half_sizes * 2)
    assert np.ptp(sizes, axis=0).max() < 0.03  # .16 with as few points as of a thing


def test_points_of_zero_weight_are_ignored():
    points = np.vstack([np.random.default_rng(0).uniform(-1, 1, (500, 3)), np.full((200, 3), 9.0)])
    chosen = representatives(np.r_[np.ones(500), np.zeros(200)])
    assert chosen.max() < 500
    assert fit_box(points[chosen], UP).half_sizes.max() < 1.5


@pytest.mark.parametrize("trim", [0.0, 0.01, 0.1, 0.5])
@pytest.mark.parametrize("count", [1, 7, 300, 5000])
def test_a_trimmed_box_ends_at_the_quantiles_along_its_axes(count, trim):
    points = np.random.default_rng(count).normal(size=(count, 3))
    found = trimmed_box(points, UP, trim)
    along = np.sort(points @ found.axes.T, axis=0)
    reached = np.arange(1, count + 1) / count
    low, high = (along[np.argmax(reached >= limit)] for limit in (trim, 1 - trim))
    middle = found.axes @ found.center
    # Between two points where the count is even.
    step = np.diff(along, axis=0).max(initial=0) if trim == 0.5 else 1e-9
    assert np.abs(middle - found.half_sizes - low).max() <= step
    assert np.abs(middle + found.half_sizes - high).max() <= step


def test_points_in_a_line_or_a_plane_have_a_flat_box_along_them():
    line = np.linspace(0, 1, 50)[:, None] * [np.cos(0.5236), np.sin(0.5236), 0]
    for found in (fit_box(line, UP), trimmed_box(line, UP, 0.0)):
        assert np.sort(found.half_sizes) == pytest.approx([0, 0, 0.5], abs=1e-5)


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
