"""Averaging: the features of all views on each Gaussian first, codes afterwards.

The paper quantizes the features of every view and then puts the codes on the Gaussians. What is small or seen by few
pixels, such as the handle of a mug, gets no code of its own there and is lost before the views have met. Here the
order is turned around. As in lifting, the weight alpha T with which Gaussian n enters a pixel is its share in that
pixel's feature, so its feature is the weighted mean over all pixels of all training views,

    F_n = sum alpha T F(p) / sum alpha T,

the transpose of rendering (as in LUDVIG and Occam's LGS). What is wrong in one view is averaged out by the others.
The codes are then found among the Gaussians (Eq. 2 to 4 without the DINO half), and each Gaussian is a softmax over
its nearest ones. The length of the mean of unit vectors tells how far the views agree, which gives u_G.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lexsplat.codebook import Codebook, CodebookConfig
from lexsplat.codebook.fitting import spherical_kmeans
from lexsplat.features import FeatureMap, FeatureMaps
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import check_views, codes_at_pixels
from lexsplat.language.fields import LiftedField
from lexsplat.rendering import BACK_PROJECTED_CHANNELS, back_project, prepare
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.progress import Event, Listener, silent

ROWS = 16_384
"""Gaussians handled at a time outside rendering."""


@dataclass(frozen=True)
class AveragedConfig:
    """Settings of the averaging.

    Args:
        top: Codes kept for each Gaussian.
        temperature: Of the softmax over the cosines with them; towards 0 only the nearest counts.
        min_visibility: A Gaussian with less weight than this over all training views, in cells of the feature maps,
            counts as never seen.
        prior_visibility: Weight in cells at which a Gaussian's mean is half believed; below it u tends to 1.
        shortest_side: Views are taken at the size of their feature maps, but not below this many pixels.
        memory_bytes: Bound for the sums; beyond it the views are passed over several times, for a range of the
            features' dimensions each, and the means lie in a file.
    """

    top: int = 4
    temperature: float = 1 / 80
    min_visibility: float = 0.01
    prior_visibility: float = 0.25
    shortest_side: int = 120
    memory_bytes: int = 1 << 30

    def __post_init__(self) -> None:
        if self.top < 1 or self.shortest_side < 1 or self.memory_bytes < 1:
            raise ValueError("top, shortest_side and memory_bytes must be positive")
        if not self.temperature > 0:
            raise ValueError(f"temperature must be positive, got {self.temperature:g}")
        if self.min_visibility < 0 or self.prior_visibility < 0:
            raise ValueError("min_visibility and prior_visibility must not be negative")


@dataclass(frozen=True)
class MeanFeatures:
    """The mean feature of each Gaussian over the training views.

    Args:
        means: ``[N, D]`` float16, at most of unit length; 0 where the Gaussian was not seen. In memory or in a file.
        totals: Weight of all pixels ``[N]``, in cells of the feature maps.
    """

    means: NDArray[np.float16]
    totals: Tensor

    def rows(self, index: slice | Tensor) -> Tensor:
        """Means of some Gaussians ``[n, D]`` float32, on the device of the totals."""
        chosen = index if isinstance(index, slice) else index.cpu().numpy()
        return torch.from_numpy(np.asarray(self.means[chosen], np.float32)).to(self.totals.device)

    def visible(self, config: AveragedConfig) -> Tensor:
        """Which Gaussians the training views have seen ``[N]`` bool."""
        return (self.totals >= config.min_visibility) & (self.totals > 0)


Valid = Callable[[str, tuple[int, int]], NDArray[np.bool_] | None]
"""Which pixels ``[H, W]`` of a view count, by its name and (width, height); None for all."""


def all_valid(name: str, size: tuple[int, int]) -> None:
    """Views without masks."""


def average_features(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    feature_maps: Mapping[str, FeatureMap],
    config: AveragedConfig,
    *,
    valid: Valid = all_valid,
    scratch: Path | None = None,
    listener: Listener = silent,
) -> MeanFeatures:
    """The weighted mean of the CLIP features in which each Gaussian has a share.

    Args:
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        feature_maps: Dense features by view name; cells whose feature is zero count for nothing.
        config: Settings.
        valid: Which pixels of a view ``[H, W]`` count, by its name and (width, height); None for all.
        scratch: Folder for the file that the means lie in where memory does not do; the system's if None.
        listener: Hears of stage "average".

    Raises:
        ValueError: If there is no view, a view has no features, or their dimensions differ.
    """
    names = sorted(cameras)
    check_views(names, feature_maps)
    gaussians, count = gaussians.detach(), len(gaussians)
    dimensions = feature_maps[names[0]].clip.shape[-1]
    ranges = list(_ranges(dimensions, count, config.memory_bytes))
    means = _store(count, dimensions, config.memory_bytes, scratch)
    totals = torch.zeros(count, device=gaussians.device)
    for part, columns in enumerate(ranges):
        sums = torch.zeros(count, len(columns), device=gaussians.device)
        for done, name in enumerate(names, start=1):
            features = feature_maps[name].clip
            if features.shape[-1] != dimensions:
                raise ValueError(
                    f"features of {name} have {features.shape[-1]} dimensions, those of {names[0]} {dimensions}"
                )
            camera = _at_map_size(cameras[name], features, gaussians.antialiased, config)
            counting = valid(name, (camera.width, camera.height))
            weights = totals if part == 0 else None
            _weighted_sum(gaussians, camera, features, counting, columns, sums, weights)
            listener(Event("average", part * len(names) + done, len(ranges) * len(names)))
        for start in range(0, count, ROWS):
            rows = slice(start, start + ROWS)
            mean = sums[rows] / totals[rows, None].clamp_min(1e-12)
            means[rows, columns.start : columns.stop] = mean.cpu().numpy().astype(np.float16)
    return MeanFeatures(means, totals)


def features_of_codes(code_maps: Mapping[str, NDArray[np.integer]], codebook: Codebook) -> FeatureMaps:
    """Feature maps that say what index maps say: the CLIP half of each cell's code, zero where there is none.

    Args:
        code_maps: Index maps ``[h, w]`` by view name; what is no code of the codebook is nothing.
        codebook: The discrete feature space S.
    """
    codewords = functional.pad(codebook.clip.cpu(), (0, 0, 0, 1))

    def load(name: str) -> FeatureMap:
        codes = torch.as_tensor(np.asarray(code_maps[name])).long()
        known = (codes >= 0) & (codes < codebook.num_codes)
        return FeatureMap(codewords[torch.where(known, codes, codebook.num_codes)])

    return FeatureMaps(list(code_maps), load, cache_bytes=0)


def field_from_means(
    found: MeanFeatures,
    codebook_config: CodebookConfig,
    config: AveragedConfig,
    *,
    seed: int = 0,
    memory: int = budget.DEFAULT_MEMORY,
) -> LiftedField:
    """Codes among the Gaussians, and the distribution of each over its nearest ones.

    Args:
        found: Means of all Gaussians.
        codebook_config: K, k-means iterations and sample size; what is about DINO or gradient steps has no part.
        config: Settings.
        seed: Of the sample and the start of k-means.
        memory: Bytes half of which the sample and k-means may take; the rest is for means and maps.

    Raises:
        MemoryBudgetError: If the sample does not fit.
    """
    device, (count, dimensions) = found.totals.device, found.means.shape
    looked_at = min(codebook_config.sample_size, count)
    what, number = f"a sample of {looked_at:,} Gaussians", codebook_config.num_codes
    budget.require_sample("language", what, looked_at, dimensions, number, 0, memory, share=0.5)
    visible = found.visible(config)
    with one_thread():  # the last bit of a similarity may decide between two codes
        codewords = _fit(found, visible, codebook_config, seed)
        kept = min(config.top, len(codewords))
        codes = torch.zeros(count, kept, dtype=torch.uint8, device=device)
        weights = torch.zeros(count, kept, device=device)
        agreement = torch.zeros(count, device=device)
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            means = found.rows(rows)
            cosines, nearest = (functional.normalize(means, dim=-1) @ codewords.T).topk(kept, dim=1)
            codes[rows] = nearest.to(torch.uint8)
            weights[rows] = torch.softmax(cosines / config.temperature, 1) * visible[rows, None]
            agreement[rows] = means.norm(dim=-1).clamp(0, 1)
    believed = found.totals / (found.totals + config.prior_visibility).clamp_min(1e-12)
    uncertainties = torch.where(visible, 1 - agreement * believed, torch.ones_like(believed))
    return LiftedField(Codebook(codewords), codes, weights, uncertainties, method="averaged")


def _fit(found: MeanFeatures, visible: Tensor, config: CodebookConfig, seed: int) -> Tensor:
    """Codes ``[K, D]`` of unit length by spherical k-means over the Gaussians that were seen; fewer if those are."""
    generator = torch.Generator().manual_seed(seed)
    seen = visible.nonzero()[:, 0].cpu()
    if len(seen) == 0:
        return torch.ones(1, found.means.shape[1], device=found.totals.device) / found.means.shape[1] ** 0.5
    if len(seen) > config.sample_size:
        seen = seen[torch.randperm(len(seen), generator=generator)[: config.sample_size].sort().values]
    sample = functional.normalize(found.rows(seen), dim=-1)
    number = min(config.num_codes, len(sample))
    iterations = config.kmeans_iterations
    return spherical_kmeans(sample, None, number, 0.0, iterations=iterations, generator=generator)[0]


def _weighted_sum(
    gaussians: Gaussians,
    camera: Camera,
    features: Tensor,
    counting: NDArray[np.bool_] | None,
    columns: range,
    sums: Tensor,
    weights: Tensor | None,
) -> None:
    """Add alpha T F(p) over the pixels of a view to ``sums [N, len(columns)]``, and alpha T to ``weights [N]``."""
    pixels = torch.arange(camera.height * camera.width)
    cells = torch.arange(features.shape[0] * features.shape[1]).view(features.shape[:2])
    at = codes_at_pixels(cells, camera.height, camera.width, pixels)
    flat = features.flatten(0, 1)
    # A pixel of the view is so much of a cell of the map: weights do not depend on the size that views are taken at.
    share = features.shape[0] * features.shape[1] / (camera.height * camera.width)
    counts = torch.full((len(pixels),), share)
    if counting is not None:
        counts *= torch.from_numpy(counting).flatten()
    prepared = prepare(gaussians, camera)
    size = camera.height, camera.width
    for start in range(columns.start, columns.stop, BACK_PROJECTED_CHANNELS):
        stop = min(start + BACK_PROJECTED_CHANNELS, columns.stop)
        values = (flat[at, start:stop].float() * counts[:, None]).unflatten(0, size).to(gaussians.device)
        sums[:, start - columns.start : stop - columns.start] += back_project(
            gaussians, camera, values, prepared
        )
    if weights is not None:
        values = (counts * flat.any(-1)[at]).view(*size, 1).to(gaussians.device)
        weights += back_project(gaussians, camera, values, prepared)[:, 0]


def _at_map_size(camera: Camera, features: Tensor, antialiased: bool, config: AveragedConfig) -> Camera:
    """The camera with about as many pixels as the map has cells: more would say nothing more.

    Gaussians without the mip filter look larger in smaller pictures than they are; they are taken at full size.
    """
    if not antialiased:
        return camera
    short = min(camera.width, camera.height)
    return camera.downscaled(max(1.0, min(camera.width / features.shape[1], short / config.shortest_side)))


def _ranges(dimensions: int, count: int, memory_bytes: int) -> Iterator[range]:
    """Dimensions in ranges so small that their sums, with one copy in work, keep to the bound."""
    width = max(1, min(dimensions, memory_bytes // (4 * max(count, 1)) - BACK_PROJECTED_CHANNELS))
    for start in range(0, dimensions, width):
        yield range(start, min(start + width, dimensions))


def _store(count: int, dimensions: int, memory_bytes: int, scratch: Path | None) -> NDArray[np.float16]:
    """Room for the means ``[count, dimensions]``: in memory, or in a file that is gone with the array."""
    if 2 * count * dimensions <= memory_bytes:
        return np.zeros((count, dimensions), np.float16)
    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=scratch) as file:
        file.truncate(2 * count * dimensions)
        return np.memmap(file, np.float16, "r+", shape=(count, dimensions))
