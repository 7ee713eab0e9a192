"""How long a reconstruction takes, measured on a few steps before it begins."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.trainer import Reconstructor
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture, InitialPoints

_FIRST = 2
"""Steps that are not timed: they read photos and load kernels."""
_STEPS = 4
_GROWTH = {"default": 1.45, "mcmc": 1.05}
"""Factor by which a round of density control multiplies the number of Gaussians; 1.4 to 1.55 on the bundled captures
with "default", and by definition with "mcmc"."""


def forecast(
    capture: Capture,
    config: ReconstructionConfig,
    points: InitialPoints,
    *,
    device: torch.device | str = "cpu",
    memory: int,
    listener: Listener = silent,
) -> float:
    """Seconds that a reconstruction will take.

    Steps are timed at half and at full size, with the initial points and with as many Gaussians as density control
    will have made. The reconstruction itself is not touched.

    Args:
        capture: Views and split.
        config: Settings.
        points: Initial points.
        device: Where to train.
        memory: Budget of host memory in bytes.
        listener: Receives an event of stage "calibrate" after each untimed step and each timed row of steps.
    """
    counts = _counts(config, len(points.points), config.cap(torch.device(device)))
    grown = (counts - counts[0]) / max(1.0, counts[-1] - counts[0])
    many = _grown(points, int(counts[-1]))
    parts = [
        (1.0, grown[: config.warm_up_iterations]),
        (0.0, grown[config.warm_up_iterations :]),
    ]
    parts = [part for part in parts if len(part[1])]
    done, steps = itertools.count(1), 2 * len(parts) * (_FIRST + _STEPS)
    listener(Event("calibrate", 0, steps))

    def per_step(start: InitialPoints, warm_up: float) -> float:
        trainer = Reconstructor(
            capture, replace(config, warm_up=warm_up), start, device=device, memory=memory
        )
        for _ in range(_FIRST):
            trainer.step()
            listener(Event("calibrate", next(done), steps))
        _finish(trainer.device)
        begin = time.perf_counter()
        for _ in range(_STEPS):
            trainer.step()
        _finish(trainer.device)
        seconds = time.perf_counter() - begin
        listener(Event("calibrate", [next(done) for _ in range(_STEPS)][-1], steps))
        return seconds / _STEPS

    total = 0.0
    for warm_up, shares in parts:
        few, most = per_step(points, warm_up), per_step(many, warm_up)
        total += float((few + shares * (most - few)).sum())
    return total


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _counts(config: ReconstructionConfig, start: int, cap: int) -> NDArray[np.float64]:
    """The expected number of Gaussians at each iteration ``[iterations]``."""
    schedule, steps = config.density_schedule, np.arange(config.iterations)
    rounds = np.clip((np.minimum(steps, schedule.stop) - schedule.start) // schedule.every, 0, None)
    return np.minimum(cap, min(start, cap) * _GROWTH[config.strategy] ** np.minimum(rounds, 400))


def _grown(points: InitialPoints, count: int) -> InitialPoints:
    """As many points as there may be Gaussians: copies beside the given ones, at about their distance."""
    repeats = max(1, -(-count // len(points.points)))
    generator = np.random.default_rng(0)
    spread = 0.01 * points.points.std(0)
    copies = [points.points + spread * generator.standard_normal(points.points.shape) for _ in range(repeats)]
    return replace(
        points,
        points=np.concatenate(copies).astype(points.points.dtype)[:count],
        colors=np.concatenate([points.colors] * repeats)[:count],
    )
