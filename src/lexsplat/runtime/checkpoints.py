"""Trainings that can be killed at any moment and go on, bit for bit, where they were.

A training that has a ``state_dict`` is saved between two steps, now and then; what is saved belongs to one
fingerprint of inputs and settings, so that it is never taken up by another training.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Protocol

import torch
from torch import Tensor

from lexsplat.runtime.errors import FileFormatError, TrainingError
from lexsplat.runtime.files import read_tensors, write_tensors

log = logging.getLogger("lexsplat")


class Trainer(Protocol):
    """A training whose whole state is named tensors."""

    def state_dict(self) -> dict[str, Tensor]:
        """Everything needed to go on."""
        ...

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        """Go on from there; raises ValueError if it does not fit."""
        ...


class Checkpoint:
    """The last good state of a training on disk.

    Args:
        path: The file.
        made_from: Fingerprint of everything the training depends on.
        every: Seconds between two savings; where saving is slow they lie further apart, so that it takes
            at most a twentieth of the time.
    """

    def __init__(self, path: Path, made_from: str, *, every: float = 20.0) -> None:
        self.path, self.made_from, self.every = Path(path), made_from, every
        self._saved_at = self._begun_at = time.perf_counter()
        self._pause = every
        self._stop_asked = False
        self.seconds_before = 0.0
        """What the training took before it was stopped, up to the state that it goes on from."""

    def resume(self, trainer: Trainer) -> bool:
        """Bring ``trainer`` to the saved state; returns whether there was one that fits."""
        if not self.path.is_file():
            return False
        start = trainer.state_dict()
        try:
            state, metadata = read_tensors(self.path)
            if metadata.get("made_from") != self.made_from:
                return False
            broken = not_finite(state)
            if broken:
                raise ValueError(f"NaN or infinity in {broken}")
            seconds = float(metadata.get("seconds", 0.0))
            if not 0 <= seconds < 1e9:
                raise ValueError(f"{seconds} seconds of training")
            trainer.load_state_dict(state)
        except (FileFormatError, ValueError, RuntimeError, KeyError, TypeError, IndexError) as error:
            log.warning("%s cannot be used, the training starts again: %s", self.path, error)
            trainer.load_state_dict(start)  # some of the damaged state may have been taken up already
            return False
        self.seconds_before = seconds
        return True

    def after_step(self, trainer: Trainer) -> None:
        """To be called between two steps: saves when it is time, or when the user wants to stop.

        Raises:
            KeyboardInterrupt: If Ctrl-C was pressed; the state is on disk then.
        """
        if self._stop_asked:
            self.save(trainer)
            raise KeyboardInterrupt
        if time.perf_counter() - self._saved_at >= self._pause:
            self.save(trainer)

    def save(self, trainer: Trainer) -> None:
        """Save the state now.

        Raises:
            TrainingError: If it holds a number that is not finite: the last good state stays.
        """
        start = time.perf_counter()
        state = trainer.state_dict()
        broken = not_finite(state)
        if broken:
            raise TrainingError(
                "training",
                expected="finite numbers",
                found=f"NaN or infinity in {broken}",
                remedy=f"lower the learning rates; the last good state is in {self.path}",
            )
        seconds = self.seconds_before + start - self._begun_at
        write_tensors(self.path, state, {"made_from": self.made_from, "seconds": repr(seconds)})
        self._saved_at = time.perf_counter()
        self._pause = max(self.every, 20 * (self._saved_at - start))

    def remove(self) -> None:
        """Forget the state: the training is finished."""
        self.path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def guarding(self) -> Iterator[Checkpoint]:
        """Within the block, the loop of a training, Ctrl-C waits for `after_step`; pressed again it stops at once."""
        if threading.current_thread() is not threading.main_thread():
            yield self  # only the main thread is told of signals
            return

        def ask(number: int, frame: FrameType | None) -> None:
            if self._stop_asked:
                raise KeyboardInterrupt
            self._stop_asked = True

        before = signal.signal(signal.SIGINT, ask)
        try:
            yield self
        finally:
            signal.signal(signal.SIGINT, before)


def not_finite(state: Mapping[str, Tensor]) -> str:
    """Name of the first parameter that holds NaN or infinity, or nothing. Running means may still be unset."""
    for name, tensor in state.items():
        is_parameter = any(part in name for part in ("parameters/", "field.", "exposures/"))
        if is_parameter and tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            return name
    return ""
