"""The plane that a thing stands on, among points of which most lie in a known one."""

from __future__ import annotations

import numpy as np
import pytest

from lexsplat.scenes import surfaces
from lexsplat.scenes.surfaces import surface_below

UP = np.array([0.0, 0.0, 1.0])


def table_and_thing(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A thing on a table at height 0.5 with a slope of 1 in 50, and a lamp above a part of the table."""
    random = np.random.default_rng(count)
    thing = random.uniform((-0.2, -0.2, 0.5), (0.2, 0.2, 0.9), (200, 3))
    table = random.uniform(-0.5, 0.5, (count, 3))
    table[:, 2] = 0.5 + 0.02 * table[:, 0] + random.normal(0, 0.002, count)
    lamp = random.uniform((-0.5, -0.5, 0.55), (0.5, 0.5, 0.6), (count // 3, 3))
    return thing, np.concatenate([lamp, table])


def test_the_plane_under_a_thing_is_that_of_most_points_around_its_foot():
    found = surface_below(*table_and_thing(600), UP)
    normal = np.array([-0.02, 0, 1]) / np.hypot(0.02, 1)
    assert found.axes[2] == pytest.approx(normal, abs=5e-3)
    height = found.origin[2] - 0.02 * found.origin[0]
    assert height == pytest.approx(0.5, abs=1e-3)


def test_the_plane_of_many_points_takes_no_more_passes_over_them(monkeypatch):
    """A pass for each point took seconds where a thing stands on a large and dense floor."""
    passes, absolute = [], np.abs

    def counted(values, *rest):
        passes.append(len(values))
        return absolute(values, *rest)

    monkeypatch.setattr(surfaces.np, "abs", counted)
    for count in (200, 2_000):
        passes.clear()
        assert surface_below(*table_and_thing(count), UP) is not None
        assert len(passes) < 20


def test_few_and_uneven_points_of_a_table_make_a_plane_too_and_scattered_ones_do_not():
    random = np.random.default_rng(3)
    thing = random.uniform((-0.2, -0.2, 0.5), (0.2, 0.2, 0.9), (200, 3))
    uneven = np.concatenate([random.uniform(-0.35, 0.35, (45, 2)), random.uniform(0.46, 0.54, (45, 1))], 1)
    found = surface_below(thing, uneven, UP)
    assert found is not None
    assert found.axes[2] @ UP > 0.97
    assert found.origin[2] == pytest.approx(0.5, abs=0.02)
    scattered = random.uniform((-0.35, -0.35, -1), (0.35, 0.35, 2), (120, 3))
    assert surface_below(thing, scattered, UP) is None


def test_a_thing_whose_foot_is_hidden_stands_on_the_listed_surface_around_it():
    """As a plant behind other things: few Gaussians of the table are near, and those of the things are higher."""
    random = np.random.default_rng(4)
    pot = random.uniform((-0.2, -0.2, 0.15), (0.2, 0.2, 0.8), (300, 3))
    table = np.concatenate([random.uniform(-1, 1, (200, 2)), random.normal(0, 0.002, (200, 1))], 1)
    table = table[np.linalg.norm(table[:, :2], axis=1) > 0.45]
    leaves = random.uniform((-0.5, -0.5, 0.1), (0.5, 0.5, 0.5), (25, 3))
    others = np.concatenate([table, leaves])
    assert surface_below(pot, others, UP) is None
    found = surface_below(pot, others, UP, table)
    assert found.origin[2] == pytest.approx(0, abs=0.01)
    assert found.axes[2] == pytest.approx(UP, abs=0.02)
    assert surface_below(pot, others, UP, table + np.array([0, 0, 0.6])) is None, (
        "a shelf above its foot carries nothing"
    )


@pytest.mark.parametrize("height", [0.05, 2.0])
def test_the_image_from_above_reaches_as_far_as_a_tall_thing_casts_its_shadow(height):
    thing, table = table_and_thing(600)
    found = surface_below((thing - [0, 0, 0.5]) * [1, 1, height / 0.4] + [0, 0, 0.5], table, UP)
    expected = max(surfaces.REACH * found.radius, 1.5 * height)
    assert expected <= found.reach <= expected + found.radius
