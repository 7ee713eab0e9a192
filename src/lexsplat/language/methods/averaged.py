"""Method "averaged", the default: the features of all views on each Gaussian first, codes afterwards.

The paper quantizes the features of every view and then puts the codes on the Gaussians. Small parts such as a mug's
handle cover too few cells to receive one of the codewords and are lost before the views are combined. This method
reverses the order. The weight alpha T with which Gaussian n is blended into a pixel is its share of that pixel's
feature, so its own feature is the weighted mean over all pixels of all training views,

    F_n = sum alpha T F(p) / sum alpha T,

the transpose of rendering (as in LUDVIG and Occam's LGS). Averaging cancels what is wrong in single views. The
codebook is then fitted to the Gaussians (Eq. 2 to 4; without the DINO half unless asked for), and each Gaussian
carries a softmax over its nearest codes. The length of the mean of unit vectors measures how far the views agree,
which gives u_G: 0 for a mean of length 1, and 1 for a mean no longer than that of all features of the scene.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from lexsplat.language.code_maps import check_views
from lexsplat.language.fields import CodeField
from lexsplat.language.methods.method import FitRun, TrainingViews, Variant
from lexsplat.language.segments import make_segments
from lexsplat.rendering import BACK_PROJECTED_CHANNELS, prepare, weigh_cells
from lexsplat.rendering.back_projection import CellWeights, cell_of
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import one_thread, threads_for_kernels
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.workers import IN_PROCESS, Needs, Workers, results

ROWS = 16_384
"""Gaussians handled at a time outside rendering."""

SHARD_VIEWS = 16
"""Views whose sums are made apart, at least."""

MOST_SHARDS = 64
"""Shards of a capture at most: each sends as many bytes as the sums have."""

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
        dino: Average DINO features, too, and compare Gaussians with codes by both halves (Eq. 4).
        segments: Whether to find segments (`lexsplat.language.segments`), by which questions are answered.
    """

    top: int = 4
    temperature: float = 1 / 40
    min_visibility: float = 0.01
    prior_visibility: float = 0.25
    shortest_side: int = 120
    dino: bool = False
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
        means: ``[N, Dc + Dd]`` float16, each half of length at most 1; 0 for Gaussians that were not seen. In memory
            or in a file.
        totals: Sum of the weights of all pixels ``[N]``, in cells of the feature maps.
        dino: Size Dd of the DINO half; 0 without.
    """

    means: NDArray[np.float16]
    totals: Tensor
    dino: int = 0

    def rows(self, index: slice | Tensor) -> Tensor:
        """CLIP means of some Gaussians ``[n, Dc]`` float32, on the device of `totals`."""
        return self.halves(index)[0]

    def halves(self, index: slice | Tensor) -> list[Tensor]:
        """The same, followed by the DINO means ``[n, Dd]`` if there are any."""
        chosen = index if isinstance(index, slice) else index.cpu().numpy()
        rows = torch.from_numpy(np.asarray(self.means[chosen], np.float32)).to(self.totals.device)
        clip = rows.shape[1] - self.dino
        return [rows[:, :clip], rows[:, clip:]] if self.dino else [rows]

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
    trains_jointly = False
    variants: Mapping[str, Variant] = {
        "one code": {"averaged": {"top": 1}},
        "with DINO": {"averaged": {"dino": True}},
        "full": {},
    }

    def uses_dino(self, config: Any) -> bool:
        """If asked for."""
        return bool(config.averaged.dino)

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
            workers=run.workers,
            listener=run.listener,
        )
        field = field_from_means(
            found, config.codebook, config.averaged, seed=run.seed, memory=run.memory, listener=run.listener
        )
        if config.averaged.segments:
            run.listener(Event("segments", 0, 1))
            shown = found.totals * found.visible(config.averaged)  # selections leave out what has no mass
            with one_thread():
                field.segments = make_segments(gaussians, found.rows, shown)
            run.listener(Event("segments", 1, 1))
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
    workers: Workers = IN_PROCESS,
    listener: Listener = silent,
) -> MeanFeatures:
    """The mean feature of each Gaussian, weighted by its share of the pixels: of CLIP, and of DINO if asked for.

    Args:
        gaussians: The geometry.
        cameras: Cameras of the training views by name.
        feature_maps: Dense features by view name; cells whose CLIP feature is zero are ignored.
        config: Settings.
        valid: Valid pixels of a view.
        memory: Host memory in bytes, a quarter of which the sums may take (at most `MAX_STORE`). If they need more,
            the views are traversed several times, for a range of feature dimensions each, and the means are kept in
            a file. The result does not depend on it.
        scratch: Folder for that file; None takes the system's.
        workers: Where the sums of each shard of views are made. The result does not depend on it.
        listener: Receives events of stage "average".

    Raises:
        ValueError: If there is no view, a view has no features, or their dimensions differ.
    """
    names = sorted(cameras)
    check_views(names, feature_maps)
    gaussians, count = gaussians.detach(), len(gaussians)
    dino = feature_maps[names[0]].dino if config.dino else None
    with_dino = 0 if dino is None else dino.shape[-1]
    dimensions = feature_maps[names[0]].clip.shape[-1] + with_dino
    share = max(1, min(MAX_STORE, memory // 4))
    ranges = list(_ranges(dimensions, count, share))
    means = _store(count, dimensions, share, scratch)
    shards = view_shards(names)
    shared = _Averaging(gaussians, dict(cameras), feature_maps, config, valid, with_dino)
    needs = Needs(gpu=gaussians.device.type == "cuda", result=4 * count * (len(ranges[0]) + 1))
    totals = torch.zeros(count, device=gaussians.device)
    done = 0
    for columns in ranges:
        sums = torch.zeros(count, len(columns), device=gaussians.device)
        items = {shard[0]: (shard, columns, dimensions) for shard in shards}
        for part, weights, views in results(workers.map(_shard_sums, shared, items, needs)):
            sums += part.to(sums.device)
            if columns.start == 0:
                totals += weights.to(sums.device)
            done += views
            listener(Event("average", done, len(ranges) * len(names), workers.metrics))
        for start in range(0, count, ROWS):
            rows = slice(start, start + ROWS)
            mean = sums[rows] / totals[rows, None].clamp_min(1e-12)
            means[rows, columns.start : columns.stop] = mean.cpu().numpy().astype(np.float16)
    return MeanFeatures(means, totals, with_dino)


@dataclass(frozen=True)
class _Averaging:
    """What the sums of every shard are made from: arguments of `average_features`."""

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    feature_maps: Mapping[str, FeatureMap]
    config: AveragedConfig
    valid: Valid
    with_dino: int


def view_shards(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The views in shards whose sums are made apart and then added in order.

    The shards depend on the views alone, not on the workers, and so do the bits of the sums.
    """
    size = max(SHARD_VIEWS, -(-len(names) // MOST_SHARDS))
    return [tuple(names[start : start + size]) for start in range(0, len(names), size)]


@threads_for_kernels()
def _shard_sums(shared: _Averaging, item: tuple[tuple[str, ...], range, int]) -> tuple[Tensor, Tensor, int]:
    """The sums of some views over a range of dimensions ``[N, len(columns)]``, of weights ``[N]``, and the views."""
    names, columns, dimensions = item
    gaussians = shared.gaussians
    sums = torch.zeros(len(gaussians), len(columns), device=gaussians.device)
    totals = torch.zeros(len(gaussians), device=gaussians.device)
    for name in names:
        found = shared.feature_maps[name]
        features = found.clip
        if shared.with_dino and found.dino is not None:
            features = torch.cat([features, found.dino], dim=-1)
        if features.shape[-1] != dimensions:
            raise ValueError(f"features of {name} have {features.shape[-1]} dimensions, others {dimensions}")
        camera = _at_map_size(shared.cameras[name], features, gaussians.antialiased, shared.config)
        counting = shared.valid(name, (camera.width, camera.height))
        weights = _cell_weights(gaussians, camera, found.clip, counting)
        weights.add_to(sums, features.flatten(0, 1)[:, columns.start : columns.stop])
        if columns.start == 0:
            totals += weights.totals()
    return sums, totals, len(names)


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
    listener: Listener = silent,
) -> CodeField:
    """Fit a codebook to the Gaussians and give each a distribution over its nearest codes.

    Args:
        found: Means of all Gaussians.
        codebook_config: K, k-means iterations, sample size, and the weight of the DINO half if there is one; the
            settings of gradient steps are not used.
        config: Settings.
        seed: Seed of the sample and of the start of k-means.
        memory: Host memory in bytes, half of which the sample and k-means may take; the rest is for means and maps.
        listener: Receives events of stage "clusters".

    Raises:
        MemoryBudgetError: If the sample does not fit.
    """
    device, (count, dimensions) = found.totals.device, found.means.shape
    looked_at = min(codebook_config.sample_size, count)
    what, number = f"a sample of {looked_at:,} Gaussians", codebook_config.num_codes
    budget.require_sample("language", what, looked_at, dimensions, number, 0, memory, share=0.5)
    visible, lambda_dino = found.visible(config), codebook_config.lambda_dino
    with one_thread():  # the order of a sum decides its last bit, which can decide between two codes
        codewords, centers, common = _fit(found, visible, codebook_config, seed, listener)
        shared = float(common[0].square().sum().clamp(max=1 - 1e-6))
        kept = min(config.top, len(codewords))
        codes = torch.zeros(count, kept, dtype=torch.uint8, device=device)
        weights = torch.zeros(count, kept, device=device)
        agreement = torch.zeros(count, device=device)
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            halves = found.halves(rows)
            cosines, nearest = (_joined(_own(halves, common), lambda_dino) @ centers.T).topk(kept, dim=1)
            codes[rows] = nearest.to(torch.uint8)
            weights[rows] = torch.softmax(cosines / config.temperature, 1) * visible[rows, None]
            agreement[rows] = ((halves[0].square().sum(-1) - shared) / (1 - shared)).clamp(0, 1)
    trusted = found.totals / (found.totals + config.prior_visibility).clamp_min(1e-12)
    uncertainties = torch.where(visible, 1 - agreement * trusted, torch.ones_like(trusted))
    return CodeField(Codebook(codewords), codes, weights, uncertainties, method="averaged")


def _fit(
    found: MeanFeatures, visible: Tensor, config: CodebookConfig, seed: int, listener: Listener
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Spherical k-means over the visible Gaussians, without the direction that all features share.

    Features of an encoder lie in a cone. Cosines inside it depend on its width, those of what is left without its
    axis do not: the temperature of the softmax then holds for narrow and for wide cones.

    Returns:
        Unit CLIP codewords ``[K, Dc]``, at most one a Gaussian; their centers without the shared directions
        ``[K, Dc + Dd]``, each half of unit length; those directions, the means of the Gaussians' unit features, one
        for each half.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = visible.nonzero()[:, 0].cpu()
    if len(seen) == 0:
        halves = [torch.ones_like(half) / half.shape[1] ** 0.5 for half in found.halves(slice(0, 1))]
        return halves[0], torch.cat(halves, 1), [torch.zeros_like(half[0]) for half in halves]
    if len(seen) > config.sample_size:
        seen = seen[torch.randperm(len(seen), generator=generator)[: config.sample_size].sort().values]
    sample = [functional.normalize(half, dim=-1) for half in found.halves(seen)]
    common = [half.mean(0) for half in sample]
    own = _own(sample, common)
    number = min(config.num_codes, len(seen))
    clip, dino = spherical_kmeans(
        own[0],
        own[1] if found.dino else None,
        number,
        config.lambda_dino,
        iterations=config.kmeans_iterations,
        generator=generator,
        listener=listener,
    )
    centers = clip if dino is None else torch.cat([clip, dino], 1)
    nearest = (_joined(own, config.lambda_dino) @ centers.T).argmax(1)
    sums = torch.zeros_like(clip).index_add_(0, nearest, sample[0])
    empty = ~sums.any(-1, keepdim=True)
    return functional.normalize(torch.where(empty, common[0] + clip, sums), dim=-1), centers, common


def _own(halves: Sequence[Tensor], common: Sequence[Tensor]) -> list[Tensor]:
    """Unit features without the direction that all share, of CLIP and of DINO."""
    units = (functional.normalize(half, dim=-1) for half in halves)
    return [functional.normalize(unit - shared, dim=-1) for unit, shared in zip(units, common)]


def _joined(halves: Sequence[Tensor], lambda_dino: float) -> Tensor:
    """Both halves in a row, so that the product with a code is the similarity of Eq. 4."""
    return halves[0] if len(halves) == 1 else torch.cat([halves[0], lambda_dino * halves[1]], dim=-1)


def _cell_weights(
    gaussians: Gaussians, camera: Camera, features: Tensor, counting: NDArray[np.bool_] | None
) -> CellWeights:
    """Weights alpha T of the cells that have a feature, over the pixels that count."""
    cells = (features.shape[0], features.shape[1])
    # Cells a pixel covers, so that weights do not depend on the size at which views are rendered.
    share = cells[0] * cells[1] / (camera.height * camera.width)
    rows = cell_of(np.arange(camera.height), camera.height, cells[0])
    columns = cell_of(np.arange(camera.width), camera.width, cells[1])
    known = _any_nonzero(features.numpy())
    counts = known[rows[:, None], columns].astype(np.float32) * np.float32(share)
    if counting is not None:
        counts *= counting
    return weigh_cells(gaussians, camera, cells, torch.from_numpy(counts), prepare(gaussians, camera))


def _any_nonzero(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which rows ``[..., C]`` have a number but 0, by their bits without the sign: NumPy is slow at halves."""
    bits = values.view(f"u{values.itemsize}")
    return np.asarray(np.bitwise_or.reduce(bits, axis=-1) << 1 != 0)


def _at_map_size(camera: Camera, features: Tensor, antialiased: bool, config: AveragedConfig) -> Camera:
    """The camera with about as many pixels as the map has cells; more pixels add no information.

    Without the mip filter Gaussians look too large at low resolution, so such scenes are rendered at full size.
    """
    if not antialiased:
        return camera
    short = min(camera.width, camera.height)
    return camera.downscaled(max(1.0, min(camera.width / features.shape[1], short / config.shortest_side)))


def _ranges(dimensions: int, count: int, memory_bytes: int) -> Iterator[range]:
    """Ranges of feature dimensions whose sums, and those of a shard, fit into the bound; whole blocks of channels."""
    width = max(1, min(dimensions, memory_bytes // (8 * max(count, 1))))
    if width < dimensions and width > BACK_PROJECTED_CHANNELS:
        width -= width % BACK_PROJECTED_CHANNELS
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
