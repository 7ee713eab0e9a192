"""Thin pieces that few long Gaussians show, such as the stand of a lamp."""

import numpy as np
import pytest
import torch

from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.pieces import level_with, with_pieces


def lamp(stand_length: float, below: float, count: int = 6):
    """A shade of 80 round Gaussians around the origin, and a stand of long upright ones that ends below it."""
    rng = np.random.default_rng(0)
    shade = rng.uniform(-0.2, 0.2, (80, 3))
    stand = np.c_[np.zeros((count, 2)), -0.2 - below - stand_length * (1 + np.arange(count))]
    points = np.concatenate([shade, stand])
    gaussians = gaussians_from_points(points, np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8)
    scales = torch.full((len(points), 3), 0.02)
    scales[80:, 2] = stand_length
    made = gaussians.map(lambda tensor: tensor)
    made.log_scales.copy_(scales.log())
    labels = np.repeat([0, 1], [80, count])
    return made, labels, np.full(len(points), 0.8)


def test_a_stand_whose_gaussians_reach_the_shade_is_a_piece_of_the_lamp():
    assert with_pieces(*lamp(stand_length=0.1, below=0.0)).tolist() == [0] * 86


def test_a_stick_that_does_not_reach_the_shade_is_not():
    assert with_pieces(*lamp(stand_length=0.1, below=0.2)).tolist() == [0] * 80 + [1] * 6


def test_round_gaussians_at_the_same_distance_do_not_reach_it():
    gaussians, labels, opacities = lamp(stand_length=0.1, below=0.0)
    gaussians.log_scales[80:, 2] = np.log(0.02)
    assert with_pieces(gaussians, labels, opacities).tolist() == labels.tolist()


@pytest.mark.parametrize("count", [3, 20], ids=["a speck", "as large as a thing"])
def test_neither_specks_nor_things_are_pieces(count):
    gaussians, labels, opacities = lamp(stand_length=0.1, below=0.0, count=count)
    assert with_pieces(gaussians, labels, opacities).tolist() == labels.tolist()


def test_clusters_are_numbered_from_0_and_nothing_has_no_pieces():
    gaussians, labels, opacities = lamp(stand_length=0.1, below=0.0)
    assert with_pieces(gaussians, 1 - labels, opacities).tolist() == [0] * 86
    empty = np.zeros(0, np.intp)
    assert with_pieces(gaussians.select(torch.zeros(0, dtype=torch.int64)), empty, empty * 1.0).size == 0


def table(gap: float):
    """A dense part of a table top, two sparse ones behind it in a row, and a speck far from them: 4 clusters."""
    front = np.c_[np.random.default_rng(0).uniform(0, 1, (400, 2)), np.zeros(400)]
    back = np.array([[0.5, 1.2, 0], [0.5, 1.2 + gap, 0], [0.5, 5, 0]])
    points = np.concatenate([front, back])
    gaussians = gaussians_from_points(points, np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8)
    scales = torch.full((len(points), 3), 0.02)
    scales[400:, :2] = 0.15
    gaussians.log_scales.copy_(scales.log())
    return gaussians, np.array([0] * 400 + [1, 2, 3]), np.full(len(points), 0.8)


def test_pieces_of_a_surface_join_it_however_small_and_those_join_that_reach_another_piece():
    assert with_pieces(*table(gap=0.3)).tolist() == [0] * 400 + [1, 2, 3]
    assert with_pieces(*table(gap=0.3), surface=True).tolist() == [0] * 402 + [1]
    assert with_pieces(*table(gap=0.6), surface=True).tolist() == [0] * 401 + [1, 2]


@pytest.mark.parametrize(("count", "joins"), [(24, True), (8, False)], ids=["a leg", "a speck"])
def test_a_leg_of_a_table_joins_it_as_it_joins_other_things_and_a_speck_below_does_not(count, joins):
    top = np.c_[np.random.default_rng(0).uniform(0, 1, (400, 2)), np.zeros(400)]
    leg = np.c_[np.full((count, 2), 0.5), -0.05 - 0.05 * np.arange(count)]
    points = np.concatenate([top, leg])
    gaussians = gaussians_from_points(points, np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8)
    gaussians.log_scales.fill_(np.log(0.03))
    labels = np.repeat([0, 1], [400, count])
    joined = with_pieces(gaussians, labels, np.full(len(points), 0.8), surface=True)
    assert (joined.max() == 0) == joins


def test_a_surface_without_opacity_has_no_pieces():
    gaussians, labels, opacities = table(gap=0.3)
    assert len(with_pieces(gaussians, labels, 0 * opacities, surface=True)) == len(labels)


def box_with_a_large_gaussian(height: float):
    """Small round Gaussians on five faces of a cube of side 1, and a flat one over its open top: 2 clusters."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (1000, 3))
    faces = rng.integers(0, 5, 1000)
    points[np.arange(1000), faces % 3] = np.where(faces < 3, -0.5, 0.5)  # the faces but that at z = .5
    points = np.concatenate([points, [[0, 0, height]]])
    gaussians = gaussians_from_points(points, np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8)
    gaussians.log_scales.fill_(np.log(0.03))
    gaussians.log_scales[-1] = torch.tensor([0.4, 0.4, 0.05]).log()
    return gaussians, np.repeat([0, 1], [1000, 1]), np.full(len(points), 0.8)


@pytest.mark.parametrize(("height", "joins"), [(0.49, True), (0.55, False)], ids=["in the face", "above it"])
def test_specks_fill_a_face_of_a_thing_that_they_reach_but_do_not_extend_it(height, joins):
    joined = with_pieces(*box_with_a_large_gaussian(height))
    assert joined.tolist() == [0] * 1000 + [0 if joins else 1]


def test_nothing_lies_within_a_flat_thing():
    gaussians, labels, opacities = box_with_a_large_gaussian(0.49)
    gaussians.means[:, 2] = 0.0
    assert with_pieces(gaussians, labels, opacities).tolist() == labels.tolist()


@pytest.mark.parametrize("normal", [0, 1, 2])
def test_a_cluster_is_level_with_a_surface_if_it_lies_within_its_thickness_far_away_or_near(normal):
    rng = np.random.default_rng(0)
    top = np.c_[rng.uniform(0, 4, (500, 2)), rng.uniform(-0.05, 0.05, 500)]
    places = [[9, 2, 0.02], [2, 2, 0.3], [2, 2, -0.3], [2, 2, 0.09]]
    points = np.concatenate([top, *(np.array(place) + rng.normal(0, 0.01, (9, 3)) for place in places)])
    gaussians = gaussians_from_points(
        np.roll(points, normal + 1, axis=1), np.full((len(points), 3), 0.5), sh_degree=0, opacity=0.8
    )
    gaussians.log_scales.fill_(np.log(0.01))
    labels = np.repeat(np.arange(5), [500, 9, 9, 9, 9])
    assert level_with(gaussians, labels, 0).tolist() == [True, True, False, False, False]
    assert level_with(gaussians, labels, 0, 1.5).tolist() == [True, True, False, False, True]
