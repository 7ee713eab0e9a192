"""From crops of many sizes to a dense map of image-text features (section 3.2 of the paper).

CLIP yields one vector per image. Embedding crops of the image at many positions and sizes, and averaging the
embeddings of the crops around each position, yields a dense map. Crops are chosen in one of two ways:

- a regular grid for each size (as in LERF), whose embeddings are interpolated between the crops' centers;
- random crops for each size, averaged over the crops that cover a position, weighted by the distance to their center.

Embeddings are placed at the true centers of their crops in pixels. Crops lie inside the image; beyond the outermost
centers, the nearest crops are used.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features.pretrained import resize_images

Key = TypeVar("Key")


@dataclass(frozen=True)
class CropLevel:
    """Square crops of one size.

    Args:
        size: Side in pixels.
        lefts: Left edges in pixels: ``[nx]`` of the columns of a grid, or ``[n]`` of the random crops.
        tops: Top edges in pixels: ``[ny]`` of the rows of a grid, or ``[n]`` of the random crops.
        grid: Whether the crops are all pairs of rows and columns (row-major), or single ones.
        patches: Patches along a side of each crop, if each has its own embedding; 0 if the crop has one.
    """

    size: int
    lefts: NDArray[np.int32]
    tops: NDArray[np.int32]
    grid: bool
    patches: int = 0

    @property
    def boxes(self) -> NDArray[np.int32]:
        """Crops ``[n, 3]``: left, top, size."""
        lefts, tops = self.lefts, self.tops
        if self.grid:
            tops, lefts = (axis.ravel() for axis in np.meshgrid(tops, lefts, indexing="ij"))
        return np.stack([lefts, tops, np.full(len(lefts), self.size)], axis=1).astype(np.int32)

    def __len__(self) -> int:
        return len(self.lefts) * len(self.tops) if self.grid else len(self.lefts)

    @property
    def embeddings(self) -> int:
        """Total number of embeddings of the crops."""
        return len(self) * max(1, self.patches**2)


def grid_levels(
    width: int, height: int, sizes: Sequence[float], strides: Sequence[float]
) -> tuple[CropLevel, ...]:
    """A regular grid of crops for each size, from edge to edge.

    Args:
        width: Image width in pixels.
        height: Image height in pixels.
        sizes: Sides as fractions of the image's short side.
        strides: Largest distance between neighbors for each size, as a fraction of the crop's side.
    """
    levels = []
    for fraction, stride in zip(sizes, strides):
        size = _crop_side(fraction, width, height)
        axes = []
        for length in (width, height):
            count = -(-(length - size) // max(1.0, stride * size)) + 1
            axes.append(np.round(np.linspace(0, length - size, int(count))).astype(np.int32))
        levels.append(CropLevel(size, axes[0], axes[1], grid=True))
    return tuple(levels)


def random_levels(
    width: int, height: int, sizes: Sequence[float], crops: int, rng: np.random.Generator
) -> tuple[CropLevel, ...]:
    """Random crops, the same number for each size.

    Args:
        width: Image width in pixels.
        height: Image height in pixels.
        sizes: Sides as fractions of the image's short side.
        crops: Total number of crops, divided evenly; at least one per size.
        rng: Random generator of the positions.
    """
    found = []
    for index, fraction in enumerate(sizes):
        size = _crop_side(float(fraction), width, height)
        count = max(1, crops * (index + 1) // len(sizes) - crops * index // len(sizes))
        lefts = rng.integers(0, width - size + 1, count).astype(np.int32)
        tops = rng.integers(0, height - size + 1, count).astype(np.int32)
        found.append(CropLevel(size, lefts, tops, grid=False))
    return tuple(found)


def _crop_side(fraction: float, width: int, height: int) -> int:
    return min(max(1, round(fraction * min(width, height))), width, height)


def dense_map(
    levels: Sequence[CropLevel], embeddings: Tensor, width: int, height: int, cols: int, rows: int
) -> Tensor:
    """Average the crops' embeddings at their true positions: the dense map of section 3.2.

    Returns:
        `mean_map`, normalized: ``[rows, cols, D]``.
    """
    return F.normalize(mean_map(levels, embeddings, width, height, cols, rows), dim=-1)


def mean_map(
    levels: Sequence[CropLevel], embeddings: Tensor, width: int, height: int, cols: int, rows: int
) -> Tensor:
    """Average embedding of each cell: every level yields a map, and the levels that cover a cell have equal weight.

    Args:
        levels: Crops by size.
        embeddings: One unit vector per crop or patch ``[n, D]``, in order of the levels; patches row-major within
            their crop.
        width: Width in pixels of the image the crops were taken from.
        height: Its height.
        cols: Width of the map in cells.
        rows: Height of the map in cells.

    Returns:
        ``[rows, cols, D]``; cell (i, j) is the pixel ((j + .5) width / cols, (i + .5) height / rows).

    Raises:
        ValueError: If the number of embeddings is not that of the levels.
    """
    expected = sum(level.embeddings for level in levels)
    if len(embeddings) != expected:
        raise ValueError(f"{len(embeddings)} embeddings where the crops have {expected}")
    xs = (np.arange(cols) + 0.5) * width / cols
    ys = (np.arange(rows) + 0.5) * height / rows
    dim = embeddings.shape[-1]
    total = torch.zeros(rows, cols * dim)
    count = torch.zeros(rows, cols, 1)
    downs: list[Tensor] = []  # one matrix product sums the rows of all grid levels
    strips: list[Tensor] = []
    start = 0
    for level in levels:
        vectors = embeddings[start : start + level.embeddings].float()
        start += level.embeddings
        if level.grid:
            across, down = _axis_weights(level, level.lefts, xs), _axis_weights(level, level.tops, ys)
            side = max(1, level.patches)
            cells = vectors.reshape(len(level.tops), len(level.lefts), side, side, dim).transpose(1, 2)
            strips.append((across @ cells.reshape(down.shape[1], across.shape[1], dim)).flatten(1))
            downs.append(down)
            count += 1
        else:
            weights = _tent_weights(level, xs, ys)
            reached = weights.sum(-1, keepdim=True)
            total += ((weights @ vectors) / reached.clamp_min(1e-12)).reshape(rows, -1)
            count += (reached > 0).float().reshape(rows, cols, 1)
    if downs:
        total += torch.cat(downs, 1) @ torch.cat(strips)
    total = total.reshape(rows, cols, dim) / count.clamp_min(1)
    if bool((count == 0).any()):  # random crops need not cover every cell: the nearest crop fills it
        empty = (count == 0).squeeze(-1)
        total[empty] = embeddings[_nearest_crops(levels, xs, ys)[empty]].float()
    return total


def patch_map(
    levels: Sequence[CropLevel], patches: Tensor, width: int, height: int, cols: int, rows: int
) -> Tensor:
    """`mean_map` of the patches of grids of crops, each at its own position.

    Args:
        levels: Crops by size.
        patches: ``[n, P * P, D]``, crops in the order of the levels.
        width: Width in pixels of the image the crops were taken from.
        height: Its height.
        cols: Width of the map in cells.
        rows: Height of the map in cells.
    """
    side = math.isqrt(patches.shape[1])
    by_patch = [dataclasses.replace(level, patches=side) for level in levels]
    return mean_map(by_patch, patches.flatten(0, 1), width, height, cols, rows)


def _axis_weights(level: CropLevel, starts: NDArray, positions: NDArray) -> Tensor:
    """Weights ``[m, n]`` along one axis of the crops with these starts, or of their patches, crop after crop.

    The weight of a patch falls to zero at its own size, and is larger the farther the patch lies from the border of
    its crop, where it sees less context.
    """
    if not level.patches:
        return _linear_weights(positions, starts + level.size / 2)
    side = level.size / level.patches
    places = (np.arange(level.patches) + 0.5) * side
    centers = (starts[:, None] + places).ravel()
    # Beyond the outermost centers, the nearest ones are used.
    inside = np.clip(positions, centers.min(), centers.max())
    tents = np.maximum(0, 1 - np.abs(inside[:, None] - centers) / side)
    weights = tents * np.tile(np.minimum(places, level.size - places), len(starts))
    return torch.from_numpy((weights / weights.sum(1, keepdims=True)).astype(np.float32))


def _linear_weights(positions: NDArray, centers: NDArray) -> Tensor:
    """Weights ``[m, n]`` of linear interpolation between sorted centers, clamped at the ends."""
    weights = np.zeros((len(positions), len(centers)), dtype=np.float32)
    upper = np.clip(np.searchsorted(centers, positions), 1, max(1, len(centers) - 1))
    lower = upper - 1
    row = np.arange(len(positions))
    if len(centers) == 1:
        weights[:, 0] = 1
    else:
        part = np.clip((positions - centers[lower]) / (centers[upper] - centers[lower]), 0, 1)
        weights[row, lower] = 1 - part
        weights[row, upper] = part
    return torch.from_numpy(weights)


def _tent_weights(level: CropLevel, xs: NDArray, ys: NDArray) -> Tensor:
    """Weights ``[rows * cols, n]``: 1 at a crop's center, falling to 0 at its edges."""
    half = level.size / 2
    across = np.maximum(0, 1 - np.abs(xs[:, None] - (level.lefts + half)) / half)
    down = np.maximum(0, 1 - np.abs(ys[:, None] - (level.tops + half)) / half)
    weights = (down[:, None] * across[None]).reshape(len(ys) * len(xs), -1)
    return torch.from_numpy(weights.astype(np.float32))


