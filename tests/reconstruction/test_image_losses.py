"""Image losses compared with torchmetrics and scikit-image in float64, and their gradients with autograd."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate

from lexsplat.reconstruction import image_loss_kernels, image_losses
from lexsplat.reconstruction.image_losses import SSIMTarget, photometric_loss, ssim_target


def ssim(image: torch.Tensor, target: SSIMTarget) -> torch.Tensor:
    return 1.0 - photometric_loss(image, target, 1.0)


def two_images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth textured photo and a noisy rendering of it."""
    generator = torch.Generator().manual_seed(seed)
    ramp = torch.linspace(0, 0.6, width)[None, :, None] * torch.tensor([1.0, 0.5, 0.2])
    photo = (ramp + 0.4 * torch.rand(height, width, 3, generator=generator)).clamp(0, 1)
    image = photo + 0.1 * torch.randn(height, width, 3, generator=generator)
    return image, photo


def torchmetrics_ssim(image: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
    functional = pytest.importorskip("torchmetrics.functional.image", reason="torchmetrics is not installed")
    planes = (tensor.double().permute(2, 0, 1)[None] for tensor in (image, photo))
    return functional.structural_similarity_index_measure(*planes, data_range=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("height", "width"), [(6, 6), (7, 40), (40, 7), (33, 61), (64, 64)])
def test_ssim_equals_torchmetrics(height, width):
    image, photo = two_images(height, width)
    assert float(ssim(image, ssim_target(photo))) == pytest.approx(
        float(torchmetrics_ssim(image, photo)), abs=1e-6
    )


@pytest.mark.parametrize(("height", "width"), [(6, 6), (7, 40), (40, 7), (33, 61)])
def test_the_moments_of_a_photo_are_those_of_a_gaussian_window_in_float64(height, width):
    _, photo = two_images(height, width)
    weights = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(weights, weights)[:, :, None] / weights.sum() ** 2
    exact = photo.double().numpy()
    mean = correlate(exact, window, mode="mirror")
    variance = correlate(exact**2, window, mode="mirror") - mean**2
    target = ssim_target(photo)
    np.testing.assert_allclose(target.mean, mean, rtol=1e-7)
    np.testing.assert_allclose(target.variance, variance, rtol=1e-6, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 0.5, 0.9, 1.0, 1.1])
@pytest.mark.parametrize("noise", [1e-3, 1e-2, 0.1])
def test_ssim_is_exact_on_bright_flat_and_gray_surfaces(level, noise):
    # A variance of 1e-6 as the difference of squares near 1 is lost to float32 rounding, an SSIM error of 1e-4.
    generator = torch.Generator().manual_seed(0)
    photo = min(level, 1.0) + noise * torch.randn(31, 43, 1, generator=generator).expand(31, 43, 3)
    image = (level + noise * torch.randn(31, 43, 1, generator=generator).expand(31, 43, 3)).contiguous()
    image.requires_grad_()
    reference = image.detach().double().requires_grad_()
    expected = torchmetrics_ssim(reference, photo)
    (exact,) = torch.autograd.grad(expected, reference)
    for found in (ssim(image, ssim_target(photo)), image_losses._ssim_in_torch(image, ssim_target(photo))):
        (gradient,) = torch.autograd.grad(found, image)
        assert float(found.detach()) == pytest.approx(float(expected.detach()), abs=1e-6)
        assert float((gradient - exact).abs().max()) <= 2e-5 * float(exact.abs().max())


def test_an_image_equal_to_its_photo_has_zero_gradient():
    photo = torch.full((20, 30, 3), 0.9)
    image = photo.clone().requires_grad_()
    loss = photometric_loss(image, ssim_target(photo))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-7)
    assert not image.grad.any()


def test_the_torch_path_equals_torchmetrics():
    image, photo = two_images(33, 61)
    value = image_losses._ssim_in_torch(image.double(), ssim_target(photo.double()))
    assert float(value) == pytest.approx(float(torchmetrics_ssim(image, photo)), abs=1e-12)


