"""Division of a capture into blocks: its Gaussians into cells of the ground plane, its views into groups.

The ground plane is cut into cells with equal numbers of points, and the views, by where they stand, into as many
groups of equal size. A block is a group of views and the few cells that fill most of their pixels. The Gaussians of
these cells are trained with the views; those of other cells that the views show take part with fixed values. Each
view belongs to one block and is used as a whole, so that all blocks together draw the pixels of one piece.

Around a table every group shows the same cells, and what differs is the side that it shows. The views of such groups
are dealt to their blocks in turn, and each trains all cells, where the memory allows it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist

from lexsplat.geometry.boxes import Up
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View

CELLS_TRAINED = 4
"""Cells that a block trains at most, if every other cell is trained by another block."""

CELLS_OF_PAIR = 6
"""Cells that two blocks train at most when they are visited together."""

_COVERED = 0.95
"""Share of the pixels of a block's views that the cells which it trains show, as far as `CELLS_TRAINED` allows."""
_ALIKE = 0.7
"""Least overlap of the shares of the cells in the pixels of two groups of views that show the same: of nine groups on
a street it is at most 0.85 between neighbors and 0.65 between the next but one, around a table at least 0.86."""
_FEWEST_ALIKE = 3
"""Least number of groups that show the same and are dealt; two are visited together as they are."""
_SHARE_ALIKE = 1 / 3
"""Their least share of all groups: thin blocks of a street show the same as their neighbors, but not all do."""
_POINTS_LOOKED_AT = 100_000
"""Points that are projected into all views, drawn from those of a larger capture."""
_FEWEST_VIEWS = 3
_MOST_BLOCKS = 1024


@dataclass(frozen=True)
class Cell:
    """A part of the ground plane.

    Args:
        low: Lower ends ``[2]``; -inf at the border of the capture.
        high: Upper ends ``[2]``; inf at the border.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def holds(self, ground: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which places ``[N, 2]`` on the ground plane lie in the cell ``[N]``."""
        return np.all((ground >= self.low) & (ground < self.high), axis=1)


@dataclass(frozen=True)
class Block:
    """Views that are trained on together, and the cells whose Gaussians they train.

    Args:
        number: Index of the block.
        views: Names of its training views.
        trained: Indices of the cells that it trains, in ascending order.
        owned: Those of them in which it adds and removes Gaussians; each cell is owned by one block.
        shown: Cells that it does not train and that its views show.
        dealt: Whether its views are every n-th of those of n blocks that show the same.
    """

    number: int
    views: tuple[str, ...]
    trained: tuple[int, ...]
    owned: tuple[int, ...]
    shown: tuple[int, ...]
    dealt: bool = False


@dataclass(frozen=True)
class Blocks:
    """A capture cut into blocks.

    Args:
        cells: The cells, which cover the ground plane once.
        blocks: As many blocks.
        axes: Two unit vectors ``[2, 3]`` that span the ground plane.
    """

    cells: tuple[Cell, ...]
    blocks: tuple[Block, ...]
    axes: NDArray[np.float64]

    def cells_of(self, means: NDArray[np.floating]) -> NDArray[np.int64]:
        """The cell ``[N]`` of each center ``[N, 3]``."""
        return _cells_of(means, self.cells, self.axes)

    def shares(self, view: View, points: NDArray[np.float32]) -> NDArray[np.float64]:
        """Share of each cell ``[B]`` in a view: of the points that it shows, each by its area in the image."""
        return _shares(view, points, self.cells_of(points), len(self.cells))

    def joined(self, numbers: Sequence[int]) -> Block:
        """Blocks as one, under the number of the first."""
        chosen = [self.blocks[number] for number in numbers]
        trained = {cell for block in chosen for cell in block.trained}
        owned = {cell for block in chosen for cell in block.owned}
        shown = {cell for block in chosen for cell in block.shown} - trained
        return Block(
            numbers[0],
            tuple(name for block in chosen for name in block.views),
            tuple(sorted(trained)),
            tuple(sorted(owned)),
            tuple(sorted(shown)),
            all(block.dealt for block in chosen),
        )

    def pairs(self, turn: int) -> list[tuple[int, ...]]:
        """The blocks in pairs that together train at most `CELLS_OF_PAIR` cells, and others alone.

        Which ones are paired is drawn anew with each ``turn``, so that views are mixed with those of all neighbors.
        Blocks with dealt views have mixed ones already.
        """
        left = set(range(len(self.blocks)))
        found: list[tuple[int, ...]] = []
        for index in np.random.default_rng(turn).permutation(len(self._neighbors)):
            pair = self._neighbors[index]
            if left.issuperset(pair):
                left.difference_update(pair)
                found.append(pair)
        return sorted([*found, *((number,) for number in left)])

    @cached_property
    def _neighbors(self) -> list[tuple[int, int]]:
        """The blocks that may be visited together."""
        cells = [set(block.trained) for block in self.blocks]
        return [
            (first, second)
            for second in range(len(cells))
            for first in range(second)
            if cells[first] & cells[second]
            and len(cells[first] | cells[second]) <= CELLS_OF_PAIR
            and not (self.blocks[first].dealt or self.blocks[second].dealt)
        ]


