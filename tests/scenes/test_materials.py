"""Where cloth and table meet under a thing: shapes of which a part is hidden, and the listed objects of a scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.scenes.materials import THING, UNLISTED, continued, kinds_of_segments, materials, outline

SIZE = 120
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] - SIZE / 2


def cloth(degrees, half=30.0):
    """A square around the middle, turned."""
    angle = np.radians(degrees)
    across = np.cos(angle) * COLUMNS + np.sin(angle) * ROWS
    ahead = -np.sin(angle) * COLUMNS + np.cos(angle) * ROWS
    return (np.abs(across) < half) & (np.abs(ahead) < half)


def hole_at_corner(degrees, across=26.0, ahead=16.0, radius=26.0):
    """A disk that hides one corner of the cloth and more of one edge than of the other."""
    angle = np.radians(degrees)
    column = np.cos(angle) * across - np.sin(angle) * ahead
    row = np.sin(angle) * across + np.cos(angle) * ahead
    return np.hypot(COLUMNS - column, ROWS - row) < radius


@pytest.mark.parametrize("degrees", range(0, 360, 25))
def test_the_hidden_corner_of_a_cloth_is_where_its_edges_meet(degrees):
    inside, hole = cloth(degrees), hole_at_corner(degrees)
    known = np.where(hole, -1, np.where(inside, 1, 0))
    found = continued(known)
    assert (found[~hole] == inside[~hole]).all(), "what is known stays"
    nearest = known[tuple(distance_transform_edt(hole, return_distances=False, return_indices=True))]
    wrong, by_nearest = (((each != inside) & hole).sum() / hole.sum() for each in (found, nearest))
    assert wrong <= 0.06  # .01 in the mean of all angles, .07 at worst
    assert by_nearest > 1.5 * wrong, "no rule so simple does it"


def test_a_thing_amid_the_cloth_and_specks_on_it_change_no_edge():
    inside, random = cloth(20.0), np.random.default_rng(0)
    speckled = np.where(inside, 1, 0)
    speckled[random.random(inside.shape) < 0.01] = 0
    hole = np.hypot(COLUMNS, ROWS) < 10
    shape = outline((speckled == 1) & ~hole, (speckled == 0) & ~hole)
    assert (shape != inside).mean() < 0.02


def test_a_material_whose_edges_are_not_seen_is_everywhere_and_one_alone_fills_the_hole():
    known = np.abs(COLUMNS) < 20
    assert outline(known, np.zeros_like(known)).all()
    hole = np.hypot(COLUMNS, ROWS) < 10
    assert (continued(np.where(hole, -1, 3)) == 3).all()
    assert (continued(np.full((SIZE, SIZE), -1)) == 0).all(), "nothing is known"


def test_among_surfaces_of_which_no_edge_is_seen_the_nearest_one_goes_on():
    """As table and floor on both sides of a wide gap: neither ends where the other begins."""
    found = continued(np.where(COLUMNS < -25, 0, np.where(COLUMNS > 25, 1, -1)))
    assert (found[np.abs(COLUMNS + 20) < 10] == 0).all()
    assert (found[np.abs(COLUMNS - 20) < 10] == 1).all()


def test_things_on_a_surface_and_surfaces_of_few_pixels_are_no_material():
    inside, thing, few = cloth(0.0), np.hypot(COLUMNS + 45, ROWS) < 8, np.hypot(COLUMNS - 45, ROWS) < 4
    covered = np.stack([~inside & ~thing & ~few, inside, few, thing], -1).astype(float)
    found, things = materials(covered, np.ones_like(inside))
    assert set(np.unique(found)) == {0, 1}
    assert things[thing].mean() > 0.8
    assert not things[inside].any()
    assert (found[inside] == 1).mean() > 0.95
    assert (found[thing | few] == 0).all(), "the table goes on under them"


def test_without_a_list_everything_is_one_material_and_nothing_a_thing():
    found, things = materials(np.zeros((SIZE, SIZE, 1)), np.ones((SIZE, SIZE), bool))
    assert (found == 0).all()
    assert not things.any()


def test_a_segment_is_of_what_most_of_its_gaussians_are_listed_as():
    points = np.random.default_rng(0).normal(size=(12, 3))
    scene = gaussians_from_points(points, np.full((12, 3), 0.5), sh_degree=0)
    labels = torch.tensor([0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3])
    segments = Segments(labels, torch.ones(12), torch.tensor([[0, 1, 2, 3]]))

    def listed(phrase, *members):
        mask = torch.zeros(12, dtype=torch.bool)
        mask[list(members)] = True
        return Selection(scene, {}, mask, mask.float(), phrase=phrase)

    objects = [listed("table", 0, 1, 2, 3), listed("mug", 4, 5), listed("tablecloth", 6, 7, 9)]
    assert kinds_of_segments(objects, segments).tolist() == [0, THING, 1, UNLISTED]


@pytest.mark.parametrize("degrees", [0.0, 33.0])
def test_a_cloth_that_ends_in_the_image_on_one_side_only_goes_on_behind_the_hole(degrees):
    angle = np.radians(degrees)
    inside = np.cos(angle) * COLUMNS + np.sin(angle) * ROWS < 5.0
    hole = np.hypot(COLUMNS - 5, ROWS) < 18
    found = continued(np.where(hole, -1, np.where(inside, 0, 1)))
    assert (found[hole] == ~inside[hole]).mean() > 0.93