def test_float64_images_use_torch_and_agree_with_the_kernel():
    image, photo = two_images(20, 30)
    single = photometric_loss(image, ssim_target(photo))
    double = photometric_loss(image.double(), ssim_target(photo.double()))
    assert double.dtype == torch.float64
    assert float(single) == pytest.approx(float(double), abs=1e-6)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("height", "width"), [(6, 9), (33, 61)])
def test_loss_and_gradient_equal_autograd_through_torchmetrics(height, width, weight):
    image, photo = two_images(height, width)
    image.requires_grad_()
    ours = photometric_loss(image, ssim_target(photo), weight)
    (gradient,) = torch.autograd.grad(3.0 * ours, image)

    reference = image.detach().double().requires_grad_()
    absolute = (reference - photo.double()).abs().mean()
    value = (1 - weight) * absolute + weight * (1 - torchmetrics_ssim(reference, photo))
    (expected,) = torch.autograd.grad(3.0 * value, reference)
    assert float(ours.detach()) == pytest.approx(float(value.detach()), abs=1e-6)
    assert float((gradient - expected).abs().max()) <= 2e-5 * float(expected.abs().max())


def test_a_slice_of_more_channels_gives_the_same_loss_and_gradient():
    image, photo = two_images(12, 17)
    channels = torch.cat([image, torch.ones(12, 17, 9)], dim=2).requires_grad_()
    target = ssim_target(photo)
    photometric_loss(channels[..., :3], target).backward()
    alone = image.clone().requires_grad_()
    photometric_loss(alone, target).backward()
    assert torch.equal(channels.grad[..., :3], alone.grad)
    assert not channels.grad[..., 3:].any()


def test_losses_are_bit_identical_for_any_number_of_threads(monkeypatch):
    image, photo = two_images(40, 50)
    target = ssim_target(photo)
    monkeypatch.setattr(image_loss_kernels, "PIXELS_PER_PIECE", 300)
    results = []
    threads = torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        leaf = image.clone().requires_grad_()
        loss = photometric_loss(leaf, target)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    torch.set_num_threads(threads)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_l1_of_a_constant_difference_is_that_difference():
    photo = ssim_target(torch.full((8, 8, 3), 0.25))
    assert float(photometric_loss(torch.full((8, 8, 3), 0.75), photo, 0.0)) == 0.5


@settings(max_examples=25)
@given(st.integers(6, 30), st.integers(6, 30), st.integers(0, 1000))
def test_ssim_is_one_for_equal_images_and_at_most_one_otherwise(height, width, seed):
    image, photo = two_images(height, width, seed)
    assert float(ssim(photo, ssim_target(photo))) == pytest.approx(1.0, abs=1e-5)
    assert float(ssim(image, ssim_target(photo))) < 1.0


@settings(max_examples=15)
@given(st.integers(6, 24), st.integers(6, 24), st.integers(0, 1000))
def test_ssim_is_invariant_to_mirroring(height, width, seed):
    image, photo = two_images(height, width, seed)
    plain = float(ssim(image, ssim_target(photo)))
    mirrored = float(ssim(image.flip(0, 1), ssim_target(photo.flip(0, 1))))
    assert mirrored == pytest.approx(plain, abs=2e-6)


@settings(max_examples=20)
@given(st.integers(6, 40))
def test_transposed_taps_are_the_transpose_of_the_reflected_blur(length):
    from lexsplat.reconstruction.image_loss_kernels import RADIUS, TAPS, reflected_taps

    dense = []
    for taps in reflected_taps(length):
        matrix = np.zeros((length, length))
        for i in range(length):
            for k in range(TAPS):
                if 0 <= i + k - RADIUS < length:
                    matrix[i, i + k - RADIUS] = taps[i, k]
                else:
                    assert taps[i, k] == 0
        dense.append(matrix)
    np.testing.assert_allclose(dense[0].sum(1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(dense[0].T, dense[1])


@pytest.mark.parametrize("shape", [(5, 20, 3), (20, 5, 3), (20, 20, 4), (20, 20)])
def test_invalid_photos_are_refused(shape):
    with pytest.raises(ValueError, match="image must be"):
        ssim_target(torch.zeros(shape))


def test_different_sizes_are_refused():
    with pytest.raises(ValueError, match="its photo"):
        photometric_loss(torch.zeros(10, 10, 3), ssim_target(torch.zeros(10, 11, 3)))
