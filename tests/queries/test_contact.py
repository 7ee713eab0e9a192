"""What stands, lies or hangs on what, in a made-up room of known geometry with stray Gaussians."""

import itertools

import numpy as np
import pytest
import torch

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.relations import frame_of, holds, related
from lexsplat.queries.selection import Selection

UP = np.array([0.0, 0.0, 1.0])
FRAME = frame_of(None, UP)


def slab(rng, x, y, z, count, noise=0.01):
    """A horizontal surface between two places, as noisy as a reconstruction."""
    plan = np.c_[rng.uniform(*x, count), rng.uniform(*y, count)]
    return np.c_[plan, rng.normal(z, noise, count)]


def block(rng, x, y, z, count):
    return np.c_[rng.uniform(*x, count), rng.uniform(*y, count), rng.uniform(*z, count)]


def outside(points, *places):
    """The points that no thing at one of the places (x, y, radius) hides."""
    kept = np.ones(len(points), bool)
    for x, y, radius in places:
        kept &= np.hypot(points[:, 0] - x, points[:, 1] - y) > radius
    return points[kept]


def room(rng):
    """Things by name. The table top is at height 0; the floor is 2 below it; the wall is at y = 2."""
    table = slab(rng, (-2, 2), (-1, 1), 0.0, 4000)
    hidden = (abs(table[:, 0]) < 0.7) & (abs(table[:, 1]) < 0.6)  # by the cloth
    strays = rng.normal((0, 0, 0.2), (1.0, 0.5, 0.15), (60, 3))
    angle = rng.uniform(0, 2 * np.pi, 600)
    ring = np.c_[0.2 * np.cos(angle), 0.2 * np.sin(angle), rng.uniform(0.0, 0.08, 600)]
    wall = np.c_[rng.uniform(-3, 3, 3000), rng.normal(2.0, 0.01, 3000), rng.uniform(-1.0, 2.0, 3000)]
    side = np.c_[rng.normal(-3.0, 0.01, 3000), rng.uniform(-2, 2, 3000), rng.uniform(-2.0, 2.0, 3000)]
    legs = np.concatenate(
        [block(rng, (x, x + 0.1), (y, y + 0.1), (-2, 0), 60) for x in (-2, 1.9) for y in (-1, 0.9)]
    )
    return {
        "table": np.concatenate(
            [outside(table[~hidden], (-1.6, 0.85, 0.15), (1.2, 0.3, 0.2)), strays, legs]
        ),
        "cloth": outside(slab(rng, (-0.7, 0.7), (-0.6, 0.6), 0.012, 3000), (0.0, 0.0, 0.25)),
        "mug": block(rng, (-0.2, 0.2), (-0.2, 0.2), (0.02, 0.45), 600),
        "ring": ring + np.array([1.2, -0.6, 0.0]),
        "banana": block(rng, (-0.3, 0.3), (-0.8, -0.7), (0.0, 0.15), 400),  # in front of the cloth
        "crate": block(rng, (-1.08, -0.5), (0.27, 0.77), (0.0, 0.45), 800),  # over a corner of the cloth
        "bottle": block(rng, (-1.7, -1.5), (0.75, 0.95), (0.0, 0.7), 400),  # near the edge
        "lamp": np.concatenate(  # the shade; its stem belongs to nothing
            [block(rng, (1.0, 1.4), (0.1, 0.5), (0.5, 0.95), 500), rng.normal((1.2, 0.3, 0.6), 0.02, (5, 3))]
        ),
        "stem": block(rng, (1.18, 1.22), (0.28, 0.32), (0.0, 0.5), 200),
        "balloon": block(rng, (0.6, 0.8), (0.7, 0.9), (0.45, 0.75), 400),  # nothing below it
        "floor": slab(rng, (-3, 3), (-2, 2), -2.0, 4000),
        "dog": block(rng, (-0.4, 0.4), (-0.2, 0.2), (-2.0, -1.5), 500),  # below the table
        "wall": np.concatenate([wall, rng.normal((0, 1.4, 0.3), (1.0, 0.4, 0.4), (90, 3))]),
        "walls": np.concatenate([wall, side]),  # a corner
        "picture": block(rng, (-1.0, -0.4), (1.96, 1.99), (0.9, 1.4), 400),
        "chest": block(rng, (1.0, 2.0), (1.5, 1.98), (-2.0, -1.2), 600),  # on the floor, at the wall
        "ball": block(rng, (-2.6, -2.2), (1.2, 1.6), (-2.0, -1.6), 400),  # on the floor, in the corner
        "bird": block(rng, (2.0, 2.3), (1.9, 2.1), (2.0, 2.4), 300),  # on top of the wall
        "seat": np.concatenate(
            [slab(rng, (2.3, 2.9), (-1.9, -1.3), -1.5, 600), block(rng, (2.3, 2.9), (-1.35, -1.3), (-1.5, -0.7), 600),
             block(rng, (2.3, 2.35), (-1.9, -1.85), (-2, -1.5), 100),
             block(rng, (2.85, 2.9), (-1.9, -1.85), (-2, -1.5), 100)]
        ),
        "bear": block(rng, (2.4, 2.8), (-1.8, -1.45), (-1.5, -0.9), 600),
    }  # fmt: skip


def selections(things, turn=None, eye=(0.0, -6.0, 2.0)):
    points, labels = np.concatenate(list(things.values())), np.repeat(
        np.arange(len(things)), [len(cloud) for cloud in things.values()]
    )  # fmt: skip
    gaussians = gaussians_from_points(
        points if turn is None else points @ turn.T, np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8
    )
    cameras = {"front": look_at(eye, [0.0, 0.0, 0.0], UP, 64, 48, 0.8)}
    made = {}
    for number, name in enumerate(things):
        mask = torch.from_numpy(labels == number)
        made[name] = Selection(gaussians, cameras, mask, mask.float(), phrase=name)
        made[name] = made[name].described(parts=(made[name],))
    return made


