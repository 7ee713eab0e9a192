"""The mean feature of each Gaussian over the training views, as sums over shards of views.

The sums of each shard are made apart, on workers where there are any, and added in order: the workers change no bit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features import FeatureMap, FeatureMaps
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import check_views
from lexsplat.language.methods.lifting import lifted
from lexsplat.rendering import BACK_PROJECTED_CHANNELS, prepare, weigh_cells
from lexsplat.rendering.back_projection import CellWeights, cell_of
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import threads_for_kernels
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.workers import IN_PROCESS, Needs, SharedFolder, Workers, results

if TYPE_CHECKING:
    from lexsplat.language.methods.averaged import AveragedConfig
    from lexsplat.rendering.cell_weights import SparseCellWeights

ROWS = 16_384
"""Gaussians handled at a time outside rendering."""

SHARD_VIEWS = 16
"""Views whose sums are made apart, at least."""

MOST_SHARDS = 64
"""Shards of a capture at most: each sends as many bytes as the sums have."""

MOST_REDUCED = 4.0
"""Largest factor by which views are reduced."""


@dataclass(frozen=True)
class MeanFeatures:
    """The mean feature of each Gaussian over the training views.

    Args:
        means: ``[N, L (Dc + Dd)]`` float16, each half of length at most 1; 0 for Gaussians that were not seen. In
            memory or in a file.
        totals: Sum of the weights of all pixels ``[N]``, in cells of the feature maps.
        dino: Size Dd of the DINO half; 0 without.
        levels: Number L of levels of 2D segments with means of their own, side by side in a row.
    """

    means: NDArray[np.float16]
    totals: Tensor
    dino: int = 0
    levels: int = 1

    def apart(self) -> MeanFeatures:
        """The same with a row for each level of each Gaussian, N L rows."""
        rows = self.means.reshape(len(self.means) * self.levels, -1)
        return MeanFeatures(rows, self.totals.repeat_interleave(self.levels), self.dino)

    def rows(self, index: slice | Tensor) -> Tensor:
        """CLIP means of some Gaussians ``[n, L Dc]`` float32, on the device of `totals`."""
        return self.halves(index)[0]

    def halves(self, index: slice | Tensor) -> list[Tensor]:
        """The same, followed by the DINO means ``[n, L Dd]`` if there are any."""
        means = torch.from_numpy(self.means)
        chosen = means[index] if isinstance(index, slice) else means.index_select(0, index.cpu())
        rows = chosen.float().to(self.totals.device)
        if not self.dino:
            return [rows]
        rows = rows.unflatten(1, (self.levels, -1))
        clip = rows.shape[2] - self.dino
        return [rows[..., :clip].flatten(1), rows[..., clip:].flatten(1)]

    def visible(self, config: AveragedConfig) -> Tensor:
        """Which Gaussians the training views show ``[N]`` bool."""
        return (self.totals >= config.min_visibility) & (self.totals > 0)


Valid = Callable[[str, tuple[int, int]], NDArray[np.bool_] | None]
"""Valid pixels ``[H, W]`` of a view by its name and (width, height); None if all are valid."""


def all_valid(name: str, size: tuple[int, int]) -> None:
    """The `Valid` of views without masks."""


# In addition to its inputs: masks, and three options of the run that tests leave out.
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
        memory: Host memory in bytes, which bounds the sums (`sums_bound`). If they need more, the views are traversed
            several times, for a range of feature dimensions each. Means that need more than the bound of the host are
            kept in a file; ``config.agreement`` keeps those of both passes. The result does not depend on it.
        scratch: Folder for that file; None takes the system's.
        workers: Workers that sum each shard of views. The result does not depend on them.
        listener: Receives events of stage "average".

    Raises:
        ValueError: If there is no view, a view has no features, or their dimensions differ.
    """
    check_views(sorted(cameras), feature_maps)
    device, gaussians = gaussians.device, gaussians.detach()
    if config.weighs_entries:  # single weights are known to the CPU rasterizer only
        gaussians = gaussians.to("cpu")
    run = _Run(dict(cameras), feature_maps, valid, memory, scratch, workers)
    passes = 2 if config.agreement else 1

    def told(before: int) -> Listener:
        def listen(event: Event) -> None:
            done, total = event.done + before * event.total, passes * event.total
            listener(replace(event, done=done, total=total))

        return listen

    found = _pass(gaussians, replace(config, agreement=0.0), None, run, told(0), last=passes == 1)
    if passes == 2:
        found = _pass(gaussians, config, found.means, run, told(1), last=True)
    return replace(found, totals=found.totals.to(device))


