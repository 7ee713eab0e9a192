"""Results of rendering and of its steps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from lexsplat.geometry.cameras import Camera


@dataclass(frozen=True)
class Projection:
    """Every Gaussian as an ellipse on the image.

    Args:
        means2d: Centers ``[N, 2]`` in pixels.
        conics: Inverse covariances ``[N, 3]`` (xx, xy, yy) in 1 / square pixels.
        opacities: Effective opacities ``[N]`` in 0..1, with the factor of the mip filter.
        depths: Distances along the view axis ``[N]``, world units, without gradient.
        radii: Radius in pixels, 0 for Gaussians that are not drawn: ``[N]`` from the CPU backend, ``[N, 2]`` (x, y)
            from gsplat.
        extents: Half sizes of the box ``[N, 2]`` in pixels outside of which alpha is below its threshold; CPU only.
        means: The centers in the world ``[N, 3]``, for shading; CPU only.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    depths: Tensor
    radii: Tensor
    extents: Tensor | None = None
    means: Tensor | None = None

    @property
    def nbytes(self) -> int:
        """Memory held, in bytes."""
        tensors = (getattr(self, field.name) for field in dataclasses.fields(self))
        return sum(t.numel() * t.element_size() for t in tensors if t is not None)


@dataclass(frozen=True)
class PreparedView:
    """Projection and tile pairs of one view, for geometry that does not change.

    Args:
        backend: Name of the module that made it.
        projection: Without gradients.
        pairs: The Gaussians of each tile, in the layout of the backend.
        camera: The camera it was made for.
    """

    backend: str
    projection: Projection
    pairs: Any
    camera: Camera

    @property
    def nbytes(self) -> int:
        """Memory held, in bytes."""
        return self.projection.nbytes + int(self.pairs.nbytes)


@dataclass(repr=False)
class Rendering:
    """One rendered view.

    Args:
        channels: Color, then features ``[H, W, C]``.
        alpha: 1 - transmittance behind the last Gaussian ``[H, W]`` in 0..1.
        means2d: Centers on the image ``[N, 2]`` in pixels; retains its gradient if it has one.
        radii: Radius in pixels ``[N]``, 0 for Gaussians that are not drawn.
        color_channels: Number of color channels: 3 or 0.
        depth: Mean depth ``[H, W]``, world units along the view axis, 0 where nothing is drawn; without gradient.
            None unless requested.
    """

    channels: Tensor
    alpha: Tensor
    means2d: Tensor
    radii: Tensor
    color_channels: int
    depth: Tensor | None = None

    def __repr__(self) -> str:
        height, width, count = self.channels.shape
        return f"Rendering({width}x{height}, {count} channels, {len(self.radii):,} Gaussians)"

    @property
    def image(self) -> Tensor:
        """RGB ``[H, W, 3]``; may exceed 1."""
        return self.channels[..., : self.color_channels]

    @property
    def features(self) -> Tensor:
        """Feature channels ``[H, W, C]``."""
        return self.channels[..., self.color_channels :]