@pytest.fixture(scope="module", params=[0, 1, 2])
def things(request):
    return selections(room(np.random.default_rng(request.param)))


ON = [
    ("ring", "table"), ("cloth", "table"), ("mug", "cloth"), ("mug", "table"), ("banana", "table"),
    ("bottle", "table"), ("lamp", "table"), ("table", "floor"), ("dog", "floor"), ("chest", "floor"),
    ("ball", "floor"), ("picture", "wall"), ("picture", "walls"), ("bird", "wall"), ("bear", "seat"),
    ("seat", "floor"), ("crate", "table"),
]  # fmt: skip
NOT_ON = [
    ("table", "ring"), ("table", "cloth"), ("cloth", "mug"), ("banana", "cloth"), ("mug", "floor"),
    ("balloon", "table"), ("lamp", "wall"), ("bottle", "wall"), ("table", "wall"), ("chest", "wall"),
    ("ball", "walls"), ("chest", "walls"), ("wall", "picture"), ("dog", "table"), ("ring", "cloth"), ("seat", "bear"),
    ("ring", "floor"), ("cloth", "floor"), ("crate", "cloth"),
]  # fmt: skip
UNDER = [
    ("table", "ring"), ("table", "mug"), ("cloth", "mug"), ("floor", "table"), ("dog", "table"), ("table", "balloon"),
    ("seat", "bear"), ("table", "cloth"),
]  # fmt: skip
NOT_UNDER = [
    ("ring", "table"), ("cloth", "table"), ("mug", "cloth"), ("banana", "cloth"), ("table", "dog"), ("ball", "table"),
    ("wall", "lamp"), ("picture", "wall"),
]  # fmt: skip


@pytest.mark.parametrize(("first", "second"), [pair for pair in ON if "walls" not in pair])
def test_what_stands_lies_or_hangs_on_something_is_on_it(things, first, second):
    assert holds("on", things[first], things[second], FRAME)


@pytest.mark.parametrize(("first", "second"), NOT_ON)
def test_what_is_beside_below_or_away_from_something_is_not_on_it(things, first, second):
    assert not holds("on", things[first], things[second], FRAME)


@pytest.mark.parametrize("seed", range(5))
def test_a_thing_at_the_far_edge_of_a_table_stands_on_what_it_hides(seed):
    rng = np.random.default_rng(seed)
    made = selections(
        {
            "table": slab(rng, (-2, 2), (-1, 1), 0.0, 4000),  # what photos from the front show of it
            "vase": block(rng, (0.2, 0.6), (0.97, 1.24), (0.0, 0.6), 600),
            "post": block(
                rng, (-0.9, -0.6), (1.02, 1.3), (-2.0, 0.5), 600
            ),  # from the floor up, beside the table
            "far": block(rng, (-1.6, -1.2), (1.4, 1.7), (0.0, 0.6), 600),
            "floor": slab(rng, (-3, 3), (-2, 3), -2.0, 4000),
        },
        eye=(0.0, -6.0, 0.0),
    )
    on = [name for name in ("vase", "post", "far") if holds("on", made[name], made["table"], FRAME)]
    assert on == ["vase"]


@pytest.mark.parametrize(("first", "second"), UNDER)
def test_what_carries_or_is_below_something_is_under_it(things, first, second):
    assert holds("under", things[first], things[second], FRAME)


@pytest.mark.parametrize(("first", "second"), NOT_UNDER)
def test_what_rests_on_something_or_is_beside_it_is_not_under_it(things, first, second):
    assert not holds("under", things[first], things[second], FRAME)


@pytest.mark.slow
def test_on_and_under_exclude_each_other_both_ways(things):
    pairs = list(itertools.permutations(things, 2))
    on, under = (
        {pair: holds(relation, *map(things.get, pair), FRAME) for pair in pairs}
        for relation in ("on", "under")
    )
    for pair in pairs:
        assert not (on[pair] and under[pair]), pair
        assert not (on[pair] and on[pair[::-1]]), pair
        assert not (under[pair] and under[pair[::-1]]), pair


def test_a_stem_of_no_selection_carries_a_shade_that_would_else_float():
    made = room(np.random.default_rng(0))
    made.pop("stem")
    without = selections(made)
    assert not holds("on", without["lamp"], without["table"], FRAME)


def test_what_stands_on_a_table_is_not_on_the_floor_that_has_a_few_points_of_the_table():
    made = room(np.random.default_rng(0))
    edge = block(np.random.default_rng(1), (-0.8, 0.8), (-0.8, 0.8), (-0.1, 0.03), 40)
    floor = np.concatenate([made.pop("floor"), edge])
    things = selections({**made, "floor": floor})
    assert holds("on", things["mug"], things["table"], FRAME)
    assert not holds("on", things["mug"], things["floor"], FRAME)
    assert not holds("on", things["banana"], things["floor"], FRAME)
    assert holds("on", things["dog"], things["floor"], FRAME)


def test_under_a_thing_is_what_carries_it_and_not_what_is_below_that(things):
    def names(relation, reference):
        everything = things["table"].described(
            parts=tuple(things.values()), mask=torch.ones_like(things["mug"].mask)
        )
        return {each.phrase for each in related(relation, everything, things[reference], FRAME).parts}  # fmt: skip

    assert names("under", "mug") == {"cloth", "table"}
    assert names("under", "table") == {"floor", "dog"}
    assert names("under", "cloth") == {"table"}
    assert names("on", "wall") == {"picture", "bird"}
    assert holds("under", things["floor"], things["mug"], FRAME), "asked for by name, it is below"