def side_by_side(blocks: Sequence[Block]) -> list[list[int]]:
    """Indices of blocks in groups that train no cell in common, so that a group can be trained side by side."""
    groups: list[list[int]] = []
    for index, block in enumerate(blocks):
        cells = set(block.trained)
        free = (g for g in groups if not any(cells & set(blocks[other].trained) for other in g))
        group = next(free, None)
        if group is None:
            groups.append([index])
        else:
            group.append(index)
    return groups


def number_of_blocks(blocks: str, config: ReconstructionConfig, device: str, memory: int) -> int:
    """The number that ``--blocks`` means; 1 is a reconstruction in one piece.

    Args:
        blocks: "none", a number, or "auto": as few as fit into the memory.
        config: Settings, for their limit of Gaussians.
        device: "cpu" or "cuda".
        memory: Host memory of one reconstruction in bytes.

    Raises:
        ValueError: If it is none of these.
    """
    if blocks == "auto":
        need = 2 * config.cap(torch.device(device)) * budget.GAUSSIAN_BYTES
        return 1 if device != "cpu" or need <= memory else math.ceil(CELLS_OF_PAIR * need / memory)
    if blocks == "none":
        return 1
    if not blocks.isdecimal() or not 1 <= int(blocks) <= _MOST_BLOCKS:
        raise ValueError(f"blocks must be auto, none or a number from 1 to {_MOST_BLOCKS}, got {blocks!r}")
    return int(blocks)


def ground_axes(up: Up) -> NDArray[np.float64]:
    """Two unit vectors ``[2, 3]`` that span the ground plane.

    Raises:
        CaptureError: If the up direction cannot be estimated from the cameras.
    """
    if not up.reliable:
        raise CaptureError(
            "--blocks",
            expected="a ground plane, to cut the capture on",
            found="no reliable up direction in the cameras",
            remedy="give --up X,Y,Z or --blocks none",
        )
    first = np.cross(up.direction, np.eye(3)[np.abs(up.direction).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up.direction, first)])


def cut_blocks(
    capture: Capture, points: NDArray[np.float32], axes: NDArray[np.float64], count: int, *, deal: bool
) -> Blocks:
    """Cut a capture into blocks.

    Args:
        capture: Its training views.
        points: Initial points ``[P, 3]``.
        axes: From `ground_axes`.
        count: Number of blocks.
        deal: Whether all Gaussians fit into the memory, so that blocks that show the same may train all cells.

    Raises:
        CaptureError: If a cell has no points, if too few views show it, or if there are too few views.
    """
    views = capture.train_views
    if len(views) < 2 * count:
        raise CaptureError(
            f"{count} blocks",
            expected=f"at least {2 * count} training views",
            found=str(len(views)),
            remedy=f"give at most --blocks {len(views) // 2}; --blocks auto takes fewer with more --memory",
        )
    cells = tuple(Cell(*ends) for ends in _cut(points @ axes.T, count))
    homes = _cells_of(points, cells, axes)
    some = np.arange(len(points))
    if len(points) > _POINTS_LOOKED_AT:
        some = np.random.default_rng(0).choice(some, _POINTS_LOOKED_AT, replace=False)
    looked_at = points[some], homes[some]
    shares = np.array([_shares(view, *looked_at, count) for view in views]).reshape(len(views), count)
    for number in range(count):
        own, shown = int((homes == number).sum()), int((shares[:, number] > 0).sum())
        if shown < _FEWEST_VIEWS or not own:
            raise CaptureError(
                f"block {number + 1} of {count}",
                expected=f"points, and at least {_FEWEST_VIEWS} views that show them",
                found=f"{own:,} points and {shown} views",
                remedy="give a smaller --blocks, or more --memory where --blocks is auto",
            )
    groups = _groups(np.array([view.camera.position @ axes.T for view in views]), count)
    dealt = np.zeros(count, bool)
    if deal:
        groups, dealt = _dealt(groups, shares)
    weights = np.array([shares[group].sum(0) for group in groups])
    trained = [_cells_seen(row) if all_ else _cells_seen_most(row) for row, all_ in zip(weights, dealt)]
    for index in range(count):
        if not any(index in of_block for of_block in trained):
            trained[int(weights[:, index].argmax())].add(index)
    trains = np.array([[index in of_block for index in range(count)] for of_block in trained])
    owner = np.where(trains, weights, -1.0).argmax(0)
    blocks = tuple(
        Block(
            number,
            tuple(views[index].name for index in group),
            tuple(sorted(trained[number])),
            tuple(np.flatnonzero(owner == number).tolist()),
            tuple(np.flatnonzero((weights[number] > 0) & ~trains[number]).tolist()),
            bool(dealt[number]),
        )
        for number, group in enumerate(groups)
    )
    return Blocks(cells, blocks, axes)


