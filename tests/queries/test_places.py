"""Places and lengths in scene units and in meters: numbers worked out by hand, on balls at known places."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import LanguageScene, make_scene

from lexsplat.geometry.world import World
from lexsplat.queries.places import angle_of_box, extent, lengths, position
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError

THING = {"center": [1.0, -2.0, 0.5], "size": [0.4, 0.2, 1.0]}


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=60)


def ball(balls, number: int, meters_per_unit: float | None = 0.25) -> Selection:
    world = replace(World.of_cameras(balls.cameras.values()), meters_per_unit=meters_per_unit)
    mask = torch.from_numpy(balls.labels == number)
    return Selection(balls.gaussians, balls.cameras, mask, mask.float(), world=world)


def test_a_position_and_a_size_are_told_in_one_unit():
    assert position(THING) == "(1.00, -2.00, 0.50) scene units"
    assert extent(THING) == "0.40 x 0.20 x 1.00 scene units"
    known = lengths(THING["center"], THING["size"], 0.25)
    assert position(known) == "(0.250, -0.500, 0.125) m"
    assert extent(known) == "0.100 x 0.050 x 0.250 m"


def test_lengths_in_meters_are_there_only_where_the_scale_is_known():
    assert lengths(THING["center"], THING["size"], None) == THING
    known = lengths(THING["center"], THING["size"], 0.5)
    assert known == {**THING, "center_meters": [0.5, -1.0, 0.25], "size_meters": [0.2, 0.1, 0.5]}


def test_a_selection_has_its_center_in_meters(balls):
    one = ball(balls, 0)
    assert one.center_meters == pytest.approx(one.center / 4)
    assert one.geometry()["center_meters"] == pytest.approx(one.center / 4, abs=1e-5)
    unknown = ball(balls, 0, None)
    assert unknown.center_meters is None
    assert "center_meters" not in unknown.geometry()
    assert replace(unknown, world=None).center_meters is None


def test_a_distance_is_given_in_units_and_in_meters(balls):
    one, other = ball(balls, 0), ball(balls, 1)
    apart = float(np.linalg.norm(one.center - other.center))
    assert one.distance_to(other) == pytest.approx(apart)
    assert one.distance_meters_to(other) == pytest.approx(apart / 4)
    assert ball(balls, 0, None).distance_meters_to(other) is None


@pytest.mark.parametrize("change", ["grow", "shrink"])
def test_a_selection_grows_and_shrinks_by_meters_as_by_the_units_that_they_are(balls, change):
    one = ball(balls, 0)
    by_meters, by_units = getattr(one, change)(meters=0.45), getattr(one, change)(1.8)
    assert torch.equal(by_meters.mask, by_units.mask)
    assert not torch.equal(by_meters.mask, getattr(one, change)(0.45).mask), "the scale counts"


@pytest.mark.parametrize(
    ("scale", "given", "told"),
    [
        (None, {"meters": 0.1}, "0.1 m: expected a scene with a known scale, found none"),
        (0.25, {"distance": 1.0, "meters": 0.1}, "expected scene units or meters, found both"),
        (0.25, {"meters": -1.0}, "expected a number from 0, found -1.0"),
        (0.25, {"meters": "10cm"}, "expected a number from 0, found '10cm'"),
    ],
)
def test_a_distance_that_has_no_meaning_is_refused(balls, scale, given, told):
    with pytest.raises(QueryError, match=told):
        ball(balls, 0, scale).grow(**given)


@pytest.mark.parametrize(
    ("first", "up", "degrees"),
    [
        ((1, 0, 0), (0, 0, 1), 0.0),
        ((np.cos(0.5), np.sin(0.5), 0), (0, 0, 1), 28.6),
        ((-np.cos(0.5), -np.sin(0.5), 0), (0, 0, 1), 28.6),
        ((np.cos(0.5), -np.sin(0.5), 0), (0, 0, 1), 151.4),
        ((np.cos(0.5), 0, np.sin(0.5)), (0, -1, 0), 28.6),
        ((0, np.cos(0.5), np.sin(0.5)), (1, 0, 0), 28.6),
        ((np.cos(1e-4), -np.sin(1e-4), 0), (0, 0, 1), 0.0),
    ],
    ids=["along x", "turned", "either way", "the other way", "y is down", "x is up", "all but none"],
)
def test_the_angle_of_a_box_is_counted_from_above_and_from_the_x_axis(first, up, degrees):
    assert angle_of_box([first, np.cross(up, first), up]) == degrees
