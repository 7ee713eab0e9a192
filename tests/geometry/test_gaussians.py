"""Stored and activated parameters of Gaussians, and their initialization from points."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lexsplat.geometry.gaussians import SH_C0, Gaussians, gaussians_from_points


def some_points(count: int = 50, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)).astype(np.float32), rng.uniform(size=(count, 3)).astype(np.float32)


@pytest.mark.slow
def test_initial_scales_are_the_mean_distance_to_three_neighbors():
    from sklearn.neighbors import NearestNeighbors

    points, colors = some_points()
    distances, _ = NearestNeighbors(n_neighbors=4).fit(points).kneighbors(points)
    gaussians = gaussians_from_points(points, colors)
    expected = np.repeat(distances[:, 1:].mean(1)[:, None], 3, axis=1)
    np.testing.assert_allclose(gaussians.scales.numpy(), expected, rtol=1e-5)


def test_the_initial_color_is_that_of_the_point():
    points, colors = some_points()
    gaussians = gaussians_from_points(points, colors, sh_degree=2)
    np.testing.assert_allclose((0.5 + SH_C0 * gaussians.sh0[:, 0]).numpy(), colors, atol=1e-6)
    assert gaussians.shN.shape == (50, 8, 3)
    assert not gaussians.shN.any()


def test_changing_the_gaussians_does_not_change_the_points():
    points, colors = some_points()
    before = points.copy(), colors.copy()
    for tensor in gaussians_from_points(points, colors).tensors().values():
        tensor.fill_(7.0)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(colors, before[1])


def test_the_initial_opacity_is_the_given_one():
    points, colors = some_points()
    torch.testing.assert_close(
        gaussians_from_points(points, colors, opacity=0.3).opacities, torch.full((50,), 0.3)
    )


def test_identical_points_get_a_positive_finite_size():
    gaussians = gaussians_from_points(np.zeros((8, 3)), np.zeros((8, 3)))
    assert torch.isfinite(gaussians.log_scales).all()
    assert (gaussians.scales > 0).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_points_than_neighbors_are_enough(count):
    points, colors = some_points(count)
    gaussians = gaussians_from_points(points, colors)
    assert len(gaussians) == count
    assert torch.isfinite(gaussians.log_scales).all()


def test_the_size_of_an_outlier_is_limited():
    points, colors = some_points(200)
    points[0] = 1e6
    scales = gaussians_from_points(points, colors).scales
    assert float(scales[0].max()) <= 101 * float(scales.median())


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_degree_is_read_from_the_number_of_coefficients(degree):
    points, colors = some_points(5)
    assert gaussians_from_points(points, colors, sh_degree=degree).sh_degree == degree


def test_select_keeps_every_tensor_aligned():
    points, colors = some_points(10)
    gaussians = replace(gaussians_from_points(points, colors), antialiased=True)
    index = torch.tensor([7, 2, 2])
    chosen = gaussians.select(index)
    assert chosen.antialiased
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(chosen.tensors()[name], tensor[index])


def test_detach_ends_the_gradient_history_and_shares_the_values():
    points, colors = some_points(4)
    gaussians = gaussians_from_points(points, colors).map(lambda tensor: tensor.requires_grad_())
    detached = gaussians.detach()
    assert not detached.means.requires_grad
    assert detached.means.data_ptr() == gaussians.means.data_ptr()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "N > 0"),
        (np.zeros((4, 2)), r"\[N, 3\]"),
        (np.full((4, 3), np.nan), "must be finite"),
    ],
)
def test_invalid_points_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        gaussians_from_points(points, np.zeros((len(points), 3)))


def test_colors_of_another_number_of_points_are_refused():
    with pytest.raises(ValueError, match="colors must be"):
        gaussians_from_points(np.zeros((4, 3)), np.zeros((5, 3)))


@pytest.mark.parametrize("opacity", [0.0, 1.0, -0.5])
def test_an_opacity_without_a_logit_is_refused(opacity):
    with pytest.raises(ValueError, match="opacity must be"):
        gaussians_from_points(np.zeros((4, 3)), np.zeros((4, 3)), opacity=opacity)


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"opacity_logits must be \[2\]"):
        Gaussians(
            means=torch.zeros(2, 3),
            quats=torch.zeros(2, 4),
            log_scales=torch.zeros(2, 3),
            opacity_logits=torch.zeros(2, 1),
            sh0=torch.zeros(2, 1, 3),
            shN=torch.zeros(2, 0, 3),
        )
