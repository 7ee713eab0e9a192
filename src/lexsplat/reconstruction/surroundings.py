"""What the views of a visit show of the cells that it does not train: Gaussians with fixed values, thinned by image.

A Gaussian that is small in an image takes part in it by chance, enlarged to make up for those that do not. The number
in an image thus depends on what it shows, not on the size of the capture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction.block_files import merged

if TYPE_CHECKING:
    from lexsplat.geometry.cameras import Camera

SMALL = 2.0
"""Geometric mean of the two largest standard deviations in pixels below which a Gaussian takes part by chance."""

_AT_ONCE = 1 << 16
"""Pairs of a Gaussian and an image that are looked at together, which bounds the memory."""


@dataclass(frozen=True)
class Surroundings:
    """Gaussians that take part with fixed values.

    Args:
        gaussians: Those that take part in at least one image.
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
        """What cameras see of the Gaussians of some cells, one cell after the other."""
        parts, extents, draws = [], [], []
        for cell in cells:
            own = extents_of(cell)
            drawn = rng.random(len(cell), np.float32)
            rows = max(1, _AT_ONCE // len(cameras))
            starts = range(0, len(cell), rows)
            largest = [shares_in_images(cameras, own[start : start + rows]).max(0) for start in starts]
            taking = drawn < np.concatenate([np.zeros(0, np.float32), *largest])
            parts.append(cell.select(torch.from_numpy(np.flatnonzero(taking))))
            extents.append(own[taking])
            draws.append(drawn[taking])
        return cls(merged(parts), np.concatenate(extents), np.concatenate(draws))

    def __len__(self) -> int:
        return len(self.gaussians)

    def to(self, device: torch.device | str) -> Surroundings:
        """The same with the Gaussians on another device."""
        return replace(self, gaussians=self.gaussians.to(device))

    def in_image(self, camera: Camera) -> Gaussians:
        """Those that take part in an image, each enlarged to the area of all that it stands for."""
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
    """Chance ``[C, N]`` of Gaussians to take part in images: their area over that of `SMALL`, at most 1."""
    longest, middle = extents[:, 3], extents[:, 4]
    sizes = sizes_in_images(cameras, extents[:, :3], longest)
    return np.minimum(1.0, sizes**2 * (middle / longest / SMALL**2), dtype=np.float32)


def sizes_in_images(
    cameras: Sequence[Camera], centers: NDArray[np.float32], deviations: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Standard deviations ``[C, N]`` in pixels of Gaussians in the images of cameras; 0 outside of them.

    They reach three deviations far. Some that are just outside are counted too.
    """
    viewmats = np.array([camera.viewmat for camera in cameras], np.float32)
    intrinsics = np.array([camera.K for camera in cameras], np.float32)
    local = centers @ viewmats[:, :3, :3].transpose(0, 2, 1) + viewmats[:, None, :3, 3]
    depth, radii = np.maximum(local[..., 2], 1e-3), 3 * deviations
    found = local[..., 2] > -radii
    for axis in range(2):
        focal, middle = intrinsics[:, axis, axis, None], intrinsics[:, axis, 2, None]
        ends = np.array([(camera.width, camera.height)[axis] for camera in cameras], np.float32)[:, None]
        place = focal * local[..., axis] / depth + middle
        reach = 1.5 * focal * radii / depth + 2
        found &= (place > -reach) & (place < ends + reach)
    found |= np.square(local).sum(-1) < radii**2
    focal = intrinsics[:, (0, 1), (0, 1)].max(1)[:, None]
    return np.where(found, focal * deviations / depth, np.float32(0))
