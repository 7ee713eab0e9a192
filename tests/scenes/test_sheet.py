"""Thumbnails of objects: the part of a photo that each shows."""

from __future__ import annotations

import numpy as np
import pytest

from lexsplat.geometry.cameras import Camera
from lexsplat.scenes.sheet import _around


def photo(width: int, height: int) -> Camera:
    return Camera(width, height, np.array([[100, 0, width / 2], [0, 100, height / 2], [0, 0, 1]]), np.eye(4))


def shown(part: Camera, whole: Camera) -> tuple[np.ndarray, np.ndarray, float]:
    """The upper left and the lower right pixel of the photo that a part shows, and its magnification."""
    scale = part.K[0, 0] / whole.K[0, 0]
    first = whole.K[:2, 2] - part.K[:2, 2] / scale
    return first, first + np.array([part.width, part.height]) / scale, scale


@pytest.mark.parametrize("size", [(640, 480), (360, 640), (480, 270), (40, 30), (20, 240), (3, 2)])
@pytest.mark.parametrize(
    "box", [((0.4, 0.4), (0.6, 0.6)), ((-0.5, 0.2), (0.1, 3)), ((0.99, 0.99), (0.99, 0.99))]
)
def test_a_thumbnail_shows_nothing_outside_the_photo_and_magnifies_at_most_four_times(size, box):
    whole = photo(*size)
    part = _around(whole, np.array(box) * size)
    first, last, scale = shown(part, whole)
    assert (first >= -1e-9).all()
    assert (last <= np.array(size) + 1e-9).all()
    assert scale <= 4 + 1e-9
    assert part.width <= 240
    assert part.height <= 180


def test_a_thing_within_the_photo_is_whole_in_the_middle_of_its_thumbnail_with_space_around():
    whole, box = photo(640, 480), np.array([[300.0, 200], [360, 260]])
    part = _around(whole, box)
    first, last, scale = shown(part, whole)
    assert np.allclose(first + last, box.sum(0), atol=1)
    assert np.allclose(box[0, 1] - first[1], 0.2 * 60, atol=1)
    assert (part.width, part.height) == (240, 180)
    assert scale == pytest.approx(180 / (1.4 * 60))
