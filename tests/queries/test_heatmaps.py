import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from lexsplat.queries import heatmaps

GRAY = np.full((6, 8, 3), 128, np.uint8)


def test_the_scale_rises_in_lightness_at_every_step():
    lab = rgb2lab(heatmaps.color_scale()[None] / 255.0)[0]
    assert heatmaps.color_scale().shape == (256, 3)
    assert np.diff(lab[:, 0]).min() > 0
    assert lab[0, 0] < 10
    assert lab[-1, 0] > 90


def test_equal_steps_of_the_scale_look_about_equally_large():
    lab = rgb2lab(heatmaps.color_scale()[None, ::8] / 255.0)[0]
    steps = deltaE_ciede2000(lab[:-1], lab[1:])
    assert steps.max() / steps.min() < 3


def test_values_beyond_the_ends_take_the_colors_of_the_ends():
    colors = heatmaps.colorize(np.array([-1.0, 0.2, 0.8, 2.0, np.nan]), low=0.2, high=0.8)
    scale = heatmaps.color_scale()
    np.testing.assert_array_equal(colors, scale[[0, 0, 255, 255, 0]])
    with pytest.raises(ValueError, match="below"):
        heatmaps.colorize(np.zeros(3), low=1, high=1)


def test_an_overlay_glows_where_it_is_relevant_and_nowhere_else():
    relevancy = np.zeros((6, 8), np.float32)
    relevancy[2, 3] = 0.7
    found = heatmaps.overlay_heatmap(GRAY, relevancy)
    assert found.shape == GRAY.shape
    assert found.dtype == np.uint8
    brightness = found.astype(int).sum(-1)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (2, 3)
    assert len(np.unique(found[relevancy == 0], axis=0)) == 1


def test_an_absent_object_stays_dark():
    faint = np.full((6, 8), 0.02, np.float32)
    present = np.full((6, 8), 0.6, np.float32)
    assert heatmaps.overlay_heatmap(GRAY, faint).mean() < 0.6 * heatmaps.overlay_heatmap(GRAY, present).mean()


def test_bytes_and_floats_give_the_same_overlay():
    relevancy = np.linspace(0, 1, 48).reshape(6, 8)
    as_bytes = heatmaps.overlay_heatmap(GRAY, relevancy)
    as_floats = heatmaps.overlay_heatmap(GRAY / 255.0, relevancy)
    np.testing.assert_array_equal(as_bytes, as_floats)


def test_a_mask_is_outlined_and_the_rest_dimmed():
    mask = np.zeros((6, 8), bool)
    mask[1:5, 2:7] = True
    found = heatmaps.overlay_mask(GRAY, mask, color=(10, 200, 30))
    assert (found[1, 2] == (10, 200, 30)).all()
    assert (found[~mask] < GRAY[~mask]).all()
    assert not (found[2, 4] == (10, 200, 30)).all(), "the inside is tinted, not filled"


@pytest.mark.parametrize("draw", [heatmaps.overlay_heatmap, heatmaps.overlay_mask])
def test_a_map_of_another_size_is_refused(draw):
    with pytest.raises(ValueError, match="differ in size"):
        draw(GRAY, np.zeros((5, 8)))