def _nearest_crops(levels: Sequence[CropLevel], xs: NDArray, ys: NDArray) -> Tensor:
    """Index of the crop with the nearest center for every cell ``[rows, cols]``."""
    boxes = np.concatenate([level.boxes for level in levels])
    centers = torch.from_numpy((boxes[:, :2] + boxes[:, 2:] / 2).astype(np.float32))
    grid = torch.stack(torch.meshgrid(torch.from_numpy(ys), torch.from_numpy(xs), indexing="ij"), -1).flip(-1)
    return torch.cdist(grid.reshape(-1, 2).float(), centers).argmin(1).reshape(len(ys), len(xs))


def unique_boxes(levels: Sequence[CropLevel]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The distinct crops of all levels ``[m, 3]``, and for each crop its index among them ``[n]``."""
    boxes = np.concatenate([level.boxes for level in levels])
    unique, places = np.unique(boxes, axis=0, return_inverse=True)
    return unique, places.reshape(-1)


def cut_crops(image: Tensor, boxes: NDArray[np.int32], image_size: int, chunk: int) -> Iterator[Tensor]:
    """Crops of an image, resized for an encoder.

    Args:
        image: ``[3, h, w]`` in 0..1.
        boxes: Crops ``[n, 3]``: left, top, size in pixels, within the image.
        image_size: Side in pixels of the resized crops.
        chunk: Most crops at once.

    Yields:
        Crops ``[b, 3, image_size, image_size]``, in the order of the boxes, b at most ``chunk``.
    """
    start = 0
    while start < len(boxes):
        size = int(boxes[start, 2])
        stop = start
        while stop < min(len(boxes), start + chunk) and boxes[stop, 2] == size:
            stop += 1
        crops = [
            image[:, top : top + size, left : left + size] for left, top, _ in boxes[start:stop].tolist()
        ]
        yield resize_images(torch.stack(crops), image_size, image_size)
        start = stop


def encode_stream(
    encode: Callable[[Tensor], Tensor], jobs: Iterable[tuple[Key, Iterable[Tensor]]], batch_size: int
) -> Iterator[tuple[Key, Tensor]]:
    """Encode the crops of many images in full batches that run across sizes and images.

    Args:
        encode: Embeds crops: ``[b, 3, s, s]`` to ``[b, ...]``.
        jobs: For each image a key and its crops in chunks ``[b, 3, s, s]``; consumed lazily.
        batch_size: Crops encoded at once.

    Yields:
        Each key with its embeddings ``[n, ...]``, in the order of the jobs.
    """
    waiting: deque[tuple[Key, int]] = deque()  # images that are cut, and their numbers of crops
    buffer: list[Tensor] = []  # crops that are not encoded yet
    ready: list[Tensor] = []  # embeddings in the order of the crops, without those that were yielded

    def finished() -> Iterator[tuple[Key, Tensor]]:
        while waiting and sum(map(len, ready)) >= waiting[0][1]:
            key, count = waiting.popleft()
            yield key, _taken(ready, count)  # no name here: it is freed as soon as the caller is done with it

    for key, chunks in jobs:
        count = 0
        for chunk in chunks:
            buffer.append(chunk)
            count += len(chunk)
            while sum(map(len, buffer)) >= batch_size:
                crops = torch.cat(buffer)
                ready.append(encode(crops[:batch_size]))
                buffer[:] = [crops[batch_size:]]
        waiting.append((key, count))
        yield from finished()
    if sum(map(len, buffer)):
        ready.append(encode(torch.cat(buffer)))
    yield from finished()


def _taken(ready: list[Tensor], count: int) -> Tensor:
    """The first ``count`` rows of some tensors, which lose them."""
    taken = []
    while count:
        first = ready.pop(0)
        taken.append(first[:count])
        if len(first) > count:
            ready.insert(0, first[count:].clone())
        count -= len(taken[-1])
    return torch.cat(taken) if taken else ready[0][:0]


def batch_size_for(memory: int, image_size: int) -> int:
    """Number of crops to encode at once within ``memory`` bytes.

    A transformer layer holds about 24 float32 tensors of the input's size (in ViT-B/16, a token has as many numbers
    as a patch has values); it gets a quarter of the memory.
    """
    return int(min(256, max(1, memory // 4 // (24 * 12 * image_size**2))))
