"""Time estimate of a reconstruction, in one piece or by blocks, measured on a few steps beforehand."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.trainer import STAGE, Reconstructor
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import Event, Listener, silent, tell
from lexsplat.runtime.training import Training, time_steps

if TYPE_CHECKING:
    from lexsplat.captures import Capture, InitialPoints
    from lexsplat.reconstruction.blocks import Blocks

_TOLD_FROM = 1000
"""Fewest iterations with a forecast; the calibration takes as long as about a hundred of them."""
_FIRST = 24
"""Steps that are not timed: the first Gaussians are large and faint, and take two to seven times as long."""
_STEPS = 4
_NEIGHBORS = 3
"""Neighbors whose mean distance is the deviation of a copy from its point along each axis."""
_GROWTH = {"default": 1.45, "mcmc": 1.05}
"""Factor by which a round of density control multiplies the number of Gaussians; 1.4 to 1.55 on the bundled captures
with "default", and by definition with "mcmc"."""


_GROWTH_OF_BLOCKS = {"default": 1.32, "mcmc": 1.05}
"""The same for a round of visits to all blocks; 1.28 to 1.43 on the bundled captures and fox with "default"."""
_OF_VISITS = 1.2
"""Time of blocks in multiples of that of their steps: cells are read and written, and others take part."""


def tell_time(capture: Capture, config: ReconstructionConfig, points: InitialPoints, **options: Any) -> None:
    """Log the estimated time of a reconstruction (`forecast`, whose options these are) unless it is short."""
    if config.iterations >= _TOLD_FROM:
        with suppress(TrainingError):  # the training itself may recover
            seconds = forecast(capture, config, points, **options)
            tell(STAGE, seconds, f"{config.iterations:,} iterations")


def tell_time_of_blocks(
    capture: Capture,
    config: ReconstructionConfig,
    points: InitialPoints,
    blocks: Blocks,
    round_steps: int,
    **options: Any,
) -> None:
    """Log the estimated time of a reconstruction by blocks in this process unless it is short.

    The steps of one block stand for those of all, which differ by the cells that they train.

    Args:
        capture: Views and split.
        config: Settings of the whole.
        points: Initial points of the whole.
        blocks: The blocks.
        round_steps: Steps of a round of visits, before which density control acts.
        options: Device, memory and listener, as in `forecast`.
    """
    if config.iterations < _TOLD_FROM:
        return
    homes = blocks.cells_of(points.points)
    of_cells = np.bincount(homes, minlength=len(blocks.cells))
    trained = [int(of_cells[list(block.trained)].sum()) for block in blocks.blocks]
    block = blocks.blocks[int(np.argsort(trained, kind="stable")[len(trained) // 2])]
    mine = np.isin(homes, block.trained)
    cap = max(1, round(config.cap(torch.device(options["device"])) * float(mine.mean())))
    own = replace(config, max_gaussians=cap)
    steps = np.arange(config.iterations)
    rounds = np.minimum(steps, config.density_schedule.stop) // round_steps
    counts = _grown_counts(int(mine.sum()), cap, rounds, _GROWTH_OF_BLOCKS[config.strategy])
    part = replace(capture, train_names=block.views)
    some = replace(points, points=points.points[mine], colors=points.colors[mine])
    with suppress(TrainingError):  # the training itself may recover
        seconds = _OF_VISITS * forecast(part, own, some, counts=counts, **options)
        tell("blocks", seconds, f"{config.iterations:,} iterations")


# What a reconstruction is made of, and what takes part beside it or grows in another way.
def forecast(
    capture: Capture,
    config: ReconstructionConfig,
    points: InitialPoints,
    *,
    device: torch.device | str = "cpu",
    memory: int,
    listener: Listener = silent,
    joined: Callable[[Reconstructor], Training] = lambda reconstructor: reconstructor,
    counts: NDArray[np.float64] | None = None,
) -> float:
    """Seconds that a reconstruction will take.

    Steps are timed at half and at full size, with the initial points and with as many Gaussians as density control
    will have made. The reconstruction itself is not touched.

    Args:
        capture: Views and split.
        config: Settings.
        points: Initial points.
        device: Device of the training.
        memory: Budget of host memory in bytes.
        listener: Receives an event of stage "calibrate" after each untimed step and each timed row of steps.
        joined: A training that runs the steps of a reconstruction together with those of something else.
        counts: Expected number of Gaussians at each iteration; None takes that of density control in one piece.

    Raises:
        TrainingError: If one of the steps has no finite loss.
    """
    if counts is None:
        counts = _counts(config, len(points.points), config.cap(torch.device(device)))
    grown = (counts - counts[0]) / max(1.0, counts[-1] - counts[0])
    many = _grown(points, int(counts[-1]))
    parts = [
        (1.0, grown[: config.warm_up_iterations]),
        (0.0, grown[config.warm_up_iterations :]),
    ]
    parts = [part for part in parts if len(part[1])]
    steps = 2 * len(parts) * (_FIRST + _STEPS)
    listener(Event("calibrate", 0, steps))
    before = 0

    def per_step(start: InitialPoints, warm_up: float) -> float:
        nonlocal before
        settings = replace(config, warm_up=warm_up)
        trainer = Reconstructor(capture, settings, start, device=device, memory=memory)
        seconds = time_steps(
            joined(trainer),
            _FIRST,
            _STEPS,
            lambda done: listener(Event("calibrate", before + done, steps)),
        )
        before += _FIRST + _STEPS
        return seconds

    total = 0.0
    try:
        for warm_up, shares in parts:
            few, most = per_step(points, warm_up), per_step(many, warm_up)
            total += float((few + shares * (most - few)).sum())
    except TrainingError:
        listener(Event("calibrate", steps, steps))  # otherwise its bar stays
        raise
    return total


def _counts(config: ReconstructionConfig, start: int, cap: int) -> NDArray[np.float64]:
    """The expected number of Gaussians at each iteration ``[iterations]``."""
    schedule, steps = config.density_schedule, np.arange(config.iterations)
    rounds = np.clip((np.minimum(steps, schedule.stop) - schedule.start) // schedule.every, 0, None)
    return _grown_counts(start, cap, rounds, _GROWTH[config.strategy])


def _grown_counts(start: int, cap: int, rounds: NDArray[np.int64], growth: float) -> NDArray[np.float64]:
    """The number of Gaussians after some rounds of density control ``[iterations]``."""
    return np.asarray(np.minimum(cap, min(start, cap) * growth ** np.minimum(rounds, 400)))


def _grown(points: InitialPoints, count: int) -> InitialPoints:
    """As many points as there may be Gaussians: the given ones, and copies near them."""
    repeats, generator = max(1, -(-count // len(points.points))), np.random.default_rng(0)
    near = min(_NEIGHBORS + 1, len(points.points))
    distances = cKDTree(points.points).query(points.points, k=range(1, near + 1))[0]
    spread = distances.sum(1, keepdims=True) / max(1, near - 1)  # the first is the point itself
    offsets = [np.zeros_like(points.points)]
    offsets += [spread * generator.standard_normal(points.points.shape) for _ in range(repeats - 1)]
    copies = np.concatenate([points.points + offset for offset in offsets])[:count]
    return replace(
        points,
        points=copies.astype(points.points.dtype),
        colors=np.concatenate([points.colors] * repeats)[:count],
    )
