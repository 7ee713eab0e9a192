"""Patterns that go on in a hole: pictures from formulas, without any reconstruction."""

import numpy as np
import pytest

from lexsplat.scenes.completing import brightening, completed, painted, self_similar_shifts

SIZE, SQUARE, TURN = 112, 9.3, 0.4
WHITE, BLUE, WOOD = np.array([0.8, 0.78, 0.75]), np.array([0.15, 0.35, 0.75]), np.array([0.6, 0.4, 0.25])


def checkers(edge=np.inf):
    """A turned checker pattern ``[H, W, 3]``; wood beyond an edge."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    u, v = np.cos(TURN) * x + np.sin(TURN) * y, np.cos(TURN) * y - np.sin(TURN) * x
    even = (np.floor(u / SQUARE) + np.floor(v / SQUARE)) % 2 == 0
    return np.where((u > edge)[..., None], WOOD, np.where(even[..., None], WHITE, BLUE))


def disk(radius=20):
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2 + 3
    return np.hypot(x, y) < radius, np.hypot(x, y)


def psnr(found, original):
    return -10 * np.log10(((found - original) ** 2).mean())


def trust_outside(hole):
    return (~hole).astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("edge", [np.inf, 4.0])
def test_checkers_go_on_in_a_hole_and_end_where_they_ended_around_it(edge):
    original, (hole, _) = checkers(edge), disk()
    image = np.where(hole[..., None], [1.0, 0, 0], original)
    found = completed(image, hole, trust_outside(hole))
    assert psnr(found, original[hole]) > (20 if edge == np.inf else 16)
    assert psnr(painted(image, hole, trust_outside(hole)), original[hole]) < 15, (
        "the colors around are no pattern"
    )


@pytest.mark.slow
def test_a_shadow_and_remains_around_the_hole_do_not_spoil_the_pattern():
    original, (hole, away) = checkers(), disk()
    random = np.random.default_rng(0)
    shaded = original * (1 - 0.5 * np.exp(-np.maximum(away - 20, 0) / 8))[..., None]
    image = (shaded + random.normal(0, 0.05, original.shape)).clip(0, 1)
    remains = (away < 23) & (random.random(away.shape) < 0.5)
    image[remains] = [0.9, 0.1, 0.1]
    found = completed(image, hole, (away >= 23).astype(float))
    assert psnr(found, original[hole]) > 18
    assert found.mean() > 0.9 * original[hole].mean(), "as bright as without the shadow"


def test_a_surface_without_a_pattern_takes_the_colors_around():
    original = np.linspace(0.3, 0.7, SIZE)[None, :, None] * np.ones((SIZE, 1, 3))
    hole, _ = disk()
    noisy = (original + np.random.default_rng(1).normal(0, 0.05, original.shape)).clip(0, 1)
    assert psnr(completed(noisy, hole, trust_outside(hole)), original[hole]) > 24
    plain = np.full((SIZE, SIZE, 3), 0.4)
    np.testing.assert_allclose(completed(plain, hole, trust_outside(hole)), 0.4, atol=1e-6)


def test_the_best_shifts_are_the_periods_of_the_pattern():
    image = checkers()
    weights = np.ones((SIZE, SIZE))
    for down, right in self_similar_shifts(image, weights, weights)[:6]:
        u = (np.cos(TURN) * right + np.sin(TURN) * down) / SQUARE
        v = (np.cos(TURN) * down - np.sin(TURN) * right) / SQUARE
        assert abs(u - round(u)) < 0.1, (u, v)
        assert abs(v - round(v)) < 0.1, (u, v)
        assert (round(u) + round(v)) % 2 == 0, "white onto white"


def test_what_is_not_trusted_is_not_copied():
    original, (hole, _) = checkers(), disk()
    image, trust = original.copy(), trust_outside(hole)
    image[:, : SIZE // 4] = [0, 1, 0]
    trust[:, : SIZE // 4] = 0
    found = completed(image, hole, trust)
    assert np.abs(found - [0, 1, 0]).sum(1).min() > 0.5


def test_a_hole_takes_the_colors_around_by_inverse_squared_distance():
    image = np.zeros((1, 5, 3))
    image[0, 0], image[0, 4] = 0.2, 0.8
    hole = np.array([[False, True, True, True, False]])
    found = painted(image, hole, trust_outside(hole))[:, 0]
    expected = [(0.2 + 0.8 / 9) / (1 + 1 / 9), 0.5, (0.2 / 9 + 0.8) / (1 / 9 + 1)]
    np.testing.assert_allclose(found, expected)


@pytest.mark.slow
def test_at_the_edge_of_a_cloth_most_of_the_hole_is_cloth_or_wood_and_nothing_between():
    original, (hole, _) = checkers(4.0), disk()
    found = completed(original, hole, trust_outside(hole))
    apart = np.linalg.norm(found[:, None] - np.stack([WHITE, BLUE, WOOD]), axis=-1).min(1)
    assert (apart < 0.05).mean() > 0.8


@pytest.mark.slow
def test_a_pattern_goes_on_with_sharp_edges_and_the_same_each_time():
    original, (hole, _) = checkers(), disk()
    random = np.random.default_rng(0)
    noisy = (original + random.normal(0, 0.03, original.shape)).clip(0, 1)
    found = completed(noisy, hole, trust_outside(hole))
    apart = np.linalg.norm(found[:, None] - np.stack([WHITE, BLUE]), axis=-1).min(1)
    assert (apart < 0.15).mean() > 0.95, "copied, and no mean of white and blue"
    np.testing.assert_array_equal(found, completed(noisy, hole, trust_outside(hole)))


@pytest.mark.slow
def test_the_light_of_a_shadow_beside_the_hole_is_what_it_lacks_and_elsewhere_it_is_1():
    original, (hole, away) = checkers(), disk(14)
    shadow = 1 - 0.4 * np.exp(-((np.maximum(away - 14, 0) / 8) ** 2))
    found = brightening(original * shadow[..., None], hole, trust_outside(hole))
    beside, far = (away > 15) & (away < 18), away > 45
    assert np.abs(found[beside] * shadow[beside] - 1).mean() < 0.15
    np.testing.assert_array_equal(found[far], 1)
    assert found.min() >= 1, "nothing turns darker"
    np.testing.assert_array_equal(brightening(original, hole, trust_outside(hole) * (away > 45)), 1)
    plain = np.full((SIZE, SIZE, 3), 0.4)
    np.testing.assert_array_equal(brightening(plain, hole, trust_outside(hole)), 1)
    assert np.abs(brightening(original, hole, trust_outside(hole)) - 1).max() < 0.15, (
        "without a shadow nothing changes"
    )
