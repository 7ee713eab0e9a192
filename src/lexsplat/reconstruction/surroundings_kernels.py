"""Sizes of Gaussians in images, computed pair by pair without intermediate arrays (Numba, CPU).

This module is separate from `surroundings` so that Numba is imported only when a block is trained.
"""

from __future__ import annotations

import numpy as np

from lexsplat.rendering.kernels.jit import kernel, parallel

_GRAIN = 1024
"""Gaussians per work item of a thread."""


def shares(images: np.ndarray, extents: np.ndarray, small: float) -> np.ndarray:
    """Share ``[C, N]`` of each Gaussian in each image.

    Args:
        images: World to camera ``[3, 4]``, focal lengths, principal point, width and height of each, ``[C, 18]``
            float32.
        extents: Centers, largest and second largest standard deviations ``[N, 5]`` float32.
        small: Geometric mean of the two deviations in pixels from which a share is 1.
    """
    found = np.empty((len(images), len(extents)), np.float32)
    parallel(_shares, len(extents), _GRAIN, images, extents, np.float32(small), found)
    return found


def largest_shares(images: np.ndarray, extents: np.ndarray, small: float) -> np.ndarray:
    """The largest share ``[N]`` of each Gaussian in any image; arguments as those of `shares`."""
    found = np.empty(len(extents), np.float32)
    parallel(_largest, len(extents), _GRAIN, images, extents, np.float32(small), found)
    return found


def _share(image: np.ndarray, extent: np.ndarray, small: np.float32) -> np.float32:
    x, y, z, longest, middle = extent[0], extent[1], extent[2], extent[3], extent[4]
    u = image[0] * x + image[1] * y + image[2] * z + image[3]
    v = image[4] * x + image[5] * y + image[6] * z + image[7]
    w = image[8] * x + image[9] * y + image[10] * z + image[11]
    radius = np.float32(3) * longest
    if not w > -radius:
        return np.float32(0)
    depth = max(w, np.float32(1e-3))
    across, down = image[12] * u / depth + image[14], image[13] * v / depth + image[15]
    reach = np.float32(1.5) * radius / depth
    wide, high = image[12] * reach + np.float32(2), image[13] * reach + np.float32(2)
    shown = -wide < across < image[16] + wide and -high < down < image[17] + high
    if not (shown or u * u + v * v + w * w < radius * radius):
        return np.float32(0)
    size = max(image[12], image[13]) * longest / depth
    return min(np.float32(1), size * size * (middle / longest / (small * small)))


_share = kernel(_share, inlined=True)


@kernel
def _shares(
    start: int, stop: int, images: np.ndarray, extents: np.ndarray, small: np.float32, found: np.ndarray
) -> None:
    for n in range(start, stop):
        for c in range(images.shape[0]):
            found[c, n] = _share(images[c], extents[n], small)


@kernel
def _largest(
    start: int, stop: int, images: np.ndarray, extents: np.ndarray, small: np.float32, found: np.ndarray
) -> None:
    for n in range(start, stop):
        largest = np.float32(0)
        for c in range(images.shape[0]):
            largest = max(largest, _share(images[c], extents[n], small))
        found[n] = largest
