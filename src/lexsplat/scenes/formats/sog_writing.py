"""Writing SOG archives; `lexsplat.scenes.formats.sog` describes the format."""

from __future__ import annotations

import io
import itertools
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.scenes.formats.foreign import without_the_largest
from lexsplat.scenes.formats.sog import COEFFICIENTS, FIRST_TAG, META, PALETTE_WIDTH

_TABLE = 256
_TABLE_SAMPLE = 1 << 20
_LLOYD_STEPS = 20
_MOST_INDICES = 1 << 16
_ENTRIES = 1 << 13
_SAMPLE = 1 << 16
_PALETTE_STEPS = 3
_BLOCK = 1 << 12


def write_sog(gaussians: Gaussians, path: Path, listener: Listener = silent) -> None:
    """Write a ``.sog`` archive of version 2; the order of the Gaussians is preserved.

    Spherical harmonics beyond degree 3, the format's limit, are dropped. More than 65,536 Gaussians share a palette
    of 8,192 entries, found by k-means; fewer have an entry each.

    Args:
        gaussians: The Gaussians.
        path: The file.
        listener: Receives events of stage "palette".

    Raises:
        ValueError: If a value is NaN or infinite, or there are no Gaussians.
    """
    g = gaussians.detach().to("cpu")
    if len(g) == 0:
        raise ValueError("SOG requires at least one Gaussian")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in g.tensors().values()):
        raise ValueError("the Gaussians contain NaN or infinity")
    pictures, means = _positions(g.means.double().numpy())
    scales, scale_table = _indexed(g.log_scales.numpy())
    colors, color_table = _indexed(g.sh0[:, 0].numpy())
    opacities = (g.opacities * 255).round().to(torch.uint8).numpy()
    pictures |= {
        "scales.webp": _opaque(scales),
        "quats.webp": _quats(torch.nn.functional.normalize(g.quats.double(), dim=1).numpy()),
        "sh0.webp": np.column_stack([colors, opacities]),
    }
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "lexsplat"}, "count": len(g)}
    if g.antialiased:
        meta["model"] = "antialiased"
    meta |= {
        "means": means,
        "scales": {"codebook": scale_table, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table, "files": ["sh0.webp"]},
    }
    width = math.ceil(math.sqrt(len(g)) / 4) * 4
    files = {name: _webp(pixels, width) for name, pixels in pictures.items()}
    if g.sh_degree:
        bands = min(g.sh_degree, 3)
        meta["shN"], palette, labels = _harmonics(g.shN[:, : COEFFICIENTS[bands]], bands, listener)
        files["shN_centroids.webp"] = _webp(palette, PALETTE_WIDTH * COEFFICIENTS[bands])
        files["shN_labels.webp"] = _webp(labels, width)
    with zipfile.ZipFile(path, "w") as archive:  # WebP does not shrink further
        for name, content in {META: json.dumps(meta).encode(), **files}.items():
            archive.writestr(zipfile.ZipInfo(name), content)


def _webp(pixels: NDArray[np.uint8], width: int) -> bytes:
    """Pixels ``[N, 4]`` in rows of ``width``, without loss; colors of transparent pixels are kept."""
    height = max(1, math.ceil(len(pixels) / width))
    picture = np.zeros((height * width, 4), np.uint8)
    picture[: len(pixels)] = pixels
    content = io.BytesIO()
    image = Image.fromarray(picture.reshape(height, width, 4))
    image.save(content, "WEBP", lossless=True, exact=True, quality=80, method=4)
    return content.getvalue()


