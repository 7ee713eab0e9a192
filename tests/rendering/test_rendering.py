"""The CPU rasterizer: laws of images, values that are no numbers, reproducibility, back-projection."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import rendering_reference as reference
from support.rendering_reference import FIELDS, front_camera, random_gaussians, with_gradients

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import accumulate_weights, back_project, prepare, render
from lexsplat.runtime.errors import BackendError


def test_depth_is_the_weighted_mean_of_the_depths_of_the_gaussians():
    gaussians, camera = random_gaussians(40, 3), front_camera()
    leaves = {k: v.detach() for k, v in reference.to_float64(gaussians).items()}
    projected = reference.project(leaves, camera, antialiased=False)
    image, alpha, _, clear = reference.blend(projected, projected["depth"][:, None], camera)
    found = render(gaussians, camera, depth=True)
    seen = clear & (alpha > 0.01)
    assert (found.depth - image[..., 0] / alpha)[seen].abs().max() < 1e-4
    assert (found.depth[alpha == 0] == 0).all()
    assert found.channels.shape[-1] == 3
    assert found.features.shape[-1] == 0


# --------------------------------------------------------------------------------------------------------- laws


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 80), st.integers(1, 60))
def test_the_order_of_the_gaussians_does_not_matter(seed, count, width, height):
    gaussians, camera = random_gaussians(count, seed), front_camera(width, height)
    shuffle = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    straight, shuffled = render(gaussians, camera), render(gaussians.select(shuffle), camera)
    assert torch.equal(straight.channels, shuffled.channels)
    assert torch.equal(straight.radii[shuffle], shuffled.radii)


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 99), st.integers(1, 69))
@example(50, 1, 24)
def test_a_crop_of_the_image_is_the_image_of_a_cropped_camera(seed, x, y):
    gaussians, camera = random_gaussians(80, seed, scale=0.02), front_camera(200, 140)
    # The Jacobian of a Gaussian far outside is evaluated at 1.15 times the field of view, as in gsplat and 3DGS, so
    # that it differs in a narrower field of view. Such Gaussians are excluded.
    seen = gaussians.means.double() @ torch.from_numpy(camera.viewmat[:3, :3]).T + camera.viewmat[:3, 3]
    pixels = (seen @ torch.from_numpy(camera.K).T)[:, :2] / seen[:, 2:]
    beside = (pixels - torch.tensor([x + 50.0, y + 35.0])).abs() > torch.tensor([65.0, 45.5])
    gaussians = gaussians.select(~beside.any(1))
    K = camera.K.copy()
    K[0, 2] -= x
    K[1, 2] -= y
    crop = Camera(100, 70, K, camera.viewmat)
    whole, part = render(gaussians, camera).image, render(gaussians, crop).image
    difference = (whole[y : y + 70, x : x + 100] - part).abs()
    assert (difference < 1e-4).float().mean() > 0.999


def test_an_opaque_gaussian_occludes_the_gaussians_behind_it():
    eye = torch.tensor(front_camera().position, dtype=torch.float32)
    wall = Gaussians(
        means=torch.stack([eye * 0.5, torch.zeros(3)]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        log_scales=torch.full((2, 3), 4.0),
        opacity_logits=torch.full((2,), 12.0),
        sh0=torch.tensor([[[1.0, -1.0, -1.0]], [[-1.0, 1.0, -1.0]]]),
        shN=torch.zeros(2, 0, 3),
    )
    both, front = (
        render(wall, front_camera()).image,
        render(wall.select(torch.tensor([0])), front_camera()).image,
    )
    assert (both - front).abs().max() < 1.2e-3  # alpha is clamped at 0.999
    assert (front[..., 0] > 0.7).all()


def test_an_empty_scene_is_the_background_and_has_empty_gradients():
    gaussians = with_gradients(random_gaussians(1, 0).select(torch.zeros(1, dtype=torch.bool)))
    background = torch.tensor([0.1, 0.2, 0.3])
    rendering = render(gaussians, front_camera(), background=background, features=torch.zeros(0, 4))
    assert torch.equal(rendering.image, background.expand_as(rendering.image))
    assert not rendering.features.any()
    assert not rendering.alpha.any()
    rendering.image.sum().backward()
    assert gaussians.means.grad.shape == (0, 3)


def test_gaussians_behind_the_camera_or_the_near_plane_are_not_drawn():
    gaussians, camera = random_gaussians(20, 0, scale=0.05), front_camera()
    behind = replace(gaussians, means=gaussians.means * 0.1 + 2 * torch.tensor(camera.position).float())
    rendering = render(behind, camera)
    assert not rendering.radii.any()
    assert not rendering.alpha.any()
    assert render(gaussians, camera).alpha.any()
    assert not render(gaussians, camera, near=100.0).alpha.any()


def test_the_near_plane_is_at_the_given_depth():
    camera = Camera(16, 16, np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), np.eye(4))
    gaussians = random_gaussians(4, 0, scale=0.05)
    gaussians.opacity_logits[:] = 2.0
    gaussians.means[:] = 0.0
    gaussians.means[:, 2] = torch.tensor([0.2499, 0.25, 0.2501, -0.25])
    assert (render(gaussians, camera, near=0.25).radii > 0).tolist() == [False, True, True, False]


def test_gaussians_at_equal_depth_are_drawn_in_index_order():
    gaussians, camera = random_gaussians(2, 0), front_camera()
    gaussians.means[:] = 0.0
    gaussians.opacity_logits[:] = 8.0
    gaussians.log_scales[:] = 0.0
    gaussians.sh0[:] = torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]]])
    gaussians.shN[:] = 0.0
    red, green, _ = render(gaussians, camera).image[18, 25].tolist()
    swapped = render(gaussians.select(torch.tensor([1, 0])), camera).image[18, 25].tolist()
    assert red > green
    assert swapped[1] > swapped[0]


def test_a_gaussian_across_the_image_border_is_clipped():
    camera = front_camera()
    at_edge = torch.linalg.inv(torch.tensor(camera.viewmat)) @ torch.tensor(
        [-camera.K[0, 2] / camera.K[0, 0] * 3.0, 0.0, 3.0, 1.0], dtype=torch.float64
    )
    gaussians = replace(random_gaussians(1, 0), means=at_edge[None, :3].float(), opacity_logits=torch.ones(1))
    leaves = {k: v.detach() for k, v in reference.to_float64(gaussians).items()}
    expected = reference.render(leaves, camera, antialiased=False, degree=3)
    found = render(gaussians, camera)
    assert found.alpha[:, 0].max() > 0.5
    assert (found.alpha - expected["alpha"])[expected["clear"]].abs().max() < 5e-6


@pytest.mark.parametrize("log_scale", [-40.0, -12.0, 6.0, 14.0, 30.0, 80.0])
@pytest.mark.parametrize("antialiased", [False, True])
def test_degenerate_scales_yield_finite_results(log_scale, antialiased):
    gaussians = random_gaussians(30, 2, antialiased=antialiased)
    gaussians.log_scales[::3, 0] = log_scale
    gaussians.log_scales[1::3] = log_scale
    gaussians = with_gradients(gaussians)
    rendering = render(gaussians, front_camera())
    (rendering.image.sum() + rendering.alpha.sum()).backward()
    assert rendering.channels.isfinite().all()
    assert rendering.alpha.min() >= 0
    assert rendering.alpha.max() <= 1
    for name in FIELDS:
        assert getattr(gaussians, name).grad.isfinite().all(), name


def test_gaussians_with_nan_or_infinity_are_not_drawn():
    gaussians, camera = random_gaussians(30, 2), front_camera()
    expected = render(gaussians.select(torch.arange(30) >= 5), camera)
    gaussians.means[0, 1] = float("nan")
    gaussians.means[1, 0] = float("inf")
    gaussians.quats[2] = float("nan")
    gaussians.quats[3] = 0
    gaussians.opacity_logits[4] = float("nan")
    found = render(gaussians, camera)
    assert not found.radii[:5].any()
    assert torch.equal(found.channels, expected.channels)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_invalid_values_of_one_gaussian_keep_the_results_of_others_finite(name, wrong, antialiased):
    gaussians = random_gaussians(30, 2, antialiased=antialiased)
    getattr(gaussians, name)[7].reshape(-1)[0] = wrong
    gaussians = with_gradients(gaussians)
    rendering = render(gaussians, front_camera())
    (rendering.image.sum() + rendering.alpha.sum()).backward()
    assert rendering.channels.isfinite().all()
    assert rendering.alpha.isfinite().all()
    for field in FIELDS:
        assert getattr(gaussians, field).grad.isfinite().all(), field


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 17), (17, 1), (15, 33)])
@pytest.mark.parametrize("channels", [0, 1, 2, 300])
def test_images_of_any_size_and_channel_count_equal_the_float64_reference(width, height, channels):
    gaussians, camera = random_gaussians(25, 6), front_camera(width, height)
    features = torch.randn(25, channels, generator=torch.Generator().manual_seed(0), requires_grad=True)
    leaves = {k: v.detach() for k, v in reference.to_float64(gaussians).items()}
    projected = reference.project(leaves, camera, antialiased=False)
    features64 = features.detach().double().requires_grad_()
    expected, alpha, _, clear = reference.blend(projected, features64, camera)
    found = render(gaussians, camera, features=features)
    assert found.features.shape == (height, width, channels)
    assert (found.alpha - alpha)[clear].abs().max() < 5e-6
    if channels:
        assert (found.features - expected)[clear].abs().max() < 2e-5
        found.features.mul(clear[..., None]).sum().backward()
        expected.mul(clear[..., None]).sum().backward()
        assert (features.grad - features64.grad).abs().max() < 1e-4


def test_a_hundred_thousand_gaussians_in_one_tile():
    # All are equal and wide: alpha is a = 0.005, and pixels finish with T = (1 - a)^n > 1e-4 >= (1 - a)^(n + 1).
    count, a = 100_000, 0.005
    camera = front_camera(16, 16)
    gaussians = with_gradients(
        Gaussians(
            means=torch.zeros(count, 3),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            log_scales=torch.full((count, 3), 6.0),
            opacity_logits=torch.full((count,), float(np.log(a / (1 - a)))),
            sh0=torch.zeros(count, 1, 3),
            shN=torch.zeros(count, 0, 3),
        )
    )
    rendering = render(gaussians, camera)
    n = int(np.floor(np.log(1e-4) / np.log(1 - a)))
    assert rendering.alpha.detach().numpy() == pytest.approx(1 - (1 - a) ** n, abs=2e-5)
    rendering.image.sum().backward()
    per_gaussian = gaussians.sh0.grad[:, 0, 0]
    assert int((per_gaussian > 0).sum()) in (n, n + 1)
    expected = 256 * 0.28209479 * a * (1 - a) ** np.arange(n)
    assert np.sort(per_gaussian.numpy())[::-1][: n - 1] == pytest.approx(expected[: n - 1], rel=2e-3)


# ------------------------------------------------------------------------------------------------ reproducibility


def one_hot(camera: Camera, count: int) -> torch.Tensor:
    codes = np.random.default_rng(0).integers(0, count, (camera.height, camera.width))
    return torch.nn.functional.one_hot(torch.from_numpy(codes), count).float()


def all_results(gaussians: Gaussians, camera: Camera) -> list[torch.Tensor]:
    gaussians = with_gradients(gaussians)
    features = torch.randn(len(gaussians), 6, generator=torch.Generator().manual_seed(0), requires_grad=True)
    background = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    rendering = render(gaussians, camera, features=features, background=background)
    (rendering.channels.square().sum() + rendering.alpha.sum()).backward()
    pose = torch.from_numpy(camera.viewmat).float().requires_grad_()
    render(with_gradients(gaussians), camera, viewmat=pose, depth=True).image.square().sum().backward()
    weights = back_project(gaussians, camera, one_hot(camera, 9))
    gradients = [getattr(gaussians, name).grad for name in FIELDS]
    gradients += [background.grad, pose.grad, features.grad, rendering.means2d.grad]
    return [rendering.channels, rendering.alpha, weights, *gradients]


def test_results_are_bit_identical_across_thread_counts_and_runs():
    gaussians, camera = random_gaussians(3000, 5, antialiased=True, scale=0.05), front_camera(165, 120)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 4, 4):
            torch.set_num_threads(threads)
            results.append(all_results(gaussians, camera))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for one, two in zip(results[0], other):
            assert torch.equal(one, two)


def test_a_prepared_view_renders_bit_identically_without_gradients_of_the_geometry():
    gaussians, camera = random_gaussians(300, 5, antialiased=True), front_camera(100, 70)
    features = torch.randn(300, 9, requires_grad=True)
    prepared = prepare(gaussians, camera)
    assert prepared.nbytes > 0
    for color in (True, False):
        straight = render(gaussians, camera, features=features, color=color)
        again = render(with_gradients(gaussians), camera, features=features, color=color, prepared=prepared)
        assert torch.equal(straight.channels, again.channels)
        assert torch.equal(straight.alpha, again.alpha)
        assert not again.means2d.requires_grad
        first, second = (
            torch.autograd.grad(r.features.square().sum(), features)[0] for r in (straight, again)
        )
        assert torch.equal(first, second)
    values = one_hot(camera, 2)
    assert torch.equal(
        back_project(gaussians, camera, values), back_project(gaussians, camera, values, prepared)
    )


def test_a_prepared_view_of_another_camera_or_scene_is_refused():
    gaussians, camera = random_gaussians(30, 5), front_camera()
    prepared = prepare(gaussians, camera)
    equal = Camera(camera.width, camera.height, camera.K.copy(), camera.viewmat.copy())
    render(gaussians, equal, prepared=prepared)
    with pytest.raises(ValueError, match="another camera"):
        render(gaussians, front_camera(60, 37), prepared=prepared)
    with pytest.raises(ValueError, match="another camera, scene"):
        render(random_gaussians(31, 5), camera, prepared=prepared)


def test_the_image_is_the_same_without_gradients():
    gaussians, camera = random_gaussians(100, 5), front_camera()
    with torch.no_grad():
        alone = render(with_gradients(gaussians), camera)
    assert not alone.channels.requires_grad
    assert torch.equal(alone.channels, render(with_gradients(gaussians), camera).channels)


# ------------------------------------------------------------------------------------------------- back-projection


@pytest.mark.parametrize("channels", [1, 7, 200])
def test_a_back_projected_map_equals_the_float64_reference(channels):
    gaussians, camera = random_gaussians(40, 9, antialiased=True), front_camera()
    leaves = {k: v.detach() for k, v in reference.to_float64(gaussians).items()}
    expected = reference.render(leaves, camera, antialiased=True, degree=3)
    values = one_hot(camera, channels) * expected["clear"][..., None]
    found = back_project(gaussians, camera, values)
    exact = torch.einsum("nhw,hwc->nc", expected["weights"], values.double())
    assert found.shape == (40, channels)
    assert (found - exact).abs().max() < 1e-4


def test_the_weights_of_a_view_are_the_back_projection_of_ones():
    gaussians, camera = random_gaussians(500, 9), front_camera(130, 90)
    parts = back_project(gaussians, camera, one_hot(camera, 12))
    assert torch.allclose(parts.sum(1), accumulate_weights(gaussians, camera), rtol=1e-4, atol=1e-3)


# ------------------------------------------------------------------------------------------------------- arguments


def test_invalid_arguments_are_refused():
    gaussians, camera = random_gaussians(5, 0), front_camera()
    with pytest.raises(ValueError, match="features must be"):
        render(gaussians, camera, features=torch.zeros(4, 3))
    with pytest.raises(ValueError, match="background must be"):
        render(gaussians, camera, background=torch.zeros(4))
    with pytest.raises(ValueError, match="viewmat must be"):
        render(gaussians, camera, viewmat=torch.eye(3))
    with pytest.raises(ValueError, match="viewmat must be"):
        render(gaussians, camera, viewmat=torch.eye(4), prepared=prepare(gaussians, camera))
    with pytest.raises(BackendError, match="found Gaussians on meta"):
        render(gaussians.to("meta"), camera)


def test_sh_degree_limits_the_coefficients_used():
    gaussians, camera = random_gaussians(30, 0, degree=2), front_camera()
    constant = replace(gaussians, shN=torch.zeros(30, 0, 3))
    assert torch.equal(render(gaussians, camera, sh_degree=0).image, render(constant, camera).image)
    assert torch.equal(render(gaussians, camera, sh_degree=9).image, render(gaussians, camera).image)


def test_transposed_and_expanded_tensors_are_read_correctly():
    gaussians, camera = random_gaussians(30, 0), front_camera()
    features = torch.randn(6, 30).T
    assert not features.is_contiguous()
    found = render(gaussians, camera, features=features)
    assert torch.equal(found.channels, render(gaussians, camera, features=features.contiguous()).channels)
    same = render(gaussians, camera, features=torch.tensor([[0.5, 0.25]]).expand(30, 2)).features
    assert torch.equal(same[..., 0], 2 * same[..., 1])
