"""A fill: Gaussians that close the hole under a thing, made by `scenes/filling.py`, as a journal keeps them."""

from __future__ import annotations

import base64
import binascii
import zlib
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import SH_C0, Gaussians

MOST = 1 << 20
"""Most Gaussians of a fill."""
_OPAQUE = 3.0
COLUMNS = 13
"""Numbers of a disk: see `Fill`."""
_BRIGHTEST = 100.0


class Fill(NamedTuple):
    """Gaussians that close a hole, and those around it that lose the shadow of a thing.

    Args:
        sources: The Gaussian whose language each takes ``[F]``.
        disks: Means, rotations (wxyz), logarithms of sizes, and RGB ``[F, 13]`` float32.
        lit: Gaussians of the scene that are brightened ``[L]``.
        factors: By how much ``[L]`` float32.
    """

    sources: NDArray[np.int32]
    disks: NDArray[np.float32]
    lit: NDArray[np.int32] = np.zeros(0, "<i4")
    factors: NDArray[np.float32] = np.zeros(0, "<f4")

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "gaussians": len(self.sources),
            "disks": _packed(self.sources, self.disks),
            "lit": len(self.lit),
            "light": _packed(self.lit, self.factors),
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Fill:
        """The inverse of `to_json`; earlier versions brighten nothing.

        Raises:
            ValueError: If the data are not a fill.
        """
        try:
            sources, disks = _unpacked(data["disks"], data["gaussians"], COLUMNS)
            if "lit" not in data:
                return cls(sources, disks)
            lit, factors = _unpacked(data["light"], data["lit"], 1)
        except (KeyError, TypeError, binascii.Error, zlib.error) as error:
            raise ValueError(f"not a fill: {error!r}") from error
        return cls(sources, disks, lit, factors[:, 0])

    def relit(self, scene: Gaussians) -> Gaussians:
        """The scene without the shadow: Gaussians in ``lit`` are brightened, by the larger factor if listed twice.

        Raises:
            ValueError: If a Gaussian is not in the scene, or a factor is not in 0..100.
        """
        if not len(self.lit):
            return scene
        if not 0 <= self.lit.min() <= self.lit.max() < len(scene):
            raise ValueError("the fill is for another number of Gaussians")
        if not ((self.factors > 0) & (self.factors <= _BRIGHTEST)).all():
            raise ValueError(f"the fill brightens by a factor that is not in 0..{_BRIGHTEST:g}")
        factors = np.zeros(len(scene), np.float32)
        np.maximum.at(factors, self.lit, self.factors)
        by = torch.from_numpy(np.where(factors > 0, factors, np.float32(1)))[:, None, None].to(scene.sh0)
        unlit = (by == 1)[:, 0]
        sh0 = ((scene.sh0 * SH_C0 + 0.5) * by - 0.5) / SH_C0
        sh0[unlit] = scene.sh0[unlit]  # to the last bit
        return replace(scene, sh0=sh0, shN=scene.shN * by)

    def gaussians(self, scene: Gaussians) -> Gaussians:
        """The Gaussians, with as many coefficients as those of a scene.

        Raises:
            ValueError: If a source is not in the scene, or a number is not finite or too large.
        """
        if len(self.sources) and not 0 <= self.sources.min() <= self.sources.max() < len(scene):
            raise ValueError("the fill is for another number of Gaussians")
        like = scene.select(torch.from_numpy(self.sources.astype(np.int64)).to(scene.device))
        means, quats, sizes, colors = (
            torch.from_numpy(self.disks.copy()).to(like.means).split([3, 4, 3, 3], 1)
        )
        found = replace(
            like,
            means=means.contiguous(),
            quats=quats.contiguous(),
            log_scales=sizes.contiguous(),
            opacity_logits=torch.full_like(like.opacity_logits, _OPAQUE),
            sh0=((colors - 0.5) / SH_C0)[:, None].contiguous(),
            shN=torch.zeros_like(like.shN),
        )
        if found.find_invalid():
            raise ValueError(f"the fill has {found.find_invalid()}")
        return found


def _packed(numbers: NDArray[np.int32], rows: NDArray[np.float32]) -> str:
    """Integers ``[F]`` and rows ``[F]`` or ``[F, C]`` as text."""
    raw = zlib.compress(numbers.tobytes() + rows.tobytes(), 6)
    return base64.b64encode(raw).decode("ascii")


def _unpacked(text: Any, count: Any, columns: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The inverse of `_packed`.

    Raises:
        ValueError: If the text is not so many rows.
    """
    if type(count) is not int or not 0 <= count <= MOST:
        raise ValueError(f"not a fill of {count!r} Gaussians"[:100])
    size = count * 4 * (1 + columns)
    raw = zlib.decompressobj().decompress(base64.b64decode(text), size + 1)
    if len(raw) != size:
        raise ValueError(f"not a fill: {len(raw)} bytes for {count} Gaussians")
    return np.frombuffer(raw, "<i4", count), np.frombuffer(raw, "<f4", offset=4 * count).reshape(
        count, columns
    )
