"""What lies in the convex hull of a thing."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from lexsplat.geometry.hulls import inside_hull

CUBE = np.array(list(product((0.0, 1.0), repeat=3)))


@pytest.mark.parametrize(
    ("place", "inside", "enlarged"), [(0.9, True, True), (1.02, False, True), (1.06, False, False)]
)
def test_a_place_beside_a_face_lies_in_the_hull_only_if_that_is_enlarged(place, inside, enlarged):
    places = np.array([[0.5, 0.5, place]])
    assert inside_hull(CUBE, places).tolist() == [inside]
    assert inside_hull(CUBE, places, 1.05).tolist() == [enlarged]


@pytest.mark.parametrize("points", [CUBE[:0], CUBE[:3], CUBE[CUBE[:, 2] == 0], np.zeros((9, 3))])
def test_nothing_lies_in_the_hull_of_few_or_flat_points(points):
    assert inside_hull(points, np.full((2, 3), 0.0)).tolist() == [False, False]


@given(
    seed=st.integers(0, 1000),
    count=st.integers(5, 60),
    flat=st.booleans(),
    grown=st.sampled_from([1.0, 1.05, 2.0]),
)
def test_the_hull_holds_what_a_triangulation_of_its_points_holds(seed, count, flat, grown):
    random = np.random.default_rng(seed)
    axes = 2 if flat else 3
    points, places = random.normal(size=(count, axes)), random.normal(size=(20, 10, axes))
    inside = inside_hull(points, places, grown)
    center = _corners(points).mean(0)
    expected = Delaunay(points).find_simplex(center + (places - center) / grown) >= 0
    assert inside.tolist() == expected.tolist()


def _corners(points):
    """Points that no other points surround: removed from a triangulation, they lie outside of it."""
    others = [np.delete(points, index, axis=0) for index in range(len(points))]
    return points[
        [Delaunay(rest).find_simplex(point) < 0 for point, rest in zip(points, others, strict=True)]
    ]
