"""Method "averaged", the default: the features of all views on each Gaussian first, codes afterwards.

The paper quantizes the features of every view and then puts the codes on the Gaussians. Small parts such as a mug's
handle cover too few cells to receive one of the codewords and are lost before the views are combined. This method
reverses the order. The weight alpha T with which Gaussian n is blended into a pixel is its share of that pixel's
feature, so its own feature is the weighted mean over all pixels of all training views,

    F_n = sum alpha T F(p) / sum alpha T,

the transpose of rendering (as in LUDVIG and Occam's LGS). Averaging cancels what is wrong in single views. The
codebook is then fitted to the Gaussians (Eq. 2 to 4 without the DINO half), and each Gaussian carries a softmax over
its nearest codes. The length of the mean of unit vectors measures how far the views agree, which gives u_G: 0 for a
mean of length 1, and 1 for a mean no longer than that of all features of the scene.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from lexsplat.language.fields import CodeField
from lexsplat.language.methods.method import FitRun, TrainingViews, Variant
from lexsplat.language.segments import make_segments
from lexsplat.rendering import BACK_PROJECTED_CHANNELS, back_project, prepare
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.progress import Event, Listener, silent

ROWS = 16_384
"""Gaussians handled at a time outside rendering."""

MAX_STORE = 1 << 30
"""Bytes that the sums may take at most, however much memory there is."""


@dataclass(frozen=True)
class AveragedConfig:
    """Settings of method "averaged".

    Args:
        top: Codes kept for each Gaussian.
        temperature: Temperature of the softmax over their cosines, without the direction that all features share;
            towards 0 only the nearest code counts.
        min_visibility: Gaussians with less weight than this over all training views, in cells of the feature maps,
            count as never seen.
        prior_visibility: Weight in cells at which a Gaussian's mean is half trusted; below it u tends to 1.
        shortest_side: Views are rendered at the size of their feature maps, but not below this many pixels.
        segments: Whether to find segments (`lexsplat.language.segments`), by which questions are answered.
    """

    top: int = 4
    temperature: float = 1 / 40
    min_visibility: float = 0.01
    prior_visibility: float = 0.25
    shortest_side: int = 120
    segments: bool = True

    def __post_init__(self) -> None:
        if self.top < 1 or self.shortest_side < 1:
            raise ValueError("top and shortest_side must be positive")
        if not self.temperature > 0:
            raise ValueError(f"temperature must be positive, got {self.temperature:g}")
        if self.min_visibility < 0 or self.prior_visibility < 0:
            raise ValueError("min_visibility and prior_visibility must not be negative")


@dataclass(frozen=True)
class MeanFeatures:
    """The mean feature of each Gaussian over the training views.

    Args:
        means: ``[N, D]`` float16, length at most 1; 0 for Gaussians that were not seen. In memory or in a file.
        totals: Sum of the weights of all pixels ``[N]``, in cells of the feature maps.
    """

    means: NDArray[np.float16]
    totals: Tensor

    def rows(self, index: slice | Tensor) -> Tensor:
        """Means of some Gaussians ``[n, D]`` float32, on the device of `totals`."""
        chosen = index if isinstance(index, slice) else index.cpu().numpy()
        return torch.from_numpy(np.asarray(self.means[chosen], np.float32)).to(self.totals.device)

    def visible(self, config: AveragedConfig) -> Tensor:
        """Which Gaussians the training views show ``[N]`` bool."""
        return (self.totals >= config.min_visibility) & (self.totals > 0)


Valid = Callable[[str, tuple[int, int]], NDArray[np.bool_] | None]
"""Valid pixels ``[H, W]`` of a view by its name and (width, height); None if all are valid."""


def all_valid(name: str, size: tuple[int, int]) -> None:
    """The `Valid` of views without masks."""


class Averaged:
    """The method as an object (`lexsplat.language.methods.LanguageMethod`)."""

    name = "averaged"
    settings = ("codebook", "averaged")
    needs = ("features",)
    uses_dino = False
    trains_jointly = False
    variants: Mapping[str, Variant] = {"one code": {"averaged": {"top": 1}}, "full": {}}

    def fit(self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> CodeField:
        """The features of all views on each Gaussian, then codes for them."""

        def valid(name: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
            return views.views[name].load_valid(size)

        found = average_features(
            gaussians,
            views.cameras,
            views.require_features(),
            config.averaged,
            valid=valid,
            memory=run.memory,
            scratch=run.scratch,
            listener=run.listener,
        )
        field = field_from_means(found, config.codebook, config.averaged, seed=run.seed, memory=run.memory)
        if config.averaged.segments:
            field.segments = make_segments(gaussians, found.rows, found.totals)
        return field


# Beside its inputs: masks, and three options of the run that tests leave out.
def average_features(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    feature_maps: Mapping[str, FeatureMap],
    config: AveragedConfig,
    *,
    valid: Valid = all_valid,
    memory: int = budget.DEFAULT_MEMORY,
    scratch: Path | None = None,
    listener: Listener = silent,
) -> MeanFeatures:
    """The mean CLIP feature of each Gaussian, weighted by its share of the pixels.

    Args:
        gaussians: The geometry.
        cameras: Cameras of the training views by name.
        feature_maps: Dense features by view name; cells whose feature is zero are ignored.
        config: Settings.
        valid: Valid pixels of a view.
        memory: Host memory in bytes, a quarter of which the sums may take (at most `MAX_STORE`). If they need more,
            the views are traversed several times, for a range of feature dimensions each, and the means are kept in
            a file. The result does not depend on it.
        scratch: Folder for that file; None takes the system's.
        listener: Receives events of stage "average".

    Raises:
        ValueError: If there is no view, a view has no features, or their dimensions differ.
    """
    names = sorted(cameras)
    check_views(names, feature_maps)
    gaussians, count = gaussians.detach(), len(gaussians)
    dimensions = feature_maps[names[0]].clip.shape[-1]
    share = max(1, min(MAX_STORE, memory // 4))
    ranges = list(_ranges(dimensions, count, share))
    means = _store(count, dimensions, share, scratch)
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
    """Index maps as feature maps: the CLIP half of each cell's code.

    Args:
        code_maps: Index maps ``[h, w]`` by view name; an index outside the codebook gives a zero feature.
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
) -> CodeField:
    """Fit a codebook to the Gaussians and give each a distribution over its nearest codes.

    Args:
        found: Means of all Gaussians.
        codebook_config: K, k-means iterations and sample size; settings of DINO and of gradient steps are not used.
        config: Settings.
        seed: Seed of the sample and of the start of k-means.
        memory: Host memory in bytes, half of which the sample and k-means may take; the rest is for means and maps.

    Raises:
        MemoryBudgetError: If the sample does not fit.
    """
    device, (count, dimensions) = found.totals.device, found.means.shape
    looked_at = min(codebook_config.sample_size, count)
    what, number = f"a sample of {looked_at:,} Gaussians", codebook_config.num_codes
    budget.require_sample("language", what, looked_at, dimensions, number, 0, memory, share=0.5)
    visible = found.visible(config)
    with one_thread():  # the order of a sum decides its last bit, which can decide between two codes
        codewords, centers, common = _fit(found, visible, codebook_config, seed)
        shared = float(common.square().sum().clamp(max=1 - 1e-6))
        kept = min(config.top, len(codewords))
        codes = torch.zeros(count, kept, dtype=torch.uint8, device=device)
        weights = torch.zeros(count, kept, device=device)
        agreement = torch.zeros(count, device=device)
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            means = found.rows(rows)
            own = functional.normalize(functional.normalize(means, dim=-1) - common, dim=-1)
            cosines, nearest = (own @ centers.T).topk(kept, dim=1)
            codes[rows] = nearest.to(torch.uint8)
            weights[rows] = torch.softmax(cosines / config.temperature, 1) * visible[rows, None]
            agreement[rows] = ((means.square().sum(-1) - shared) / (1 - shared)).clamp(0, 1)
    trusted = found.totals / (found.totals + config.prior_visibility).clamp_min(1e-12)
    uncertainties = torch.where(visible, 1 - agreement * trusted, torch.ones_like(trusted))
    return CodeField(Codebook(codewords), codes, weights, uncertainties, method="averaged")


