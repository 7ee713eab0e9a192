"""Colors of Gaussians, compared with scikit-learn's PCA, hand-computed scales, and invariants."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.decomposition import PCA
from support.language_scene import make_codebook, make_scene

from lexsplat.language.fields import CodeField
from lexsplat.queries.heatmaps import colorize
from lexsplat.scenes.formats.tables import colors_of
from lexsplat.viewer.coloring import (
    MODES,
    PROMPT_COLORS,
    Coloring,
    Layer,
    code_palette,
    language_colors,
    likeliest_codes,
    peak_of,
)


@pytest.fixture(scope="module")
def balls():
    return make_scene(per_ball=80)


@pytest.fixture(scope="module")
def field(balls):
    """Each Gaussian has its ball's code with weight 0.7 to 1, the next code with the rest; the last has none."""
    count = len(balls.labels)
    main = torch.from_numpy(0.7 + 0.3 * np.random.default_rng(0).random(count)).float()
    codes = torch.from_numpy(np.stack([balls.labels, (balls.labels + 1) % 5], 1)).to(torch.uint8)
    weights = torch.stack([main, 1 - main], 1)
    weights[-1] = 0
    return CodeField(balls.codebook, codes, weights, torch.linspace(0, 1, count))


def layer(balls, ball: int, **options) -> Layer:
    scores = np.where(balls.labels == ball, 0.8, 0.1).astype(np.float32)
    return Layer(f"ball {ball}", scores, 0.5, PROMPT_COLORS[ball], **options)


def test_photo_colors_come_from_the_constant_spherical_harmonic(balls):
    gaussians = balls.gaussians.select(torch.arange(3))
    gaussians.sh0 = torch.tensor([[[0.0, 1.0, -1.0]], [[9.0, -9.0, 0.0]], [[0.0, 0.0, 0.0]]])
    expected = [[128, 200, 56], [255, 0, 128], [128, 128, 128]]  # 255 (0.5 + 0.2820948 c), cut to 0..255
    assert np.abs(colors_of(gaussians).astype(int) - expected).max() <= 1


def test_relevancy_changes_only_marked_gaussians(balls, field):
    coloring = Coloring(balls.gaussians, field)
    before = coloring.colors("photo")
    after = coloring.colors("relevancy", [layer(balls, 2)])
    changed = (before != after).any(1)
    assert np.array_equal(changed, balls.labels == 2)


def test_a_single_prompt_is_drawn_with_the_color_scale(balls, field):
    coloring = Coloring(balls.gaussians, field)
    marked = coloring.colors("relevancy", [layer(balls, 2)], opacity=1.0)[balls.labels == 2]
    full = colorize(np.array([1.0]))[0]  # 0.8 is the peak
    assert np.abs(marked.astype(int) - full).max() <= 1


def test_several_prompts_are_drawn_in_their_own_colors(balls, field):
    layers = [layer(balls, 1), layer(balls, 3)]
    colors = Coloring(balls.gaussians, field).colors("relevancy", layers, opacity=1.0)
    for ball in (1, 3):
        assert np.abs(colors[balls.labels == ball].astype(int) - PROMPT_COLORS[ball]).max() <= 1
    hidden = [layers[0], layer(balls, 3, shown=False)]
    colors = Coloring(balls.gaussians, field).colors("relevancy", hidden)
    assert (colors[balls.labels == 3] == colors[balls.labels == 0][0]).all()


def test_where_prompts_overlap_the_more_relevant_one_is_drawn(balls, field):
    sure = Layer("sure", np.full(len(balls.labels), 0.9, np.float32), 0.5, (255, 0, 0))
    unsure = Layer("unsure", np.full(len(balls.labels), 0.6, np.float32), 0.5, (0, 255, 0))
    unsure.peak = 1.0
    for layers in ([sure, unsure], [unsure, sure]):
        colors = Coloring(balls.gaussians, field).colors("relevancy", layers, opacity=1.0)
        assert (colors[:, 0] > colors[:, 1]).all()


