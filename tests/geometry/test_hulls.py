"""What lies in the convex hull of a thing."""

from itertools import product

import numpy as np
import pytest

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
