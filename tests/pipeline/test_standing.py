"""Claims about up in rooms of shelves, partitions and walls: it is right or a guess, and never certainly wrong."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lexsplat.pipeline.viewpoints.pieces import Pieces
from lexsplat.pipeline.viewpoints.standing import standing_shares
from lexsplat.pipeline.viewpoints.upward import UpwardDirections, find_upward

pytestmark = pytest.mark.slow

UP = np.array([0.0, 0.0, 1.0])
ROOM = np.array([12.0, 8.0, 3.0])
CLOSED, OPEN = (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4)


def box(low, high, density: float, generator: np.random.Generator, sides=CLOSED) -> np.ndarray:
    """Points on sides of a box: side 2 a is the low one of axis a, and 2 a + 1 the high one."""
    low, sizes = np.asarray(low, float), np.subtract(high, low)
    parts = []
    for side in sides:
        axis = side // 2
        count = max(8, round(density * float(np.prod(sizes) / sizes[axis])))
        points = generator.uniform(0, 1, (count, 3))
        points[:, axis] = side % 2
        parts.append(low + points * sizes)
    return np.concatenate(parts)


def shelves(seed: int = 0, sides=CLOSED, thick=0.4, count=6, along=(1.0, 6.5), high=2.2, bench=True):
    """A room of 12 x 8 x 3 with parallel upright shelves of 1 cm of noise."""
    generator = np.random.default_rng(seed)
    parts = [box((0, 0, 0), ROOM, 15, generator, sides)]
    for x in np.linspace(1.2, 10.6 - thick, count):
        parts.append(box((x, along[0], 0), (x + thick, along[1], high), 35, generator))
    if bench:
        parts.append(box((0.3, 7, 0), (3, 7.7, 0.75), 100, generator))
    points = np.concatenate(parts)
    return points + generator.normal(size=points.shape) * 0.01


def upward(points: np.ndarray) -> UpwardDirections:
    """Renders look the same from all sides of a closed room."""
    return find_upward(points, lambda _: 0.95)


FREE = {
    "a library": {},
    "without a bench": {"bench": False},
    "thin shelves": {"thick": 0.2, "count": 5},
    "low partitions": {"thick": 0.1, "high": 1.5, "along": (0.8, 5.5)},
    "an open hall": {"sides": OPEN},
}


@pytest.mark.parametrize("name", FREE)
def test_free_shelves_stand_on_the_floor_and_on_no_wall_that_they_are_near(name):
    """They end one meter from a wall, which is less than a third of the height of the room."""
    points = shelves(**FREE[name])
    found = upward(points)
    assert found.directions[0] @ UP > 0.99
    assert found.reliable
    assert not found.contradict(UP)
    floor, *walls = standing_shares(Pieces.of(points), np.array([UP, [0, 1, 0], [0, -1, 0], [1, 0, 0]]))
    assert floor > 0.7
    assert max(walls) < 0.6 * floor


AMBIGUOUS = {
    "against a wall": {"along": (0.0, 5.5)},
    "up to the ceiling": {"high": 3.0},
    "walls of a maze": {"high": 3.0, "along": (0.0, 5.5), "thick": 0.2, "bench": False},
    "wide racks against a wall": {"thick": 1.2, "count": 4, "along": (0.0, 6.5), "bench": False},
    "wide racks in an open hall": {"thick": 1.2, "count": 4, "along": (0.0, 6.5), "sides": OPEN},
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_shelves_that_touch_a_wall_as_well_as_the_floor_make_up_a_guess_that_contradicts_nobody(name):
    found = upward(shelves(**AMBIGUOUS[name]))
    assert not found.reliable
    assert not found.contradict(UP)


NAMES = [*FREE, *AMBIGUOUS]


@pytest.mark.parametrize("name", NAMES)
def test_however_a_room_of_shelves_is_turned_up_is_right_or_a_guess(name):
    """No two turns are the same, nor the points of two rooms."""
    seed = NAMES.index(name)
    turn = Rotation.random(random_state=seed).as_matrix()
    found = upward(shelves(**{**FREE, **AMBIGUOUS}[name], seed=seed) @ turn.T)
    if found.reliable:
        assert found.directions[0] @ (turn @ UP) > 0.99
    assert not found.contradict(turn @ UP)


def test_what_reaches_from_a_wall_to_the_opposite_one_stands_on_nothing():
    """A beam between two walls that lies on the floor, beside a crate that touches nothing else."""
    generator = np.random.default_rng(0)
    room = box((0, 0, 0), (4, 4, 2.5), 150, generator)
    crate = box((1, 2.5, 0), (2, 3, 0.8), 300, generator)
    beam = box((0, 1, 0), (4, 1.5, 0.8), 300, generator)
    assert standing_shares(Pieces.of(np.concatenate([room, crate])), UP[None])[0] > 0.9
    assert standing_shares(Pieces.of(np.concatenate([room, beam])), np.eye(3)[[2, 0]]).max() == 0
