"""Losses between a rendered image and a photo: L1 and D-SSIM, the photometric loss of 3DGS.

SSIM uses an 11x11 Gaussian window with sigma 1.5 and reflects the image at its borders, as torchmetrics does, so
that every pixel contributes. The moments of a photo are constant during a training, so `SSIMTarget` stores them. On a
CPU kernels return the moments, and the loss with its analytic gradient; elsewhere the same formulas run in torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

SMALLEST_SIDE = 6
"""Smallest image side in pixels: reflection needs more than the window's radius of 5."""


@dataclass(frozen=True)
class SSIMTarget:
    """A photo and its local moments under the window of SSIM.

    Args:
        image: RGB ``[H, W, 3]`` in 0..1.
        mean: Local mean ``[H, W, 3]``.
        variance: Local variance ``[H, W, 3]``, not negative.
    """

    image: Tensor
    mean: Tensor
    variance: Tensor


def ssim_target(image: Tensor) -> SSIMTarget:
    """Prepare a photo ``[H, W, 3]`` (float32, 0..1) for `photometric_loss`.

    Raises:
        ValueError: If the shape is wrong or a side has fewer than 6 pixels.
    """
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < SMALLEST_SIDE:
        raise ValueError(
            f"image must be [H, W, 3] with sides of at least {SMALLEST_SIDE}, got {list(image.shape)}"
        )
    image = image.detach().contiguous()
    if image.device.type == "cpu" and image.dtype == torch.float32:
        from lexsplat.reconstruction.image_loss_kernels import moments

        height, width, _ = image.shape
        found = moments(image.numpy().reshape(height, width * 3))
        return SSIMTarget(image, *(torch.from_numpy(each).view(height, width, 3) for each in found))
    mean, variance = torch.empty_like(image), torch.empty_like(image)
    for channel in range(3):  # one at a time: a float64 convolution unfolds its input eleven times
        # In float64, because rounding of the squares would swamp the variance of bright, flat areas.
        exact = image[..., channel : channel + 1].double()
        local = _blur(exact)
        mean[..., channel] = local[..., 0]
        variance[..., channel] = (_blur(exact * exact) - local * local).clamp_min_(0.0)[..., 0]
    return SSIMTarget(image, mean, variance)


def photometric_loss(image: Tensor, target: SSIMTarget, ssim_weight: float = 0.2) -> Tensor:
    """``(1 - w) L1 + w (1 - SSIM)``, the loss of 3DGS.

    Args:
        image: RGB ``[H, W, 3]``.
        target: The photo, prepared by `ssim_target`.
        ssim_weight: w in 0..1.

    Raises:
        ValueError: If the shapes differ.
    """
    if image.shape != target.image.shape:
        raise ValueError(f"image is {list(image.shape)} but its photo {list(target.image.shape)}")
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _PhotometricOnCPU.apply(image, target, 1.0 - ssim_weight, ssim_weight)
    absolute = (image - target.image).abs().mean()
    return (1.0 - ssim_weight) * absolute + ssim_weight * (1.0 - _ssim_in_torch(image, target))


def _ssim_in_torch(image: Tensor, target: SSIMTarget) -> Tensor:
    """SSIM from differences to the photo, which avoids cancellation, as in `image_loss_kernels`."""
    c1, c2 = 0.01**2, 0.03**2
    difference = image - target.image
    mean = _blur(difference)
    spread = (_blur(difference * difference) - mean * mean).clamp_min(0.0)
    covariance = _blur(difference * (target.image - 0.5)) - mean * (target.mean - 0.5)
    luminance = 2 * target.mean * (target.mean + mean) + c1
    structure = 2 * (target.variance + covariance) + c2
    return (luminance / (luminance + mean * mean) * structure / (structure + spread)).mean()


def _blur(image: Tensor) -> Tensor:
    """The window of SSIM applied to ``[H, W, C]``, borders reflected."""
    taps = torch.exp(-((torch.arange(11.0, dtype=image.dtype, device=image.device) - 5) ** 2) / (2 * 1.5**2))
    taps = taps / taps.sum()
    planes = F.pad(image.permute(2, 0, 1)[:, None], (5, 5, 5, 5), mode="reflect")
    planes = F.conv2d(F.conv2d(planes, taps[None, None, None, :]), taps[None, None, :, None])
    return planes[:, 0].permute(1, 2, 0).contiguous()


@lru_cache(maxsize=16)
def _taps(height: int, width: int) -> tuple[np.ndarray, ...]:
    """Taps of the blur and of its transpose for one image size, in the layout of the kernel."""
    from lexsplat.reconstruction.image_loss_kernels import reflected_taps

    vertical, vertical_t = reflected_taps(height)
    horizontal, horizontal_t = reflected_taps(width)
    interleaved = [np.ascontiguousarray(np.repeat(t, 3, axis=0).T) for t in (horizontal, horizontal_t)]
    return vertical, interleaved[0], vertical_t, interleaved[1]


class _PhotometricOnCPU(torch.autograd.Function):
    """``l1_weight L1 + ssim_weight (1 - SSIM)``; the kernel computes value and gradient together."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: SSIMTarget, l1_weight: float, ssim_weight: float) -> Tensor:
        from lexsplat.reconstruction.image_loss_kernels import photometric

        height, width, _ = image.shape
        count = image.numel()
        rows, photo, mean, variance = (
            tensor.detach().contiguous().numpy().reshape(height, width * 3)
            for tensor in (image, target.image, target.mean, target.variance)
        )
        weights = l1_weight / count, ssim_weight / count
        l1, similarity, gradient = photometric(rows, photo, mean, variance, _taps(height, width), *weights)
        ctx.save_for_backward(torch.from_numpy(gradient).view(height, width, 3))
        value = l1_weight * l1 / count + ssim_weight * (1.0 - similarity / count)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        scale = upstream.item()
        return (gradient if scale == 1.0 else gradient * scale), None, None, None
