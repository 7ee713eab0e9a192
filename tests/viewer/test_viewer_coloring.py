"""Colors of language, codes and uncertainty, compared with scikit-learn's PCA and with loops."""

import numpy as np
import pytest
import torch
from support.language_scene import LanguageScene, make_codebook, make_scene

from lexsplat.language.fields import CodeField
from lexsplat.viewer.coloring import (
    MODES,
    code_palette,
    colors_in,
    language_colors,
)


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=80)


@pytest.fixture(scope="module")
def field(balls) -> CodeField:
    """Each Gaussian has its ball's code with weight 0.7 to 1, the next code with the rest; the last has none."""
    count = len(balls.labels)
    main = torch.from_numpy(0.7 + 0.3 * np.random.default_rng(0).random(count)).float()
    codes = torch.from_numpy(np.stack([balls.labels, (balls.labels + 1) % 5], 1)).to(torch.uint8)
    weights = torch.stack([main, 1 - main], 1)
    weights[-1] = 0
    return CodeField(balls.codebook, codes, weights, torch.linspace(0, 1, count))


def test_language_colors_are_the_principal_components_of_the_features(balls, field):
    from sklearn.decomposition import PCA

    features = (field.code_probabilities() @ balls.codebook.clip).double().numpy()[:-1]
    expected = PCA(3).fit_transform(features)
    colors = language_colors(field)[:-1].astype(float)
    inside = ((colors > 0) & (colors < 255)).all(1)
    assert inside.sum() > 50
    for channel in range(3):
        assert abs(np.corrcoef(colors[inside, channel], expected[inside, channel])[0, 1]) > 0.999
    low, high = np.percentile(expected[:, 0], [2, 98])
    unit = np.clip((expected[:, 0] - low) / (high - low), 0, 1) * 255
    assert min(np.abs(colors[:, 0] - unit).max(), np.abs(colors[:, 0] - (255 - unit)).max()) < 3


def test_gaussians_without_language_are_gray(balls, field):
    for mode in ("language", "codes"):
        assert np.ptp(colors_in(mode, field)[-1].astype(int)) < 12


def test_uncertainty_is_dark_where_it_is_low_and_every_mode_has_a_color_a_gaussian(field):
    brightness = colors_in("uncertainty", field).astype(int).sum(1)  # uncertainties ascend from 0 to 1
    assert brightness[0] < 90
    assert brightness[-1] > 400
    for mode in MODES:
        assert colors_in(mode, field).shape == (len(brightness), 3)


def test_a_field_with_a_single_code_has_language_colors(balls):
    same = CodeField(balls.codebook, torch.zeros(9, 1, dtype=torch.uint8), torch.ones(9, 1), torch.zeros(9))
    assert language_colors(same).shape == (9, 3)


def test_the_palette_has_distinct_colors():
    palette = code_palette(128)
    assert len(np.unique(palette, axis=0)) == 128


def test_an_unknown_mode_is_refused(balls, field):
    with pytest.raises(ValueError, match="mode"):
        colors_in("thermal", field)


def test_a_trained_field_has_language_and_code_colors(balls):
    from sklearn.decomposition import PCA

    from lexsplat.language.fields import TrainedField

    field = TrainedField.initial(
        balls.gaussians, make_codebook(7), generator=torch.Generator().manual_seed(0)
    )
    features = (field.code_probabilities() @ field.codebook.clip).double().numpy()
    expected = PCA(3).fit_transform(features)[:, 0]
    found = colors_in("language", field)[:, 0].astype(float)
    inside = (found > 0) & (found < 255)
    assert abs(np.corrcoef(found[inside], expected[inside])[0, 1]) > 0.999
    likeliest = field.code_probabilities().argmax(1).numpy()
    assert np.array_equal(colors_in("codes", field), code_palette(7)[likeliest])
