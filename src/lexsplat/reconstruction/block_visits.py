"""The steps of one visit to a block (`lexsplat.reconstruction.block_training` makes all visits)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians, joined
from lexsplat.reconstruction.block_files import BETAS, EXPOSURES, MOMENTS, STATISTICS, CellState, Visit
from lexsplat.reconstruction.optimizers import load_optimizer_tensors
from lexsplat.reconstruction.settings import REFERENCE_ITERATIONS, ReconstructionConfig
from lexsplat.reconstruction.surroundings import Surroundings
from lexsplat.reconstruction.trainer import Reconstructor

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.geometry.cameras import Camera
    from lexsplat.rendering import Rendering

WORTH_CACHING = 3
"""Steps for each view of a visit from which photos are kept in memory; below, most would be read only once."""
CALM = (0.7, 0.1)
"""From the first share of the iterations on, all learning rates fall, exponentially, to the second share of them at
the end: the views of the last visits would otherwise count for more than the others."""

_NEVER = 1 << 40


class VisitReconstructor(Reconstructor):
    """A part of a reconstruction: the steps of one visit, on the views of its block.

    Args:
        capture: The capture with the views of the block.
        config: Settings of the whole.
        visit: The visit.
        state: The Gaussians that are trained, as they are before it.
        around: Gaussians that take part with fixed values; None if there are none.
        seed: Seed of the whole training.
        photos: Folder that keeps reduced photos for the next visit (`TrainingImages`).
        options: Device, memory and the extent of the whole capture, as in `Reconstructor`.
    """

    # The arguments of a reconstruction, and what a visit starts from.
    def __init__(
        self,
        capture: Capture,
        config: ReconstructionConfig,
        visit: Visit,
        state: CellState,
        around: Surroundings | None,
        seed: int,
        *,
        photos: Path | None = None,
        **options: Any,
    ) -> None:
        self._visit, self._state, self._order_of_views = visit, state, visit.views(seed)
        # Gaussians are added and removed between the visits.
        config = replace(config, densify_every=_NEVER, densify_min_every=_NEVER, reset_opacities=False)
        own = visit_seed(seed, visit.number)
        super().__init__(capture, config, None, seed=own, **options)  # type: ignore[arg-type]
        self._photo_folder = photos
        if len(self._order_of_views) < WORTH_CACHING * len(set(self._order_of_views)):
            self._photo_bytes = 0
        self._around = None if around is None else around.to(self.device)
        self.steps_done = visit.start
        self.rate_factor = 1.0  # sets the learning rates of this step
        self._load_moments()

    def _initial_parameters(self, start: InitialPoints) -> dict[str, torch.nn.Parameter]:
        return {n: torch.nn.Parameter(t.to(self.device)) for n, t in self._state.parameters.items()}

    def _rates(self) -> dict[str, float]:
        calm = calm_factor(self.config, self.steps_done)
        return {name: calm * rate for name, rate in super()._rates().items()}

    def _new_optimizers(self) -> dict[str, torch.optim.Adam]:
        optimizers = super()._new_optimizers()
        for optimizer in optimizers.values():
            optimizer.param_groups[0]["betas"] = BETAS
        return optimizers

    def _load_moments(self) -> None:
        for name in self._parameters:
            if steps := adam_steps(self.config, name, self._visit.start):
                moments = {m: self._state.moments[f"{m}/{name}"].to(self.device) for m in MOMENTS}
                load_optimizer_tensors(
                    self._optimizers[name], {"step": torch.tensor(float(steps)), **moments}
                )
        self._density.load_state_tensors({**self._density.state_tensors(), **self._state.statistics})

    @property
    def total_steps(self) -> int:
        """Step at which the visit ends."""
        return self._visit.end

    def result(self) -> tuple[CellState, dict[str, Tensor]]:
        """The trained Gaussians, and the exposures of the photos, on the CPU."""
        tensors = {name: tensor.to("cpu") for name, tensor in self.state_dict().items()}
        parameters = {name: tensors[f"parameters/{name}"] for name in self._parameters}
        moments = {
            f"{m}/{name}": tensors.get(f"optimizers/{name}/{m}", torch.zeros_like(value))
            for m in MOMENTS
            for name, value in parameters.items()
        }
        statistics = {
            name: tensors.get(f"density/{name}", self._state.statistics[name]) for name in STATISTICS
        }
        exposures = {name: tensor for name, tensor in tensors.items() if name.startswith(EXPOSURES)}
        return CellState(parameters, moments, statistics), exposures

    def load_exposures(self, tensors: dict[str, Tensor]) -> None:
        """Continue with the exposures of the last visit of this block."""
        if self._exposures is not None and tensors:
            self._exposures.load_state_tensors(tensors)

    def _next_view(self) -> int:
        return self._names.index(self._order_of_views[self.steps_done - self._visit.start])

    def _render(self, gaussians: Gaussians, camera: Camera) -> Rendering:
        if self._around is not None:
            gaussians = joined([gaussians, self._around.in_image(camera)])
        return super()._render(gaussians, camera)

    def _control_density(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        count = len(self._parameters["means"])
        own: Any = SimpleNamespace(shape=(count, 2), grad=None)
        if means2d.grad is not None:
            own.grad = means2d.grad.view(-1, *means2d.shape[-2:])[..., :count, :]
        super()._control_density(own, radii[:count], image_size)


def calm_factor(config: ReconstructionConfig, step: int) -> float:
    """Factor of all learning rates at a step (`CALM`)."""
    start, last = CALM
    return float(last ** max(0.0, (step / config.iterations - start) / (1 - start)))


def adam_steps(config: ReconstructionConfig, name: str, step: int) -> int:
    """Steps of the optimizer of a parameter before ``step``; those of "shN" begin with the second degree."""
    if name != "shN":
        return step
    every = math.ceil(config.sh_degree_every * config.iterations / REFERENCE_ITERATIONS)
    return max(0, step - every) if config.sh_degree else 0


def visit_seed(*numbers: int) -> int:
    """A seed for a part of the training."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
