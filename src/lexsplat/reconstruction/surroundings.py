"""Gaussians of untrained cells in the views of a visit: their values are fixed, and each image samples them.

Gaussians that are small in an image are sampled at random and enlarged to cover the same total area. The number
in an image thus depends on what it shows, not on the size of the capture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import Gaussians, joined

if TYPE_CHECKING:
    from lexsplat.geometry.cameras import Camera

SMALL = 2.0
"""Geometric mean of the two largest standard deviations in pixels below which a Gaussian takes part by chance."""


@dataclass(frozen=True)
class Surroundings:
    """Gaussians that take part with fixed values.

    Args:
        gaussians: Those used in at least one image.
        extents: Their centers, largest standard deviations, and second largest ones, ``[N, 5]`` on the host.
        draws: Random numbers ``[N]`` in 0..1. A Gaussian takes part in an image if its share there is larger.
    """

    gaussians: Gaussians
    extents: NDArray[np.float32]
    draws: NDArray[np.float32]

    @classmethod
    def seen(
        cls, cells: Iterable[Gaussians], cameras: Sequence[Camera], rng: np.random.Generator
    ) -> Surroundings:
        """Select the Gaussians of other cells that the cameras see, one cell after the other."""
        from lexsplat.reconstruction.surroundings_kernels import largest_shares

        parts, extents, draws, images = [], [], [], _images(cameras)
        for cell in cells:
            own = extents_of(cell)
            drawn = rng.random(len(cell), np.float32)
            taking = drawn < largest_shares(images, own, SMALL)
            parts.append(cell.select(torch.from_numpy(np.flatnonzero(taking))))
            extents.append(own[taking])
            draws.append(drawn[taking])
        return cls(joined(parts), np.concatenate(extents), np.concatenate(draws))

    def __len__(self) -> int:
        return len(self.gaussians)

    def to(self, device: torch.device | str) -> Surroundings:
        """The same with the Gaussians on another device."""
        return replace(self, gaussians=self.gaussians.to(device))

    def in_image(self, camera: Camera) -> Gaussians:
        """The sample for an image. Each Gaussian is enlarged to the area of all those that it stands for."""
        shares = shares_in_images([camera], self.extents)[0]
        taking = np.flatnonzero(self.draws < shares)
        part = self.gaussians.select(torch.from_numpy(taking).to(self.gaussians.device))
        kept = torch.from_numpy(shares[taking]).to(part.device)
        return replace(part, log_scales=part.log_scales - 0.5 * kept.log()[:, None])


def extents_of(gaussians: Gaussians) -> NDArray[np.float32]:
    """Centers, largest and second largest standard deviations ``[N, 5]`` of Gaussians on the host."""
    sizes = gaussians.scales.sort(1, descending=True).values[:, :2]
    return torch.cat([gaussians.means, sizes], 1).numpy()


def shares_in_images(cameras: Sequence[Camera], extents: NDArray[np.float32]) -> NDArray[np.float32]:
    """Probability ``[C, N]`` that a Gaussian is used in an image: its area over that of `SMALL`, at most 1.

    It is 0 outside of an image. Gaussians reach three deviations far; some that are just outside count as inside.
    """
    from lexsplat.reconstruction.surroundings_kernels import shares

    return shares(_images(cameras), extents, SMALL)


def _images(cameras: Sequence[Camera]) -> NDArray[np.float32]:
    """Cameras as the kernels read them, ``[C, 18]``."""
    return np.array(
        [
            [*camera.viewmat[:3].ravel(), *camera.K[(0, 1, 0, 1), (0, 1, 2, 2)], camera.width, camera.height]
            for camera in cameras
        ],
        np.float32,
    )
