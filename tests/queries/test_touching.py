"""Things that touch: surfaces of spheres, boxes and tubes whose number of things is known."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.selection import Selection
from lexsplat.queries.touching import divided

UP = np.array([0.0, 0.0, 1.0])


def sphere(random, count, center=(0, 0, 0), radius=1.0, stretch=(1, 1, 1)):
    directions = random.normal(size=(count, 3))
    return center + radius * np.array(stretch) * directions / np.linalg.norm(directions, axis=1)[:, None]


def box(random, count, size, center=(0, 0, 0)):
    areas = np.prod(size) / np.array(size)
    points = random.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), random.choice(3, count, p=areas / areas.sum())] = random.choice(
        [-0.5, 0.5], count
    )
    return points * size + center


def tube(random, count, ring, radius, center=(0, 0, 0), turn=2 * np.pi, standing=False):
    along, around = random.uniform(0, turn, count), random.uniform(0, 2 * np.pi, count)
    out = ring + radius * np.cos(around)
    points = np.stack([out * np.cos(along), out * np.sin(along), radius * np.sin(around)], 1)
    return (points[:, [0, 2, 1]] if standing else points) + center


def cylinder(random, count, radius, height, center=(0, 0, 0)):
    """The wall and the bottom: a mug without a handle."""
    angle, wall = random.uniform(0, 2 * np.pi, count), random.random(count) < 0.85
    out = radius * np.where(wall, 1.0, np.sqrt(random.random(count)))
    z = np.where(wall, random.random(count), 0.0) * height
    return np.stack([out * np.cos(angle), out * np.sin(angle), z], 1) + center


def spheres(centers):
    return lambda random: np.concatenate([sphere(random, 400, center) for center in centers])


def legs(random, x, y, height):
    places = [(a * x, b * y, -height / 2) for a in (-1, 1) for b in (-1, 1)]
    return np.concatenate([box(random, 100, (0.1, 0.1, height), place) for place in places])


def teddy(random):
    parts = [((0, 0, 0), 1.0), ((0, 0, 1.5), 0.7)]
    for side in (-1, 1):
        parts += [((0.55 * side, 0, 2.1), 0.22), ((side, 0, 0.3), 0.35), ((0.7 * side, 0.8, -0.7), 0.42)]
    return np.concatenate([sphere(random, int(500 * radius**1.5), at, radius) for at, radius in parts])


SEVERAL = {
    "two apples": (2, spheres([(0, 0, 0), (2, 0, 0)])),
    "two apples in a row with a third": (3, spheres([(0, 0, 0), (2, 0, 0), (4, 0, 0)])),
    "three apples around a point": (3, spheres([(1.155, 0, 0), (-0.577, 1, 0), (-0.577, -1, 0)])),
    "two boxes at their corners": (
        2,
        lambda r: np.concatenate([box(r, 500, (1, 1, 1)), box(r, 500, (1, 1, 1), (1, 0.7, 0))]),
    ),
}
ONE = {
    "sphere": lambda r: sphere(r, 700),
    "long ellipsoid": lambda r: sphere(r, 800, stretch=(3, 1, 1)),
    "cylinder": lambda r: cylinder(r, 700, 0.5, 2),
    "book": lambda r: box(r, 700, (1.5, 1, 0.2)),
    "two boxes whose faces meet": lambda r: box(r, 900, (2, 1, 1)),
    "sofa": lambda r: np.concatenate(
        [
            box(r, 500, (4, 1.5, 0.8)),
            box(r, 300, (4, 0.4, 1.6), (0, 0.6, 0.4)),
            box(r, 150, (0.4, 1.5, 1.2), (-1.9, 0, 0.2)),
            box(r, 150, (0.4, 1.5, 1.2), (1.9, 0, 0.2)),
        ]
    ),
    "table": lambda r: np.concatenate([box(r, 700, (3, 1.5, 0.1)), legs(r, 1.4, 0.7, 1.4)]),
    "chair": lambda r: np.concatenate(
        [box(r, 300, (1, 1, 0.1)), box(r, 300, (1, 0.1, 1), (0, 0.45, 0.5)), legs(r, 0.45, 0.45, 1)]
    ),
    "bicycle": lambda r: np.concatenate(
        [
            tube(r, 300, 0.35, 0.03, standing=True),
            tube(r, 300, 0.35, 0.03, (1.05, 0, 0), standing=True),
            box(r, 80, (1, 0.04, 0.04), (0.5, 0, 0.35)),
            box(r, 60, (0.05, 0.5, 0.04), (0.1, 0, 0.6)),
            box(r, 60, (0.04, 0.2, 0.6), (0.55, 0, 0.25)),
        ]
    ),
    "teddy bear": teddy,
    "mug": lambda r: np.concatenate(
        [cylinder(r, 600, 0.5, 1), tube(r, 120, 0.3, 0.07, (0.5, 0, 0.5), standing=True)]
    ),
    "apple beside a mug": lambda r: np.concatenate(
        [sphere(r, 400, (0, 0, 1)), cylinder(r, 700, 1.2, 2.6, (2.2, 0, 0))]
    ),
    "banana": lambda r: tube(r, 600, 1, 0.2, turn=2.2),
    "ring": lambda r: tube(r, 800, 1, 0.25),
    "hourglass": spheres([(0, 0, 0), (0, 0, 1.9)]),
    "snowman": lambda r: np.concatenate([sphere(r, 500), sphere(r, 400, (0, 0, 1.7), 0.8)]),
}


def number_of_things(points, up=UP):
    one = np.zeros(len(points), np.intp)
    return int(divided(points, np.ones(len(points), bool), one, up).max()) + 1


def turned(points, random, noise):
    """Points that are turned about the vertical axis, with noise relative to half of their size."""
    turn = Rotation.from_rotvec(UP * random.uniform(0, 2 * np.pi))
    return (
        turn.apply(points) + random.normal(size=points.shape) * noise * np.median(np.ptp(points, axis=0)) / 2
    )


@pytest.mark.parametrize("name", SEVERAL)
def test_things_that_touch_are_counted_apart(name):
    expected, make = SEVERAL[name]
    for seed in range(3):
        for noise in (0, 0.03):
            random = np.random.default_rng(seed)
            assert number_of_things(turned(make(random), random, noise)) == expected, (seed, noise)


@pytest.mark.parametrize("name", ONE)
def test_one_thing_stays_one_whatever_its_parts(name):
    for seed in range(3):
        for noise in (0, 0.03):
            random = np.random.default_rng(seed)
            assert number_of_things(turned(ONE[name](random), random, noise)) == 1, (seed, noise)


def test_a_dumbbell_counts_as_two():
    random = np.random.default_rng(0)
    bar = sphere(random, 120, (1.5, 0, 0), 0.2, (4, 1, 1))
    assert number_of_things(np.concatenate([sphere(random, 400), sphere(random, 400, (3, 0, 0)), bar])) == 2


def test_up_decides_what_stands_beside_and_what_above():
    random = np.random.default_rng(0)
    points = spheres([(0, 0, 0), (2, 0, 0)])(random)
    assert number_of_things(points, np.array([0.0, 1.0, 0.2])) == 2
    assert number_of_things(points, np.array([1.0, 0.0, 0.0])) == 1


def test_every_point_joins_the_thing_it_is_part_of_and_other_clusters_keep_their_numbers():
    random = np.random.default_rng(0)
    points = np.concatenate([spheres([(0, 0, 0), (2, 0, 0)])(random), sphere(random, 200, (9, 0, 0))])
    owner = np.repeat([0, 1, 2], [400, 400, 200])
    firm = random.random(len(points)) < 0.7
    labels = divided(points, firm, (owner == 2).astype(np.intp), UP)
    assert set(labels[owner == 2]) == {1}
    first, second = (np.bincount(labels[owner == one], minlength=3) for one in (0, 1))
    assert min(first.max(), second.max()) > 380, "of 400"
    assert first.argmax() != second.argmax()
    few = random.permutation(800)[:100]
    assert divided(points[few], np.ones(100, bool), np.zeros(100, np.intp), UP).max() == 0


def test_a_selection_counts_apples_that_touch_and_holds_each_whole():
    random = np.random.default_rng(0)
    points = spheres([(0, 0, 1), (2, 0, 1), (4, 0, 1)])(random)
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5), sh_degree=0, opacity=0.7)
    camera = look_at(np.array([2, -9, 4.0]), np.array([2, 0, 1.0]), UP, 48, 36, 0.9)
    chosen = Selection(gaussians, {"a": camera}, torch.ones(1200).bool(), torch.ones(1200))
    assert chosen.count == 3
    centers = sorted(instance.center.tolist() for instance in chosen.instances)
    np.testing.assert_allclose(centers, [(0, 0, 1), (2, 0, 1), (4, 0, 1)], atol=0.1)
    assert sum(map(len, chosen.instances)) == 1200
    assert chosen.clusters()[0].count == 1