def _fit(
    found: MeanFeatures, visible: Tensor, config: CodebookConfig, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Spherical k-means over the visible Gaussians, without the direction that all features share.

    Features of an encoder lie in a cone. Cosines inside it depend on its width, those of what is left without its
    axis do not: the temperature of the softmax then holds for narrow and for wide cones.

    Returns:
        Unit codewords ``[K, D]``, at most one a Gaussian; their unit centers without the shared direction ``[K, D]``;
        that direction ``[D]``, the mean of the Gaussians' unit features.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = visible.nonzero()[:, 0].cpu()
    if len(seen) == 0:
        nothing = (
            torch.ones(1, found.means.shape[1], device=found.totals.device) / found.means.shape[1] ** 0.5
        )
        return nothing, nothing, torch.zeros_like(nothing[0])
    if len(seen) > config.sample_size:
        seen = seen[torch.randperm(len(seen), generator=generator)[: config.sample_size].sort().values]
    sample = functional.normalize(found.rows(seen), dim=-1)
    common = sample.mean(0)
    own = functional.normalize(sample - common, dim=-1)
    number = min(config.num_codes, len(sample))
    iterations = config.kmeans_iterations
    centers = spherical_kmeans(own, None, number, 0.0, iterations=iterations, generator=generator)[0]
    sums = torch.zeros_like(centers).index_add_(0, (own @ centers.T).argmax(1), sample)
    empty = ~sums.any(-1, keepdim=True)
    return functional.normalize(torch.where(empty, common + centers, sums), dim=-1), centers, common


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
    # Cells a pixel covers, so that weights do not depend on the size at which views are rendered.
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
    """The camera with about as many pixels as the map has cells; more pixels add no information.

    Without the mip filter Gaussians look too large at low resolution, so such scenes are rendered at full size.
    """
    if not antialiased:
        return camera
    short = min(camera.width, camera.height)
    return camera.downscaled(max(1.0, min(camera.width / features.shape[1], short / config.shortest_side)))


def _ranges(dimensions: int, count: int, memory_bytes: int) -> Iterator[range]:
    """Ranges of feature dimensions whose sums, with one working copy, fit into the bound."""
    width = max(1, min(dimensions, memory_bytes // (4 * max(count, 1)) - BACK_PROJECTED_CHANNELS))
    for start in range(0, dimensions, width):
        yield range(start, min(start + width, dimensions))


def _store(count: int, dimensions: int, memory_bytes: int, scratch: Path | None) -> NDArray[np.float16]:
    """Zeros for the means ``[count, dimensions]``: in memory, or in a file that is deleted with the array."""
    if 2 * count * dimensions <= memory_bytes:
        return np.zeros((count, dimensions), np.float16)
    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=scratch) as file:
        file.truncate(2 * count * dimensions)
        return np.memmap(file, np.float16, "r+", shape=(count, dimensions))