@dataclass(frozen=True)
class _Run:
    """What both passes over the views share: arguments of `average_features`."""

    cameras: Mapping[str, Camera]
    feature_maps: Mapping[str, FeatureMap]
    valid: Valid
    memory: int
    scratch: Path | None
    workers: Workers


def _pass(
    gaussians: Gaussians,
    config: AveragedConfig,
    means_before: NDArray[np.float16] | None,
    run: _Run,
    listener: Listener,
    *,
    last: bool,
) -> MeanFeatures:
    """One pass over all views; the last one forgets the features that it has read."""
    names, count, feature_maps = sorted(run.cameras), len(gaussians), run.feature_maps
    memory, scratch, workers = run.memory, run.scratch, run.workers
    first = feature_maps[names[0]]
    with_dino = first.dino.shape[-1] if config.dino and first.dino is not None else 0
    dimensions, levels, nbytes = _features(first, with_dino).shape[-1], len(first.levels) or 1, first.nbytes
    del first  # not held while the views are passed over
    device = gaussians.device if not workers.distributed else torch.device("cpu")
    ranges = list(_ranges(dimensions, count, sums_bound(device, memory)))
    means = _store(count, dimensions, sums_bound(torch.device("cpu"), memory), scratch)
    shards = view_shards(names)
    seen = _is_seen(workers, scratch)
    shared = _Averaging(
        gaussians, run.cameras, feature_maps if seen else {}, config, run.valid, with_dino, means_before
    )
    carried = 0 if seen else len(shards[0]) * nbytes
    needs = Needs(gpu=gaussians.device.type == "cuda", result=4 * count * (len(ranges[0]) + 3) + carried)
    totals = torch.zeros(count, device=gaussians.device)
    # What the sums are divided by, which is the total but for other weights than alpha T.
    norms, largest = (torch.zeros_like(totals) if config.weighs_entries else totals), torch.zeros_like(totals)
    least = 1e-12 if norms is totals else 1e-30
    done = 0
    listener(Event("average", done, len(ranges) * len(names)))
    for columns in ranges:
        sums = torch.zeros(count, len(columns), device=gaussians.device)
        items = _Shards(shards, columns, dimensions, None if seen else feature_maps)
        for part, weights, views in results(workers.map(_shard_sums, shared, items, needs)):
            sums += part.to(sums.device)
            if columns.start == 0:
                totals += weights[0].to(sums.device)
                if norms is not totals:
                    norms += weights[1]
                    torch.maximum(largest, weights[2], out=largest)
            done += views
            if last and columns is ranges[-1] and isinstance(feature_maps, FeatureMaps):
                feature_maps.forget()  # nothing reads them again, and all of them are hundreds of megabytes
            listener(Event("average", done, len(ranges) * len(names), workers.metrics))
        for start in range(0, count, ROWS):
            rows = slice(start, start + ROWS)
            mean = sums[rows] / norms[rows, None].clamp_min(least)
            means[rows, columns.start : columns.stop] = mean.cpu().numpy().astype(np.float16)
    if config.least_weight:
        totals *= largest >= config.least_weight
    return MeanFeatures(means, totals, with_dino, levels)


def _is_seen(workers: Workers, folder: Path | None) -> bool:
    """Whether the workers see the folder of the scene, where the features are."""
    if folder is None or not workers.distributed:
        return True
    with SharedFolder.offered(folder) as offered:
        return workers.see(offered)


