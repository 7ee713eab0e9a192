"""The images by which encoders are checked."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from lexsplat.features.checks import CAPTURE, PLACES, WORDS, bundled_images


@pytest.mark.parametrize("word", WORDS)
def test_the_image_of_a_word_is_where_its_mask_is_widest(word):
    widest = 0
    for path in sorted(CAPTURE.glob(f"segmentations/*/{word.replace(' ', '_')}.png")):
        with Image.open(path) as mask:
            columns, rows = (np.asarray(mask.convert("L")).any(axis) for axis in (0, 1))
        left, right = np.flatnonzero(columns)[[0, -1]]
        if right + 1 - left > widest:
            widest, found = right + 1 - left, (path.parent.name, rows, left, right)
    name, (x0, y0, x1, y1) = PLACES[word]
    view, rows, left, right = found
    top, bottom = np.flatnonzero(rows)[[0, -1]]
    assert x1 - x0 == widest
    assert (name, (x0, y0, x1, y1)) == (view, (left, top, right + 1, bottom + 1))


def test_an_image_of_one_word_is_that_among_all():
    images = bundled_images(48)
    assert images.shape == (len(WORDS), 3, 48, 48)
    assert bundled_images(48, WORDS[3:5]).equal(images[3:5])
