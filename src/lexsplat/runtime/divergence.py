"""Trainings that diverge go back to their last good state and on with smaller steps; healthy ones notice nothing.

A training has diverged when a loss or a parameter is no longer finite, when nothing is left of the scene, or when
what it shows is much worse than showing nothing. All this reaches a `Guard` as `TrainingError`, raised between two
steps. The guard holds a copy of the state (parameters, moments, random numbers) from a moment at which all was well.
"""

from __future__ import annotations

import logging
from types import TracebackType
from typing import Protocol

from torch import Tensor

from lexsplat.runtime.errors import TrainingError

log = logging.getLogger("lexsplat")

ATTEMPTS = 6
"""How often a training may go back: the last attempt runs with a sixty-fourth of the learning rates."""

KEEP_EVERY = {"cpu": 100, "cuda": 1000}
"""Steps between two copies of the state; copying from a GPU takes longer and loses less time when it is needed."""


class Guarded(Protocol):
    """A training that can be watched."""

    rate_factor: float
    """Factor of all learning rates; part of the state."""

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of everything needed to go on."""
        ...

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        """Go on from there."""
        ...

    def damage(self) -> str:
        """What is wrong with the parameters, such as "NaN or Inf in means"; nothing where all is well."""
        ...


class Guard:
    """The last good state of a training, and the way back to it.

    As a context manager it goes around one step: a `TrainingError` inside takes the training back and is told in one
    line; when there were too many it goes on to the caller.

    Args:
        trainer: The training, at a good state.
        name: What to call it.
        every: Steps between two copies of the state.
        attempts: How often to go back before giving up.

    Raises:
        TrainingError: From the block, when the training has diverged more often than ``attempts``.
    """

    def __init__(self, trainer: Guarded, name: str, *, every: int = 100, attempts: int = ATTEMPTS) -> None:
        self._trainer, self._name, self._every, self._left = trainer, name, every, attempts
        self._steps = self._kept_at = 0
        self._good = _on_host(trainer.state_dict())

    def after_step(self, finished: bool = False) -> None:
        """To be called after each step, before anything is saved: keeps the state now and then.

        Args:
            finished: Whether this was the last step: what comes out of a training is always looked at.

        Raises:
            TrainingError: If a parameter is not finite, or absurd.
        """
        self._steps += 1
        if not finished and self._steps - self._kept_at < self._every:
            return
        damage = self._trainer.damage()
        if damage:
            raise TrainingError(
                self._name, expected="finite numbers", found=damage, remedy="lower the learning rates"
            )
        self._keep()

    def __enter__(self) -> Guard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, TrainingError) or self._left == 0:
            return False
        self._left -= 1
        lost = self._steps + 1 - self._kept_at
        self._trainer.load_state_dict(self._good)
        if self._trainer.damage():  # it was broken when it came: there is nothing to go back to
            return False
        self._trainer.rate_factor /= 2
        self._keep()  # diverging again from here halves the rates again
        log.warning(
            "%s diverged (%s): back by %d steps to the last good state, learning rates halved to %g of the settings",
            self._name,
            error.found or error,
            lost,
            self._trainer.rate_factor,
        )
        return True

    def _keep(self) -> None:
        self._good = _on_host(self._trainer.state_dict())
        self._kept_at = self._steps


def _on_host(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.cpu() for name, tensor in state.items()}