def test_a_mask_overrides_the_threshold(balls, field):
    mask = balls.labels == 4
    colors = Coloring(balls.gaussians, field).colors("relevancy", [layer(balls, 2, mask=mask)])
    assert np.array_equal((colors != colors_of(balls.gaussians)).any(1), mask)


def test_opacity_and_fade_mix_linearly(balls, field):
    coloring = Coloring(balls.gaussians, field)
    clear = coloring.colors("relevancy", [layer(balls, 2)], opacity=0.0)
    assert np.array_equal(clear, coloring.photo)
    faded = coloring.colors("relevancy", [layer(balls, 2)], fade=1.0)
    rest = faded[balls.labels != 2]
    assert (rest == rest[:, :1]).all()  # gray
    assert rest.mean() > coloring.photo.mean()  # and light
    again = coloring.colors("relevancy", [layer(balls, 2)])
    assert np.array_equal(faded[balls.labels == 2], again[balls.labels == 2])  # marks do not fade


def test_colors_are_new_arrays(balls, field):
    coloring = Coloring(balls.gaussians, field)
    for mode in MODES:
        coloring.colors(mode)[:] = 7
        assert not (coloring.colors(mode) == 7).all()


def test_language_colors_are_the_principal_components_of_the_features(balls, field):
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
    coloring = Coloring(balls.gaussians, field)
    for mode in ("language", "codes"):
        assert np.ptp(coloring.colors(mode)[-1].astype(int)) < 12


def test_a_field_with_a_single_code_has_language_colors(balls):
    same = CodeField(balls.codebook, torch.zeros(9, 1, dtype=torch.uint8), torch.ones(9, 1), torch.zeros(9))
    assert language_colors(same).shape == (9, 3)


def test_likeliest_codes_have_the_largest_probability(balls, field):
    codes, known = likeliest_codes(field)
    probabilities = field.code_probabilities().numpy()
    assert np.array_equal(known, probabilities.sum(1) > 0)
    assert np.array_equal(codes[known], probabilities.argmax(1)[known])


def test_the_palette_has_distinct_colors():
    palette = code_palette(128)
    assert len(np.unique(palette, axis=0)) == 128


def test_depth_is_bright_near_the_camera(balls, field):
    coloring = Coloring(balls.gaussians, field)
    eye = np.array([10.0, 0, 0])
    colors = coloring.colors("depth", eye=eye).astype(float).sum(1)
    distance = np.linalg.norm(balls.gaussians.means.numpy() - eye, axis=1)
    assert np.corrcoef(colors, distance)[0, 1] < -0.9
    low, high = coloring.scale
    assert low == pytest.approx(np.percentile(distance, 1), rel=1e-4)
    assert high == pytest.approx(np.percentile(distance, 95), rel=1e-4)


def test_an_unknown_mode_is_refused(balls, field):
    with pytest.raises(ValueError, match="mode"):
        Coloring(balls.gaussians, field).colors("thermal")


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=60), st.floats(0, 1))
def test_marked_and_amount_agree_with_a_loop(values, threshold):
    scores = np.array(values, np.float32)
    one = Layer("x", scores, threshold)
    marked = [i for i, value in enumerate(scores) if value >= threshold]
    assert one.marked().tolist() == marked
    amount = one.amount(one.marked())
    assert ((amount >= 0) & (amount <= 1)).all()
    assert peak_of(scores) == sorted(scores)[min(len(scores) - 1, int(0.999 * len(scores)))]


def test_a_trained_field_has_language_and_code_colors(balls):
    from lexsplat.language.fields import TrainedField

    field = TrainedField.initial(
        balls.gaussians, make_codebook(7), generator=torch.Generator().manual_seed(0)
    )
    coloring = Coloring(balls.gaussians, field)
    features = (field.code_probabilities() @ field.codebook.clip).double().numpy()
    expected = PCA(3).fit_transform(features)[:, 0]
    found = coloring.colors("language")[:, 0].astype(float)
    inside = (found > 0) & (found < 255)
    assert abs(np.corrcoef(found[inside], expected[inside])[0, 1]) > 0.999
    codes, _ = likeliest_codes(field)
    assert np.array_equal(codes, field.code_probabilities().argmax(1).numpy())
