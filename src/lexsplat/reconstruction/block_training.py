"""Reconstruction by blocks, for captures whose Gaussians do not fit into the memory of one reconstruction.

The training of the whole is cut into visits: in each round, every block is loaded from disk once, most of them
together with a neighbor, trained on some of its views, and written back, with Adam's moments. Steps, learning rates
and density control are those of one piece; the order of the views differs. Visits that train no cell in common run
side by side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lexsplat.geometry.gaussians import Gaussians, joined
from lexsplat.reconstruction.block_files import (
    EXPOSURES,
    MOMENTS,
    STATISTICS,
    CellFiles,
    CellState,
    Visit,
    VisitsOfGroup,
    idle,
    plan,
)
from lexsplat.reconstruction.block_visits import VisitReconstructor, adam_steps, calm_factor, visit_seed
from lexsplat.reconstruction.blocks import Blocks, cut_blocks, ground_axes
from lexsplat.reconstruction.densification import DensityControl
from lexsplat.reconstruction.few_photos import has_few_photos
from lexsplat.reconstruction.first_run import compile_kernels
from lexsplat.reconstruction.forecasting import tell_time_of_blocks
from lexsplat.reconstruction.optimizers import adam, load_optimizer_tensors
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.surroundings import Surroundings
from lexsplat.reconstruction.trainer import initial_gaussians
from lexsplat.runtime import memory as budget
from lexsplat.runtime.files import write_file
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.workers import IN_PROCESS, Needs, SharedFolder, Workers, results

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.geometry.boxes import Up

ROUNDS = 16
"""Least number of rounds, in each of which all blocks are visited."""
ROUNDS_DEALT = 10
"""The same if all views are dealt: their order does not matter then, and longer visits load less."""
ROUND_STEPS = 500
"""Steps of a round at most; longer trainings have more rounds."""
FEWEST_STEPS = 4
"""Steps of a visit at least; short trainings have fewer rounds."""
FIXED_BYTES = 1_000
"""Bytes per Gaussian that takes part with fixed values: its values, a copy beside the trained ones, a gradient."""


@dataclass(frozen=True)
class BlockRun:
    """How blocks are reconstructed.

    Args:
        device: Device to train on.
        seed: Seed of the training.
        memory: Host memory of one block in bytes.
        folder: Folder of the state between visits, and for the next run; every worker must see it.
        key: Fingerprint of everything that the result depends on.
        workers: Workers that train the blocks: one after the other in this process, or side by side.
        listener: Receives an event of stage "blocks" after each visit.
    """

    device: str
    seed: int
    memory: int
    folder: Path
    key: str
    workers: Workers = IN_PROCESS
    listener: Listener = silent


@dataclass(frozen=True)
class _Shared:
    """Inputs shared by the visits of a group."""

    capture: Capture
    config: ReconstructionConfig
    blocks: Blocks
    folder: SharedFolder
    files: CellFiles
    run: BlockRun
    extent: float
    groups: int
    """Number of groups of visits before this one."""
    room: tuple[int, ...]
    """Gaussians that density control may add to each cell in this round."""


def reconstruct_blocks(
    capture: Capture, config: ReconstructionConfig, points: InitialPoints, up: Up, count: int, run: BlockRun
) -> Gaussians:
    """Reconstruct a capture block by block; a killed run resumes after the last finished visits.

    Args:
        capture: Views and split.
        config: Settings of the whole.
        points: Initial points of the whole.
        up: Up direction.
        count: Number of blocks.
        run: Settings of the run.

    Raises:
        CaptureError: If there is no ground plane, or a block has no views.
        MemoryBudgetError: If a block does not fit into ``run.memory``.
        TrainingError: If a block diverges; finished visits are kept.
        WorkersError: If a worker comes later that does not see ``run.folder``, as the others do.
    """
    # Few are the photos of the whole, and `CALM` takes the place of the cool-down.
    config = replace(config.for_photos(has_few_photos(capture)), cool_down=0.0)
    cap = config.cap(torch.device(run.device))
    deal = run.device != "cpu" or 2 * cap * budget.GAUSSIAN_BYTES <= run.memory
    blocks = cut_blocks(capture, points.points, ground_axes(up), count, deal=deal)
    rounds = ROUNDS_DEALT if all(block.dealt for block in blocks.blocks) else ROUNDS
    rounds = max(rounds, math.ceil(config.iterations / ROUND_STEPS))
    rounds = max(1, min(rounds, config.iterations // (FEWEST_STEPS * count)))
    # The exposures of a block are kept with its visits, so that it is visited alone.
    groups = plan(blocks, config.iterations, rounds, pairs=not config.exposure)
    if run.device == "cpu":
        trained = math.ceil(cap / count * max(len(v.block.trained) for group in groups for v in group))
        need = 2 * trained * budget.GAUSSIAN_BYTES
        budget.require(
            "reconstruct", need, run.memory, f"{trained:,} Gaussians of a block", "a larger --blocks"
        )
    total, listener, workers = sum(map(len, groups)), run.listener, run.workers
    needs = Needs(memory=run.memory, gpu=run.device == "cuda")
    own = replace(run, workers=IN_PROCESS, listener=silent)
    with SharedFolder.offered(run.folder) as folder:
        key = fingerprint(run.key, [(block.views, block.trained) for block in blocks.blocks])
        files = CellFiles(folder.path, key, blocks, groups)
        finished, extent = files.finished(), capture.extent
        room: tuple[int, ...] = ()
        if not workers.distributed:
            compile_kernels(run.device, listener)
        seen = workers.see(folder)
        if finished < 0:
            finished = 0
            if not workers.distributed:
                options = {"device": run.device, "memory": run.memory, "listener": listener}
                tell_time_of_blocks(capture, config, points, blocks, config.iterations // rounds, **options)
            _write_start(files, blocks, config, points, run)
        listener(Event("blocks", sum(map(len, groups[:finished])), total))
        for index, group in enumerate(groups[finished:], start=finished):
            if index == 0 or group[0].round != groups[index - 1][0].round or not room:
                room = _room(files, group[0].round, index, config, cap)
            part = _seen_by(group, capture)
            shared = _Shared(part, config, blocks, folder, files, own, extent, index, room)
            names = {f"block {v.block.number + 1} of {count}, round {v.round + 1}": v for v in group}
            items = VisitsOfGroup(names, files, index, None if seen else folder)
            found = results(workers.map(_visit, shared, items, needs))
            for done, (number, size, content) in enumerate(found, group[0].number + 1):
                if content:
                    write_file(files.path(number), content)
                listener(Event("blocks", done, total, {"gaussians": float(size), **workers.metrics}))
            files.remove_old(index + 1)
        latest = files.latest(len(groups))
        parts = [files.gaussians(latest[str(cell)][0], cell, config.antialiased) for cell in range(count)]
    return joined(parts)


def _seen_by(group: list[Visit], capture: Capture) -> Capture:
    """The part of the capture that workers need: the views of a group of visits."""
    views = {name: capture.views[name] for visit in group for name in visit.block.views}
    none, colors = capture.points[:0], capture.point_colors[:0]
    names = tuple(sorted(views))
    return replace(capture, views=views, train_names=names, test_names=(), points=none, point_colors=colors)


def _write_start(
    files: CellFiles, blocks: Blocks, config: ReconstructionConfig, points: InitialPoints, run: BlockRun
) -> None:
    """The state before the first visit."""
    generator = torch.Generator().manual_seed(run.seed)
    config = replace(config, max_gaussians=config.cap(torch.device(run.device)))
    gaussians = initial_gaussians(config, points, torch.device("cpu"), generator)
    files.write_start(gaussians, blocks.cells_of(gaussians.means.numpy()))
    del gaussians
    budget.give_back_freed()


def _room(
    files: CellFiles, number: int, groups: int, config: ReconstructionConfig, cap: int
) -> tuple[int, ...]:
    """Number of Gaussians that round ``number`` of density control may add to each cell.

    Within the cap of the whole, those with the largest gradients grow. The numbers are kept in a file, because a run
    that was killed in a round goes on with those of its start.
    """
    if (kept := files.room(number)) is not None:
        return kept
    gradients = [sums / times.clamp_min(1) for sums, times in files.all_statistics(groups)]
    free = max(0, cap - sum(map(len, gradients)))
    if config.strategy == "mcmc":  # it adds a share at random, without statistics
        total = max(1, sum(map(len, gradients)))
        room = tuple(free * len(of_cell) // total for of_cell in gradients)
        files.write_room(number, room)
        return room
    every = torch.cat(gradients)
    threshold = config.grow_gradient
    if int((every > threshold).sum()) > free:
        threshold = float(torch.topk(every, free + 1).values[-1])
    room = tuple(int((of_cell > threshold).sum()) for of_cell in gradients)
    files.write_room(number, room)
    return room


def _visit(shared: _Shared, item: tuple[Visit, Mapping[str, bytes] | None]) -> tuple[int, int, bytes]:
    """Train a block for the steps of a visit and write its cells.

    Args:
        shared: Inputs that all visits read.
        item: The visit, and the files that it reads if the workers do not see the folder.

    Returns:
        The number of the visit and of its Gaussians, and its file if the workers do not see the folder.
    """
    visit, carried = item
    with shared.folder.opened(carried) as folder:
        files = shared.files.at(folder)
        count = _trained(replace(shared, files=files), visit)
        content = b"" if carried is None else files.path(visit.number).read_bytes()
        return visit.number, count, content


def _trained(shared: _Shared, visit: Visit) -> int:
    run, files, blocks = shared.run, shared.files, shared.blocks
    latest, block = files.latest(shared.groups), visit.block
    if files.path(visit.number).exists():  # by a run that was killed before the others of its group had ended
        return sum(len(files.gaussians(visit.number, cell, False)) for cell in block.trained)
    states = {cell: _present(shared, visit, cell, *latest[str(cell)]) for cell in block.trained}
    homes = np.repeat(list(states), [len(state) for state in states.values()])
    around = _surroundings(shared, visit, latest)
    if run.device == "cpu":
        others = 0 if around is None else len(around)
        need = len(homes) * budget.GAUSSIAN_BYTES + others * FIXED_BYTES
        what = f"{len(homes):,} Gaussians of a block and {others:,} that its views show"
        budget.require("reconstruct", need, run.memory, what, "a larger --blocks")
    state = CellState.joined(states.values())
    states.clear()
    own = {name: shared.capture.views[name] for name in block.views}
    part = replace(shared.capture, views=own, train_names=block.views, test_names=())
    options = {"device": run.device, "memory": run.memory, "extent": shared.extent}
    trainer = VisitReconstructor(
        part, shared.config, visit, state, around, run.seed, photos=files.photos, **options
    )
    before = latest.get(f"{EXPOSURES}{block.number}")
    if before is not None:
        trainer.load_exposures(files.read(before[0], EXPOSURES))
    trainer.run()
    state, exposures = trainer.result()
    cells = blocks.cells_of(state.parameters["means"].numpy())
    cells = np.where(np.isin(cells, block.trained), cells, homes)
    after = {cell: state.select(torch.from_numpy(cells == cell)) for cell in block.trained}
    files.write(visit.number, after, exposures)
    del trainer, around, state, after
    budget.give_back_freed()  # otherwise the next visit's memory would come on top of it
    return len(cells)


def _present(shared: _Shared, visit: Visit, cell: int, written: int, last: int) -> CellState:
    """The Gaussians of a cell at the start of a visit; a round of density control is due if the block owns it."""
    config = shared.config
    state = shared.files.cell(written, cell)
    rates = config.rates(shared.extent)
    rates["means"] *= (config.means_rate_final / config.means_rate) ** (last / config.iterations)
    calm = calm_factor(config, last)
    for name in state.parameters:
        idle(state, name, calm * rates[name], visit.start - last, adam_steps(config, name, last))
    if cell in visit.block.owned and visit.round and len(state):
        control = DensityControl(
            replace(config, max_gaussians=len(state) + shared.room[cell]),
            shared.extent,
            seed=visit_seed(shared.run.seed, visit.number, cell),
        )
        state = _refined(state, control, visit.start, visit.round_steps)
    return state


def _refined(state: CellState, control: DensityControl, step: int, steps: int) -> CellState:
    """The Gaussians after a round of density control."""
    parameters = {name: torch.nn.Parameter(tensor) for name, tensor in state.parameters.items()}
    optimizers = {name: adam(parameter, 0.0) for name, parameter in parameters.items()}
    for name, optimizer in optimizers.items():
        moments = {moment: state.moments[f"{moment}/{name}"] for moment in MOMENTS}
        load_optimizer_tensors(optimizer, {"step": torch.tensor(1.0), **moments})
    control.load_state_tensors({**control.state_tensors(), **state.statistics})
    if not control.refine(parameters, optimizers, step, steps):
        return state
    found = {name: parameter.detach() for name, parameter in parameters.items()}
    moments = {
        f"{moment}/{name}": optimizers[name].state[parameters[name]][moment]
        for moment in MOMENTS
        for name in parameters
    }
    statistics = {name: torch.zeros(len(found["means"])) for name in STATISTICS}
    return CellState(found, moments, statistics)


def _surroundings(
    shared: _Shared, visit: Visit, latest: Mapping[str, tuple[int, int]]
) -> Surroundings | None:
    """The Gaussians of the cells that a visit does not train, as far as its views show them."""
    if not visit.block.shown:
        return None
    rng = np.random.default_rng([shared.run.seed, visit.number])
    cameras = [shared.capture.views[name].camera for name in sorted(set(visit.views(shared.run.seed)))]
    antialiased = shared.config.antialiased
    cells = (shared.files.gaussians(latest[str(n)][0], n, antialiased) for n in visit.block.shown)
    return Surroundings.seen(cells, cameras, rng)
