"""Reconstruction by blocks, for captures whose Gaussians do not fit into the memory of one reconstruction.

As in VastGaussian and CityGaussian, the ground plane is cut into cells with equal numbers of points. A block is a
cell with a margin, and the parts of the views that show it. First a coarse model of the whole is trained at half
resolution, with few Gaussians. Each block starts from it, so that what its views show of other cells is explained,
and adds Gaussians in its cell and margin only. Of each result only the Gaussians inside the cell are kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.gaussians import TENSORS, Gaussians
from lexsplat.reconstruction.photos import WHOLE
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.trainer import Reconstructor
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError, FileFormatError, TrainingError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.training import Checkpoint
from lexsplat.runtime.workers import IN_PROCESS, Needs, SharedFolder, Workers, results

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.reconstruction.photos import Window

SHARE_OUTSIDE = 3.0
"""Gaussians that a block may have, in those that its cell keeps: the others explain what lies outside of the cell."""
COARSE_SHARE = 1.5
"""Gaussians of the coarse model, in those that a cell keeps."""
COARSE_ITERATIONS = 0.3
"""Share of the iterations that train the coarse model; the others train the blocks."""

_MARGIN = 0.15
_SEEN_SHARE = 0.15
_WINDOW_MARGIN = 0.06
"""What is added to the part of a view that shows the points of a block, as a share of its sides."""
_STRAY = 0.005
"""Share of the points at each side of that part that do not count."""
_FEWEST_VIEWS = 3
_MOST_BLOCKS = 1024


@dataclass(frozen=True)
class Block:
    """A part of a capture that is reconstructed alone.

    Args:
        low: Lower ends of the cell ``[2]`` on the ground plane; -inf at the border of the capture.
        high: Upper ends ``[2]``; inf at the border.
        windows: The parts of the training views that show it, by name.
        margin: Width of the margin on all sides ``[2]``.
        inside: Indices of the initial points in the cell and its margin ``[P']``.
        own: Number of points in the cell.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    windows: Mapping[str, Window]
    margin: NDArray[np.float64]
    inside: NDArray[np.int64]
    own: int

    def holds(self, ground: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which places ``[N, 2]`` on the ground plane lie in the cell ``[N]``."""
        return _within(ground, self.low, self.high)


@dataclass(frozen=True)
class BlockRun:
    """How blocks are reconstructed.

    Args:
        device: Device to train on.
        seed: Seed of each block's training.
        memory: Host memory of one block in bytes.
        folder: Where the results of blocks are kept for the next run.
        key: Fingerprint of everything that the result depends on.
        checkpoint_seconds: Seconds between two checkpoints of a block.
        workers: Where the blocks are reconstructed: one after the other in this process, or side by side.
        listener: Receives an event of stage "blocks" after each.
    """

    device: str
    seed: int
    memory: int
    folder: Path
    key: str
    checkpoint_seconds: float = 20.0
    workers: Workers = IN_PROCESS
    listener: Listener = silent


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
        return 1 if device != "cpu" or need <= memory else math.ceil(SHARE_OUTSIDE * need / memory)
    if blocks == "none":
        return 1
    if not blocks.isdecimal() or not 1 <= int(blocks) <= _MOST_BLOCKS:
        raise ValueError(f"blocks must be auto, none or a number from 1 to {_MOST_BLOCKS}, got {blocks!r}")
    return int(blocks)


def ground_axes(up: Up) -> NDArray[np.float64]:
    """Two unit vectors ``[2, 3]`` that span the ground plane.

    Raises:
        CaptureError: If the cameras do not tell which way is up.
    """
    if not up.reliable:
        raise CaptureError(
            "--blocks",
            expected="a ground plane, to cut the capture on",
            found="cameras that do not tell which way is up",
            remedy="give --up X,Y,Z or --blocks none",
        )
    first = np.cross(up.direction, np.eye(3)[np.abs(up.direction).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up.direction, first)])


def cut_blocks(
    capture: Capture, points: NDArray[np.float32], axes: NDArray[np.float64], count: int
) -> list[Block]:
    """Cut a capture into blocks of equal numbers of points.

    Args:
        capture: Its training views.
        points: Initial points ``[P, 3]``.
        axes: From `ground_axes`.
        count: Number of blocks.

    Raises:
        CaptureError: If a block has too few points, or too few views see it.
    """
    ground = points @ axes.T
    seen = {view.name: places_in_image(view, points) for view in capture.train_views}
    stands = {view.name: view.camera.position @ axes.T for view in capture.train_views}
    cells: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    _cut(ground, np.full(2, -np.inf), np.full(2, np.inf), count, cells)
    blocks = []
    for number, (low, high) in enumerate(cells, start=1):
        own = ground[_within(ground, low, high)]
        margin = _MARGIN * _sides(own)
        inside = _within(ground, low - margin, high + margin)
        windows = {
            name: _window(places[inside[shown]])
            for name, (shown, places) in seen.items()
            if inside[shown].sum() >= _SEEN_SHARE * max(1, len(shown))
        }
        if len(windows) < _FEWEST_VIEWS or not len(own):
            raise CaptureError(
                f"block {number} of {count}",
                expected=f"points, and at least {_FEWEST_VIEWS} views that show them",
                found=f"{len(own):,} points and {len(windows)} views",
                remedy="give a smaller --blocks",
            )
        # A view from within the cell looks through it, at whatever it shows: without it, fog would be left there.
        windows |= {name: WHOLE for name, place in stands.items() if _within(place[None], low, high)[0]}
        blocks.append(Block(low, high, windows, margin, np.flatnonzero(inside), len(own)))
    return blocks


def _within(
    ground: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.bool_]:
    return np.all((ground >= low) & (ground < high), axis=1)


def _cut(
    ground: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    count: int,
    cells: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> None:
    """Halve a cell across its longer side until there are ``count`` cells of equal numbers of points."""
    if count == 1:
        cells.append((low, high))
        return
    axis, first = int(_sides(ground).argmax()), count // 2
    at = float(np.quantile(ground[:, axis], first / count)) if len(ground) else 0.0
    middle_high, middle_low = high.copy(), low.copy()
    middle_high[axis] = middle_low[axis] = at
    below = ground[:, axis] < at
    _cut(ground[below], low, middle_high, first, cells)
    _cut(ground[~below], middle_low, high, count - first, cells)


def _on_ground(gaussians: Gaussians, axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centers on the ground plane ``[N, 2]``."""
    return gaussians.means.numpy().astype(np.float64) @ axes.T


def _sides(ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Extent ``[2]`` of places ``[N, 2]`` without the stray ones far away."""
    if len(ground) < 2:
        return np.zeros(2)
    return np.ptp(np.quantile(ground, [0.02, 0.98], axis=0), axis=0)


def places_in_image(view: View, points: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices ``[S]`` of the points in the image of a view, and where they are ``[S, 2]``, in shares of its sides."""
    camera = view.camera
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depth = np.maximum(local[:, 2:], 1e-9)
    places = local[:, :2] / depth * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
    places /= camera.width, camera.height
    shown = np.flatnonzero((local[:, 2] > 0) & ((places >= 0) & (places < 1)).all(1))
    return shown, places[shown]


def _window(places: NDArray[np.float64]) -> Window:
    """The part of an image that shows points at ``places`` ``[S, 2]``, with a margin."""
    low, high = np.quantile(places, [_STRAY, 1 - _STRAY], axis=0)
    left, top = np.maximum(0.0, low - _WINDOW_MARGIN)
    right, bottom = np.minimum(1.0, high + _WINDOW_MARGIN)
    return float(left), float(top), float(right), float(bottom)


class BlockReconstructor(Reconstructor):
    """The reconstruction of a block: it starts from the coarse model and adds Gaussians in cell and margin only.

    Args:
        capture: The capture with the views of the block.
        config: Settings of the block.
        points: Its initial points, which are added to the coarse model.
        coarse: The coarse model of the whole.
        block: The block.
        axes: From `ground_axes`.
        options: Device, seed and memory, as in `Reconstructor`.
    """

    def __init__(
        self,
        capture: Capture,
        config: ReconstructionConfig,
        points: InitialPoints,
        coarse: Gaussians,
        block: Block,
        axes: NDArray[np.float64],
        **options: Any,
    ) -> None:
        self._coarse = coarse
        super().__init__(capture, config, points, windows=block.windows, **options)
        ends = axes, block.low - block.margin, block.high + block.margin
        self._axes, self._low, self._high = (
            torch.tensor(a, dtype=torch.float32).to(self.device) for a in ends
        )

    def _initial_parameters(self, start: InitialPoints) -> dict[str, torch.nn.Parameter]:
        own = super()._initial_parameters(start)
        coarse = self._coarse.to(self.device).tensors()
        return {name: torch.nn.Parameter(torch.cat([coarse[name], own[name].detach()])) for name in own}

    def _control_density(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Density control for which Gaussians outside of the margin have no gradient; "mcmc" does not ask for one."""
        if means2d.grad is not None:
            ground = self._parameters["means"].detach() @ self._axes.T
            inside = ((ground >= self._low) & (ground < self._high)).all(1)
            means2d.grad.mul_(inside[:, None])
        super()._control_density(means2d, radii, image_size)


@dataclass(frozen=True)
class _Shared:
    """What the tasks of all blocks read."""

    capture: Capture
    points: InitialPoints
    config: ReconstructionConfig
    axes: NDArray[np.float64]
    folder: SharedFolder
    run: BlockRun
    kept: float
    """Gaussians that each cell keeps."""
    coarse: Gaussians


def reconstruct_blocks(
    capture: Capture, config: ReconstructionConfig, points: InitialPoints, up: Up, count: int, run: BlockRun
) -> Gaussians:
    """Reconstruct a capture block by block; blocks that an earlier run has finished are kept.

    Args:
        capture: Views and split.
        config: Settings of the whole; each block has its share of the Gaussians and of the iterations.
        points: Initial points of the whole.
        up: Up direction.
        count: Number of blocks.
        run: How they are reconstructed.

    Raises:
        CaptureError: If there is no ground plane, or a block has no views.
        MemoryBudgetError: If a block does not fit into ``run.memory``.
        TrainingError: If blocks diverge; the others are kept.
    """
    axes = ground_axes(up)
    blocks = cut_blocks(capture, points.points, axes, count)
    cap = math.ceil(SHARE_OUTSIDE * config.cap(torch.device(run.device)) / count)
    if run.device == "cpu":
        what, need = f"{cap:,} Gaussians of a block", 2 * cap * budget.GAUSSIAN_BYTES
        budget.require("reconstruct", need, run.memory, what, "a larger --blocks")
    items = {f"block {number} of {count}": block for number, block in enumerate(blocks, start=1)}
    parts: list[Gaussians] = []
    with SharedFolder.offered(run.folder) as folder:
        listener, workers = run.listener, run.workers
        if workers.distributed:  # listeners stay here
            run = replace(run, listener=silent)
        own = replace(run, workers=IN_PROCESS)
        kept = cap / SHARE_OUTSIDE
        coarse = _coarse_model(capture, config, points, kept, replace(own, listener=listener))
        config = replace(config, max_gaussians=cap)
        shared = _Shared(capture, points, config, axes, folder, own, kept, coarse)
        needs = Needs(memory=run.memory, gpu=run.device == "cuda")
        listener(Event("blocks", 0, count))
        for part in results(workers.map(_reconstruct_block, shared, items, needs)):
            parts.append(part)
            listener(Event("blocks", len(parts), count, {"gaussians": float(sum(map(len, parts)))}))
    tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in TENSORS}
    return Gaussians(**tensors, antialiased=config.antialiased)


def _coarse_model(
    capture: Capture, config: ReconstructionConfig, points: InitialPoints, kept: float, run: BlockRun
) -> Gaussians:
    """The coarse model, from its file if an earlier run has finished it; on the CPU."""
    path = run.folder / f"{fingerprint(run.key, 'coarse')}.safetensors"
    if (found := _read_gaussians(path, config)) is not None:
        return found
    config = replace(
        config,
        iterations=max(1, round(COARSE_ITERATIONS * config.iterations)),
        warm_up=1.0,
        max_gaussians=math.ceil(COARSE_SHARE * kept),
    )
    trainer = Reconstructor(capture, config, points, device=run.device, seed=run.seed, memory=run.memory)
    checkpoint = Checkpoint(
        path.with_suffix(".training.safetensors"), path.stem, every=run.checkpoint_seconds
    )
    trainer.run(run.listener, checkpoint)
    found = trainer.gaussians().to("cpu").map(lambda tensor: tensor.clone())
    write_tensors(path, found.tensors(), {})
    checkpoint.remove()
    return found


def _read_gaussians(path: Path, config: ReconstructionConfig) -> Gaussians | None:
    """Gaussians that an earlier run has written; None if there are none, or if they are damaged."""
    if not path.exists():
        return None
    try:
        return Gaussians(**read_tensors(path)[0], antialiased=config.antialiased)
    except (FileFormatError, TypeError, ValueError):
        path.unlink()
        return None


def _reconstruct_block(shared: _Shared, block: Block) -> Gaussians:
    """The Gaussians of a block's cell, from its file if an earlier run has finished it; on the CPU."""
    run, folder = shared.run, shared.folder
    key = fingerprint(run.key, [block.low.tolist(), block.high.tolist()])
    path = folder.path / f"{key}.safetensors"
    if folder.is_visible and (kept := _read_gaussians(path, shared.config)) is not None:
        return kept
    found = _train_block(shared, block, path)
    if len(found) == 0:
        raise TrainingError(
            "reconstruction",
            expected="Gaussians in every block",
            found="a block without",
            remedy="give a smaller --blocks",
        )
    if folder.is_visible:
        write_tensors(path, found.tensors(), {})
    return found


def _train_block(shared: _Shared, block: Block, path: Path) -> Gaussians:
    """Train a block, each view as often as for the whole capture, and keep the Gaussians in its cell.

    The Gaussians may become as many as the cell keeps, those of its margin in proportion, and the coarse ones
    outside.
    A round of density control has as many views a Gaussian as in the whole. Adam divides by the root of a mean of
    squared gradients, in which a Gaussian counts as 0 in each step that does not show it. In a block most steps show
    it, so the rates are larger by the root of the share of the views.
    """
    run, views, points, coarse = shared.run, shared.capture.views, shared.points, shared.coarse
    names = tuple(block.windows)
    part = replace(shared.capture, views={n: views[n] for n in names}, train_names=names, test_names=())
    share = len(names) / len(shared.capture.train_names)
    config, cap = shared.config, shared.config.cap(torch.device(run.device))
    grown = math.ceil(shared.kept * len(block.inside) / block.own)
    near = _within(_on_ground(coarse, shared.axes), block.low - block.margin, block.high + block.margin).sum()
    room = max(1, min(cap - len(coarse), grown - int(near)))
    config = replace(
        config,
        iterations=max(1, round(share * (1 - COARSE_ITERATIONS) * config.iterations)),
        warm_up=0.0,
        rate_scale=config.scale_of_rates / math.sqrt(share),
        opacities_rate=config.opacities_rate / math.sqrt(share),
        densify_min_every=max(1, round(share * config.densify_min_every)),
        max_gaussians=len(coarse) + room,
    )
    chosen = block.inside[:: -(-len(block.inside) // room)]
    start = replace(points, points=points.points[chosen], colors=points.colors[chosen])
    options = {"device": run.device, "seed": run.seed, "memory": run.memory}
    trainer = BlockReconstructor(part, config, start, coarse, block, shared.axes, **options)
    checkpoint = None
    if shared.folder.is_visible:
        checkpoint = Checkpoint(
            path.with_suffix(".training.safetensors"), path.stem, every=run.checkpoint_seconds
        )
    trainer.run(run.listener, checkpoint)
    gaussians = trainer.gaussians().to("cpu")
    inside = block.holds(_on_ground(gaussians, shared.axes))
    if checkpoint is not None:
        checkpoint.remove()
    return gaussians.select(torch.from_numpy(inside)).map(lambda tensor: tensor.clone())
