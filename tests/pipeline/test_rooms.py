"""Claims about rooms and closed places: which way is up, whether they are looked at from inside, and warnings."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.splats import joined, solid

from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.geometry.rotations import rotation_about
from lexsplat.pipeline.viewpoints import candidates, choosing
from lexsplat.pipeline.viewpoints.choosing import ChosenViews, choose_views
from lexsplat.pipeline.viewpoints.interior import Interior, examine_inside
from lexsplat.pipeline.viewpoints.looking import look_from_above
from lexsplat.pipeline.viewpoints.surroundings import Surroundings, find_surroundings
from lexsplat.pipeline.viewpoints.upward import UpwardDirections, find_upward
from lexsplat.runtime.errors import CaptureError

UP = np.array([0.0, 0.0, 1.0])

ALL, NO_CEILING, NO_FRONT = (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4), (0, 1, 3, 4, 5)


@pytest.fixture(autouse=True)
def _few_looks(monkeypatch) -> None:
    """Half as many looks from above and around as usual."""
    monkeypatch.setattr(candidates, "_AZIMUTHS", 4)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 12)


def box(low, high, count: int, seed: int, sides=ALL) -> np.ndarray:
    """Points on sides of a box: side 2 a is the low one of axis a, and 2 a + 1 the high one."""
    generator = np.random.default_rng(seed)
    sizes = np.subtract(high, low)
    areas = np.array([np.prod(sizes) / sizes[side // 2] for side in sides])
    chosen = np.array(sides)[generator.choice(len(sides), count, p=areas / areas.sum())]
    points = generator.uniform(0, 1, (count, 3))
    points[np.arange(count), chosen // 2] = chosen % 2
    return np.asarray(low) + points * sizes


def furniture(dense: int = 1) -> np.ndarray:
    """A table, a wardrobe in a corner, and a sofa."""
    return np.concatenate([
        box((1.5, 1.2, 0.7), (3, 2.2, 0.76), dense * 450, 1),
        *(box((x, y, 0), (x + 0.06, y + 0.06, 0.7), dense * 24, 2) for x in (1.5, 2.9) for y in (1.2, 2.1)),
        box((0, 3.4, 0), (1.8, 4, 1.9), dense * 540, 3), box((3.6, 0, 0), (5, 0.9, 0.45), dense * 450, 4),
    ])  # fmt: skip


def furnished(dense: int = 1) -> np.ndarray:
    return np.concatenate([box((0, 0, 0), (5, 4, 2.5), dense * 3600, 0), furniture(dense)])


def chair(x: float, y: float) -> np.ndarray:
    return np.concatenate(
        [
            box((x, y, 0), (x + 0.45, y + 0.45, 0.45), 150, 0),
            box((x, y, 0.45), (x + 0.45, y + 0.04, 0.9), 75, 1),
        ]
    )


def bathroom() -> np.ndarray:
    tub = box((0, 0, 0), (0.75, 1.8, 0.55), 750, 1, NO_CEILING)
    basin = box((1.8, 1.1, 0.7), (2.2, 1.6, 0.85), 250, 3)
    toilet = box((1.8, 0.2, 0), (2.2, 0.6, 0.42), 300, 2)
    return np.concatenate([box((0, 0, 0), (2.2, 1.8, 2.4), 4500, 0), tub, toilet, basin])


def tall_hall() -> np.ndarray:
    """A hall of 20 x 8 x 12 with 14 pews."""
    pews = [box((x, y, 0), (x + 0.5, y + 2.6, 0.9), 150, 1) for x in 2 + 2.4 * np.arange(7) for y in (1, 4.4)]
    return np.concatenate([box((0, 0, 0), (20, 8, 12), 6000, 0), *pews])


def attic() -> np.ndarray:
    """A gable roof over a floor of 6 x 4, 3 high, with a chair and a bed."""
    generator = np.random.default_rng(0)
    along, across, roof = (generator.uniform(0, 1, 4500) for _ in range(3))
    down = np.abs(4 * across - 2)
    points = np.stack([6 * along, 4 * across, np.where(roof < 0.6, 3 - 1.5 * down, 0)], 1)
    gables = np.stack([6.0 * (roof < 0.5), 4 * across, 3 * along], 1)[along < 1 - down / 2]
    return np.concatenate([points, gables, chair(2, 1.6), box((4, 1.5, 0), (5.5, 2.5, 0.5), 450, 4)])


def two_storeys() -> np.ndarray:
    floor = np.random.default_rng(3).uniform(0, 1, (1350, 3)) * [5, 4, 0] + [0, 0, 2.5]
    walls = box((0, 0, 0), (5, 4, 5), 6000, 0)
    upstairs = furniture() + np.array([0, 0, 2.5])
    return np.concatenate([walls, floor, furniture(), upstairs])


def rooms_in_a_row(count: int = 6) -> np.ndarray:
    tables = [box((5 * k + 1, 1, 0), (5 * k + 2, 2, 0.7), 250, k) for k in range(count)]
    return np.concatenate(
        [*(box((5 * k, 0, 0), (5 * k + 4.8, 4, 2.5), 2000, k) for k in range(count)), *tables]
    )


def l_shape() -> np.ndarray:
    walls = [
        box((0, 0, 0), (6, 3, 2.5), 3900, 0, (0, 1, 2, 4, 5)), box((0, 3, 0), (3, 6, 2.5), 2700, 1, NO_FRONT),
        box((3, 3, 0), (6, 3.0001, 2.5), 450, 2, (2,)),
    ]  # fmt: skip
    table, wardrobe = box((2, 1, 0.7), (3, 2, 0.76), 360, 3), box((0.1, 0.1, 0), (1.5, 0.6, 1.8), 360, 5)
    return np.concatenate([*walls, chair(4.5, 1.2), chair(1.2, 4.5), table, wardrobe])


def shelf() -> np.ndarray:
    """Open at the front; its back panel is its largest side."""
    boards = [box((0, 0, z), (1, 0.3, z + 0.02), 540, 1) for z in (0.5, 1, 1.5)]
    return np.concatenate([box((0, 0, 0), (1, 0.3, 2), 2400, 0, NO_FRONT), *boards])


def on_table() -> np.ndarray:
    floor = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * [1.5, 1.5, 0.002]
    return np.concatenate(
        [floor, *(box((x, y, 0), (x + 0.5, y + 0.4, 0.5), 900, 1) for x, y in ((0, 0), (-1, 0.3)))]
    )


def surroundings(
    points: np.ndarray | Gaussians, up: np.ndarray | None = None, warn: bool = True
) -> Surroundings:
    gaussians = points if isinstance(points, Gaussians) else solid(points)
    return find_surroundings(gaussians, up, look_from_above(gaussians), Path("room.ply"), warn=warn)


def examined(points: np.ndarray | Gaussians) -> Interior:
    """The inside of a scene whose up direction is given."""
    gaussians = points if isinstance(points, Gaussians) else solid(points)
    return examine_inside(gaussians, surroundings(gaussians, UP, warn=False))


def test_an_interior_is_a_room_an_object_or_uncertain():
    """An empty shell, hardly a thing in one, a ball in a room, an open stage, things on a table, no place, haze."""
    found = [
        Interior(9, enclosed, things) for enclosed, things in ((1, 0), (1, 0.005), (1, 0.014), (0.5, 0.2))
    ]
    found += [
        Interior(9, 0.1, 0.9),
        Interior(0, 0.0, 0.0),
        Interior(9, 0.2, 0.2, 0.7),
        Interior(9, 0, 0, 1.0),
    ]
    assert [one.is_room for one in found] == [False, True, True, True, False, False, True, False]
    assert [one.is_shell for one in found] == [True, *[False] * 7]
    assert [one.is_certain for one in found] == [False, False, True, False, True, False, False, False]


def test_what_a_user_says_a_scene_is_is_certain():
    found = [Interior(9, enclosed, things) for enclosed, things in ((1.0, 0.0), (0.45, 0.05), (1.0, 0.05))]
    inside, around = ([replace(one, side=side) for one in found] for side in ("inside", "around"))
    assert all(one.is_room and one.is_certain and not one.is_shell for one in inside)
    assert all(one.is_certain and not one.is_room for one in around)
    assert [one.is_shell for one in around] == [True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize("scene", [bathroom, two_storeys, tall_hall, rooms_in_a_row, l_shape])
def test_a_closed_place_with_things_in_it_is_a_room(scene):
    """Small, of two storeys, tall, in a row, and with a corner: up is given."""
    assert examined(scene()).is_room


@pytest.mark.slow
def test_a_room_under_a_steep_roof_is_never_certainly_an_object():
    """The places beside its roof are outside."""
    found = examined(attic())
    assert found.places > 0
    assert found.is_room or not found.is_certain


@pytest.mark.slow
def test_an_empty_closed_shell_is_an_object_and_never_certain():
    """It may be an empty room."""
    empty = examined(box((0, 0, 0), (5, 4, 2.5), 2700, 0))
    assert empty.is_shell
    assert not empty.is_certain


@pytest.mark.slow
def test_things_on_a_table_are_certainly_an_object():
    found = examined(on_table())
    assert found.is_certain
    assert not found.is_room


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.005, 0.03])
def test_a_room_full_of_large_floaters_is_a_room(share):
    room = solid(furnished(dense=2))
    count = round(share * len(room))
    generator = np.random.default_rng(1)
    points = generator.uniform(0, [5, 4, 2.5], (count, 3))
    floaters = gaussians_from_points(points, np.ones((count, 3)), sh_degree=0, opacity=0.6)
    sizes = torch.from_numpy(np.log(generator.uniform(0.1, 0.5, (count, 1)))).float()
    floaters.log_scales[:] = sizes
    found = examined(joined(room, floaters))
    assert found.is_room
    assert found.hazy > 0


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0, 33, 45])
def test_things_stand_on_the_floor_of_a_room_however_it_is_turned(degrees):
    """Its walls are as wide as its floor; a direction between two walls is a convention of files."""
    found = surroundings(furnished() @ rotation_about(UP, degrees).T)
    assert found.up.direction @ UP > 0.99
    assert found.up.reliable
    assert not found.rivals


@pytest.mark.slow
@pytest.mark.parametrize("scene", [l_shape, bathroom, two_storeys])
def test_a_room_whose_things_report_little_of_up_is_upright(scene):
    assert surroundings(scene()).up.direction @ UP > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("scene", [shelf, lambda: box((0, 0, 0), (5, 4, 2.5), 2700, 0)])
def test_a_wall_or_a_back_panel_that_may_be_the_ground_makes_up_a_guess(scene):
    assert not surroundings(scene()).up.reliable


@pytest.mark.slow
def test_the_sides_of_an_empty_room_are_rivals():
    assert len(surroundings(box((0, 0, 0), (5, 4, 2.5), 2700, 0)).rivals) >= 1


@pytest.mark.slow
def test_a_wrong_up_of_a_furnished_room_is_a_warning_and_a_right_one_is_none(caplog):
    for up, count in ((UP, 0), (-UP, 1), (np.array([1.0, 0, 0]), 1)):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "lexsplat"):
            surroundings(furnished(), up)
        assert caplog.text.count("direction in which things seem to stand (0,0,1)") == count


@pytest.mark.slow
def test_a_right_up_of_a_room_whose_up_is_a_guess_is_no_warning(caplog):
    with caplog.at_level(logging.WARNING, "lexsplat"):
        surroundings(l_shape(), UP)
    assert not caplog.text


def test_a_guess_contradicts_only_a_direction_that_is_much_less_likely():
    directions = np.array([[0, 0, 1.0], [0, 1, 0], [0, -1, 0]])
    upward = UpwardDirections(directions, np.array([1.5, 1.4, 0.5]), np.array([0.9, 0.9, 0.9]), False)
    assert [upward.contradict(2 * up) for up in (*directions, -UP)] == [False, False, True, True]
    np.testing.assert_array_equal(upward.rivals(), directions[1:2])
    assert all(replace(upward, reliable=True).contradict(up) for up in directions[1:])


def test_what_lies_in_a_plane_has_an_up_that_is_a_guess():
    picture = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1, 1, 0]
    assert not find_upward(picture, lambda _: 0.0).directions[0] @ UP < 0.99


@pytest.mark.slow
def test_a_room_so_small_that_the_near_plane_cuts_it_is_refused():
    with pytest.raises(CaptureError, match="scale the splats up"):
        surroundings(furnished() * 0.015)


@pytest.mark.slow
def test_a_bathroom_is_chosen_from_inside_by_default(caplog, monkeypatch):
    """As by the command: up is estimated, and there are as many candidates as usual."""
    monkeypatch.undo()
    with caplog.at_level(logging.WARNING, "lexsplat"):
        chosen: ChosenViews = choose_views(solid(bathroom()))
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert ((positions > 0) & (positions < [2.2, 1.8, 2.4])).all()
    assert chosen.unseen < 0.05 * chosen.visible
    assert "an object" not in caplog.text


@pytest.mark.slow
def test_floaters_that_hide_most_of_a_scene_are_a_warning(caplog, monkeypatch):
    """What hardly any place can see does not count as visible, so the share that no view shows may be small."""
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 30)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 6)
    table = solid(on_table())
    generator = np.random.default_rng(2)
    fog = gaussians_from_points(
        generator.uniform([-1.5, -1.5, 0.1], [1.5, 1.5, 1.5], (600, 3)),
        np.ones((600, 3)),
        sh_degree=0,
        opacity=0.6,
    )
    fog.log_scales[:] = np.log(0.25)
    for scene, warned in ((table, False), (joined(table, fog), True)):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "lexsplat"):
            choose_views(scene, up=UP)
        assert ("opaque Gaussians can be seen from any place" in caplog.text) == warned