def _dealt(
    groups: list[NDArray[np.int64]], shares: NDArray[np.float64]
) -> tuple[list[NDArray[np.int64]], NDArray[np.bool_]]:
    """Deal the views of groups that show the same cells among them, in turn; which groups these are ``[B]``."""
    found, dealt = list(groups), np.zeros(len(groups), bool)
    weights = np.array([shares[group].sum(0) for group in groups])
    seeing = np.flatnonzero(weights.sum(1) > 0)
    fewest = max(_FEWEST_ALIKE, _SHARE_ALIKE * len(groups))
    if len(seeing) < fewest:
        return found, dealt
    weights = weights[seeing] / weights[seeing].sum(1, keepdims=True)
    apart = pdist(weights, "cityblock") / 2  # one minus the overlap
    labels = fcluster(linkage(apart, "complete"), 1 - _ALIKE, "distance")  # no two of a set overlap less
    for label in np.unique(labels):
        members = seeing[labels == label]
        if len(members) < fewest:
            continue
        dealt[members] = True
        views = np.concatenate([groups[number] for number in members])
        for place, number in enumerate(members):
            found[number] = np.sort(views[place :: len(members)])
    return found, dealt


def _cells_seen(weights: NDArray[np.float64]) -> set[int]:
    return set(np.flatnonzero(weights > 0).tolist())


def _cells_seen_most(weights: NDArray[np.float64]) -> set[int]:
    order = np.argsort(-weights, kind="stable")[:CELLS_TRAINED]
    covered = np.cumsum(weights[order]) / max(weights.sum(), 1e-12)
    return set(order[: int(np.searchsorted(covered, _COVERED)) + 1].tolist())


def _shares(
    view: View, points: NDArray[np.float32], homes: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Share of each cell ``[B]`` in a view: of the points that it shows, each by its area in the image."""
    _, depth, shown = view.camera.project(points)
    if not shown.any():
        return np.zeros(count)
    area = np.maximum(depth[shown], np.quantile(depth[shown], 0.1)) ** -2
    return np.bincount(homes[shown], area, count) / area.sum()


def _cells_of(
    means: NDArray[np.floating], cells: tuple[Cell, ...], axes: NDArray[np.float64]
) -> NDArray[np.int64]:
    """The cell ``[N]`` of each center ``[N, 3]``."""
    ground = means.astype(np.float64) @ axes.T
    found = np.zeros(len(means), np.int64)
    for number, cell in enumerate(cells):  # one mask at a time: a large capture has many cells
        found[cell.holds(ground)] = number
    return found


def _cut(ground: NDArray[np.float64], count: int) -> list[tuple[NDArray, NDArray]]:
    """Halve the plane across the longer side of its places until there are ``count`` cells of equal numbers."""
    cells: list[tuple[NDArray, NDArray]] = []

    def cut(places: NDArray, low: NDArray, high: NDArray, count: int) -> None:
        if count == 1:
            cells.append((low, high))
            return
        axis, first = int(_sides(places).argmax()), count // 2
        at = float(np.quantile(places[:, axis], first / count)) if len(places) else 0.0
        middle_high, middle_low = high.copy(), low.copy()
        middle_high[axis] = middle_low[axis] = at
        below = places[:, axis] < at
        cut(places[below], low, middle_high, first)
        cut(places[~below], middle_low, high, count - first)

    cut(ground, np.full(2, -np.inf), np.full(2, np.inf), count)
    return cells


def _groups(stands: NDArray[np.float64], count: int) -> list[NDArray[np.int64]]:
    """Indices of the views of each of ``count`` groups, which differ by at most a view in size."""
    groups: list[NDArray[np.int64]] = []

    def divide(indices: NDArray[np.int64], count: int) -> None:
        if count == 1:
            groups.append(np.sort(indices))
            return
        axis, first = int(_sides(stands[indices]).argmax()), count // 2
        order = indices[np.argsort(stands[indices, axis], kind="stable")]
        at = round(len(order) * first / count)
        divide(order[:at], first)
        divide(order[at:], count - first)

    divide(np.arange(len(stands)), count)
    return groups


def _sides(ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Extent ``[2]`` of places ``[N, 2]`` without the stray ones far away."""
    if len(ground) < 2:
        return np.zeros(2)
    return np.ptp(np.quantile(ground, [0.02, 0.98], axis=0), axis=0)