def sums_bound(device: torch.device, memory: int) -> int:
    """Bytes that the sums may take: half of the free memory of their GPU; on a CPU `kept_bytes` of the host memory.

    Sums of workers travel through the host, so that its bound holds for them too.

    Args:
        device: Device of the sums.
        memory: Host memory in bytes.
    """
    if device.type == "cuda":
        return max(1, torch.cuda.mem_get_info(device)[0] // 2)
    return max(1, budget.kept_bytes(memory))


_Shard = tuple[tuple[str, ...], range, int, Mapping[str, FeatureMap] | None]
"""Views, the range of dimensions and their number, and the features if they travel with the task."""


@dataclass(frozen=True)
class _Shards(Mapping[str, _Shard]):
    """The tasks of one range of dimensions, by the first view of each; features are loaded when a task begins."""

    shards: Sequence[tuple[str, ...]]
    columns: range
    dimensions: int
    carried: Mapping[str, FeatureMap] | None

    def __getitem__(self, name: str) -> _Shard:
        shard = next(shard for shard in self.shards if shard[0] == name)
        maps = None if self.carried is None else {view: self.carried[view] for view in shard}
        return shard, self.columns, self.dimensions, maps

    def __iter__(self) -> Iterator[str]:
        return (shard[0] for shard in self.shards)

    def __len__(self) -> int:
        return len(self.shards)


@dataclass(frozen=True)
class _Averaging:
    """Inputs shared by the sums of all shards: arguments of `average_features`, and the means of the first pass."""

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    feature_maps: Mapping[str, FeatureMap]
    config: AveragedConfig
    valid: Valid
    with_dino: int
    means: NDArray[np.float16] | None


def view_shards(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The views in shards, whose sums are computed separately and then added in order.

    The shards depend on the views alone, not on the workers, and so do the bits of the sums.
    """
    size = max(SHARD_VIEWS, -(-len(names) // MOST_SHARDS))
    return [tuple(names[start : start + size]) for start in range(0, len(names), size)]


@threads_for_kernels()
def _shard_sums(shared: _Averaging, item: _Shard) -> tuple[Tensor, Tensor, int]:
    """The sums of some views over a range of dimensions ``[N, len(columns)]``, the weights ``[1, N]``, and the views.

    Weights other than alpha T have three rows: the sums of alpha T, those of the weights, and the largest alpha T.
    """
    names, columns, dimensions, carried = item
    maps = shared.feature_maps if carried is None else carried
    gaussians, config = shared.gaussians, shared.config
    sums = torch.zeros(len(gaussians), len(columns), device=gaussians.device)
    totals = torch.zeros(3 if config.weighs_entries else 1, len(gaussians), device=gaussians.device)
    for name in names:
        found = maps[name]
        features = _features(found, shared.with_dino)
        if features.shape[-1] != dimensions:
            raise ValueError(f"features of {name} have {features.shape[-1]} dimensions, others {dimensions}")
        camera = _at_map_size(shared.cameras[name], features, gaussians.antialiased, config)
        counting = shared.valid(name, (camera.width, camera.height))
        weights, features = _cell_weights(gaussians, camera, found.clip, counting), features.flatten(0, 1)
        if columns.start == 0:
            totals[0] += weights.totals()
        if config.weighs_entries:
            entries = cast("SparseCellWeights", weights)  # of Gaussians on the CPU
            weights, largest = lifted(entries, features, shared.means, config)
            torch.maximum(totals[2], largest, out=totals[2])
            totals[1] += weights.totals()
        weights.add_to(sums, features[:, columns.start : columns.stop])
    return sums, totals, len(names)


def _features(found: FeatureMap, with_dino: int) -> Tensor:
    """The features of a view to average ``[h, w, L (Dc + Dd)]``: CLIP and DINO features of each level."""
    levels = found.levels or (found,)
    halves = ((level.clip, level.dino) if with_dino else (level.clip,) for level in levels)
    parts = [half for pair in halves for half in pair if half is not None]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


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
    """Which rows ``[..., C]`` have a nonzero number, by their bits without the sign: NumPy is slow at halves."""
    bits = values.view(f"u{values.itemsize}")
    return np.asarray(np.bitwise_or.reduce(bits, axis=-1) << 1 != 0)


def _at_map_size(camera: Camera, features: Tensor, antialiased: bool, config: AveragedConfig) -> Camera:
    """The camera with about as many pixels as the map has cells, reduced by at most `MOST_REDUCED`.

    Maps would lose little by a stronger reduction, but small Gaussians are then never drawn and get no language.
    Without the mip filter Gaussians look too large at low resolution, so such scenes are rendered at full size.
    """
    if not antialiased:
        return camera
    short = min(camera.width, camera.height)
    wanted = min(camera.width / features.shape[1], short / config.shortest_side, MOST_REDUCED)
    return camera.downscaled(max(1.0, wanted))


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