def _opaque(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.column_stack([values, np.full(len(values), 255, np.uint8)])


def _positions(means: NDArray[np.float64]) -> tuple[dict[str, NDArray[np.uint8]], dict[str, Any]]:
    """Images of low and high bytes, and their entry of ``meta.json``."""
    values = np.sign(means) * np.log1p(np.abs(means))
    first, last = values.min(0), values.max(0)
    span = np.where(last > first, last - first, 1)
    steps = np.round((values - first) / span * 65535).astype(np.uint16)
    pictures = {
        "means_l.webp": _opaque((steps & 255).astype(np.uint8)),
        "means_u.webp": _opaque((steps >> 8).astype(np.uint8)),
    }
    return pictures, {"mins": first.tolist(), "maxs": last.tolist(), "files": list(pictures)}


def _quats(quats: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Smallest three components of unit quaternions wxyz; the one left out is positive."""
    small, largest = without_the_largest(quats)
    stored = np.round((small * math.sqrt(2) + 1) / 2 * 255).clip(0, 255)
    return np.column_stack([stored, FIRST_TAG + largest]).astype(np.uint8)


def _indexed(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], list[float]]:
    """Indices of values into a table of 256 numbers, and the table: k-means in one dimension.

    Half of the first centers are quantiles, half are evenly spaced, which keeps rare extremes.
    """
    flat = values.astype(np.float64).ravel()
    sample = np.sort(flat[:: max(1, len(flat) // _TABLE_SAMPLE)])
    sums = np.append(0, np.cumsum(sample))
    even = np.linspace(flat.min(), flat.max(), _TABLE // 2)
    centers = np.sort(np.append(np.quantile(sample, np.linspace(0, 1, _TABLE // 2)), even))
    for _ in range(_LLOYD_STEPS):
        ends = np.searchsorted(sample, (centers[1:] + centers[:-1]) / 2)
        # The nearest values of a center are a run of the sample.
        ends = np.concatenate([[0], ends, [len(sample)]])
        counts = np.diff(ends)
        centers = np.sort(np.where(counts, np.diff(sums[ends]) / np.maximum(counts, 1), centers))
    labels = np.searchsorted((centers[1:] + centers[:-1]) / 2, flat)
    return labels.astype(np.uint8).reshape(values.shape), centers.astype(np.float32).tolist()


def _harmonics(
    shN: Tensor, bands: int, listener: Listener
) -> tuple[dict[str, Any], NDArray[np.uint8], NDArray[np.uint8]]:
    """The entry of ``meta.json``, the palette's pixels, and each Gaussian's index in it as a pixel."""
    palette, labels = _clustered(shN.flatten(1), listener)
    entries = len(palette)
    colors, table = _indexed(palette.reshape(-1, 3).numpy())
    index = labels.numpy()
    pixels = np.column_stack([index & 255, index >> 8, np.zeros_like(index), np.full_like(index, 255)])
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {"count": entries, "bands": bands, "codebook": table, "files": files}
    return meta, _opaque(colors), pixels.astype(np.uint8)


def _clustered(rows: Tensor, listener: Listener) -> tuple[Tensor, Tensor]:
    """Centers of the rows ``[N, C]`` and the nearest one of each row, by seeded k-means; few rows are centers."""
    if len(rows) <= _MOST_INDICES:
        return rows, torch.arange(len(rows))
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))
    centers, sample = rows[order[:_ENTRIES]].clone(), rows[order[:_SAMPLE]]
    done, total = itertools.count(), _PALETTE_STEPS * len(sample.split(_BLOCK)) + len(rows.split(_BLOCK))

    def count() -> None:
        listener(Event("palette", next(done), total))

    count()
    for _ in range(_PALETTE_STEPS):
        labels = _nearest(sample, centers, count)
        counts = torch.bincount(labels, minlength=len(centers))[:, None]
        sums = torch.zeros_like(centers).index_add_(0, labels, sample)
        centers = torch.where(counts > 0, sums / counts.clamp_min(1), centers)
    return centers, _nearest(rows, centers, count)


def _nearest(rows: Tensor, centers: Tensor, count: Callable[[], None]) -> Tensor:
    """Index of the nearest center ``[N]``: the least |c|^2 - 2 r c. Blocks of rows are counted."""
    lengths, blocks = (centers**2).sum(1), []
    for block in rows.split(_BLOCK):
        blocks.append(torch.addmm(lengths, block, centers.T, alpha=-2).argmin(1))
        count()
    return torch.cat(blocks)
