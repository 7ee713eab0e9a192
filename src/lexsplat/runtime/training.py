"""The training loop: it reports progress, resumes after a kill, and recovers from divergence.

`run_training` runs reconstruction, language and joint training. A `Checkpoint` keeps the state on disk, so that a
training killed at any moment continues bit for bit. A `DivergenceGuard` keeps a good state in memory, to which a
training returns with smaller learning rates when a loss or a parameter becomes invalid.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Protocol

import torch
from torch import Tensor

from lexsplat.runtime.errors import FileFormatError, TrainingError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.progress import Event, Listener, silent

log = logging.getLogger("lexsplat")

ATTEMPTS = 6
"""Number of times a training may go back; the last attempt runs at 1/64 of the learning rates."""

KEEP_EVERY = {"cpu": 100, "cuda": 1000}
"""Steps between two copies of the state. Copying from a GPU is slower, and repeating GPU steps is cheaper."""


class Training(Protocol):
    """A training that can be stepped, and whose whole state is named tensors."""

    parameter_prefixes: tuple[str, ...]
    """Prefixes of the entries of `state_dict` that must be finite; running means, for example, may be unset."""
    rate_factor: float
    """Factor of all learning rates; part of the state."""

    @property
    def device(self) -> torch.device:
        """Where the training runs."""

    @property
    def steps_done(self) -> int:
        """Number of finished steps."""

    @property
    def total_steps(self) -> int:
        """Number of steps of the whole training."""

    @property
    def metrics(self) -> Mapping[str, float]:
        """Numbers to show with the progress; read only when an event is sent."""

    def step(self) -> Any:
        """Run one step.

        Raises:
            TrainingError: If the training has diverged.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of everything needed to continue."""

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        """Continue from a state.

        Raises:
            ValueError: If the state does not fit.
        """

    def find_invalid(self) -> str:
        """The first defect of the parameters, such as "NaN or Inf in means"; empty if there is none."""


def run_training(
    training: Training,
    *,
    stage: str,
    name: str,
    every: int,
    checkpoint: Checkpoint | None = None,
    listener: Listener = silent,
) -> None:
    """Run the remaining steps of a training.

    Args:
        training: The training; it resumes from ``checkpoint`` if that holds a matching state.
        stage: Stage name in events.
        name: Name of the training in warnings and errors.
        every: Steps between two events; the last step always sends one.
        checkpoint: Checkpoint of the state between steps; None saves nothing.
        listener: Receives progress events.

    Raises:
        TrainingError: If the training diverges more than `ATTEMPTS` times.
        KeyboardInterrupt: If Ctrl-C was pressed; the state is on disk if there is a checkpoint.
    """
    if checkpoint is not None:
        checkpoint.resume(training)
    total = training.total_steps
    listener(Event(stage, training.steps_done, total))
    guard = DivergenceGuard(training, name, every=KEEP_EVERY[training.device.type])
    with contextlib.nullcontext() if checkpoint is None else checkpoint.deferring_interrupts():
        while training.steps_done < total:
            with guard:
                training.step()
                guard.after_step(finished=training.steps_done == total)
                if checkpoint is not None:
                    checkpoint.after_step(training)
            done = training.steps_done
            if done % every == 0 or done == total:
                listener(Event(stage, done, total, training.metrics))


def time_steps(training: Training, untimed: int, steps: int, listener: Callable[[int], None]) -> float:
    """Seconds of one step of a training, which is lost afterwards.

    Args:
        training: The training.
        untimed: Steps before: they read photos and load kernels.
        steps: Steps that are timed together.
        listener: Receives the number of steps done: after each untimed step, and at the end.
    """
    for done in range(1, untimed + 1):
        training.step()
        listener(done)
    _finish(training.device)
    start = time.perf_counter()
    for _ in range(steps):
        training.step()
    _finish(training.device)
    seconds = time.perf_counter() - start
    listener(untimed + steps)
    return seconds / steps


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Checkpoint:
    """The last good state of a training on disk.

    Args:
        path: The file.
        fingerprint: Hash of everything the training depends on; a state with another one is ignored.
        every: Seconds between two saves. The interval grows where saving is slow, so that saving takes at most a
            twentieth of the time.
    """

    def __init__(self, path: Path, fingerprint: str, *, every: float = 20.0) -> None:
        self.path, self.fingerprint, self.every = Path(path), fingerprint, every
        self._saved_at = self._started_at = time.perf_counter()
        self._pause = every
        self._interrupted = False
        self.seconds_before = 0.0
        """Training time of earlier runs up to the resumed state, in seconds."""

    def resume(self, training: Training) -> bool:
        """Load the saved state into ``training``; returns whether there was a matching one."""
        if not self.path.is_file():
            return False
        start = training.state_dict()
        try:
            state, metadata = read_tensors(self.path)
            if metadata.get("fingerprint") != self.fingerprint:
                return False
            if invalid := _find_not_finite(state, training.parameter_prefixes):
                raise ValueError(f"NaN or infinity in {invalid}")
            seconds = float(metadata.get("seconds", 0.0))
            if not 0 <= seconds < 1e9:
                raise ValueError(f"{seconds} seconds of training")
            training.load_state_dict(state)
        except (FileFormatError, ValueError, RuntimeError, KeyError, TypeError, IndexError) as error:
            log.warning("%s is unusable, the training restarts from the beginning: %s", self.path, error)
            training.load_state_dict(start)  # part of the damaged state may already be loaded
            return False
        self.seconds_before = seconds
        return True

    def after_step(self, training: Training) -> None:
        """Save the state if it is time, or if Ctrl-C was pressed; call this between two steps.

        Raises:
            KeyboardInterrupt: If Ctrl-C was pressed; the state is on disk then.
        """
        if self._interrupted:
            self.save(training)
            self._interrupted = False
            raise KeyboardInterrupt
        if time.perf_counter() - self._saved_at >= self._pause:
            self.save(training)

    def save(self, training: Training) -> None:
        """Save the state immediately.

        Raises:
            TrainingError: If a parameter is not finite; the file keeps the last good state.
        """
        start = time.perf_counter()
        state = training.state_dict()
        if invalid := _find_not_finite(state, training.parameter_prefixes):
            raise TrainingError(
                "training",
                expected="finite numbers",
                found=f"NaN or infinity in {invalid}",
                remedy=f"lower the learning rates; the last good state is in {self.path}",
            )
        seconds = self.seconds_before + start - self._started_at
        write_tensors(self.path, state, {"fingerprint": self.fingerprint, "seconds": repr(seconds)})
        self._saved_at = time.perf_counter()
        self._pause = max(self.every, 20 * (self._saved_at - start))

    def remove(self) -> None:
        """Delete the file, after the training is finished."""
        self.path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def deferring_interrupts(self) -> Iterator[None]:
        """Defer the first Ctrl-C inside the block to `after_step`, or to the end; the second one acts immediately.

        Raises:
            KeyboardInterrupt: At the end of the block, if Ctrl-C was pressed after the last `after_step`.
        """
        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread receives signals
            return

        def defer(number: int, frame: FrameType | None) -> None:
            self._interrupted = not self._interrupted
            if not self._interrupted:
                raise KeyboardInterrupt

        before = signal.signal(signal.SIGINT, defer)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)
        if self._interrupted:
            raise KeyboardInterrupt


class DivergenceGuard:
    """The last good state of a training in memory, and the way back to it.

    As a context manager around one step, it catches a `TrainingError`, restores the state, halves the learning
    rates, and logs one line. A healthy training is not affected.

    Args:
        training: The training, in a good state.
        name: Name of the training in messages.
        every: Steps between two copies of the state.

    Raises:
        TrainingError: From the block, if the training diverged more than `ATTEMPTS` times.
    """

    def __init__(self, training: Training, name: str, *, every: int = 100) -> None:
        self._training, self._name, self._every, self._left = training, name, every, ATTEMPTS
        self._steps = self._kept_at = 0
        self._good = _on_host(training.state_dict())

    def after_step(self, finished: bool = False) -> None:
        """Check and copy the state every few steps; call this after each step, before the state is saved.

        Args:
            finished: Whether this was the last step, after which the state is always checked.

        Raises:
            TrainingError: If a parameter is invalid.
        """
        self._steps += 1
        if not finished and self._steps - self._kept_at < self._every:
            return
        if invalid := self._training.find_invalid():
            raise TrainingError(
                self._name, expected="finite numbers", found=invalid, remedy="lower the learning rates"
            )
        self._keep()

    def __enter__(self) -> DivergenceGuard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, TrainingError) or self._left == 0:
            return False
        self._left -= 1
        lost = self._steps + 1 - self._kept_at
        self._training.load_state_dict(self._good)
        if self._training.find_invalid():  # invalid from the start: there is no good state
            return False
        self._training.rate_factor /= 2
        self._keep()  # diverging again from here halves the rates again
        log.warning(
            "%s diverged (%s): restored the state %d steps back; learning rates are now %g times the configured ones",
            self._name,
            error.found or error,
            lost,
            self._training.rate_factor,
        )
        return True

    def _keep(self) -> None:
        self._good = _on_host(self._training.state_dict())
        self._kept_at = self._steps


def _on_host(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.cpu() for name, tensor in state.items()}


def _find_not_finite(state: Mapping[str, Tensor], prefixes: tuple[str, ...]) -> str:
    """Name of the first tensor below one of ``prefixes`` that holds NaN or infinity; empty if there is none."""
    floats = (
        name for name, tensor in state.items() if name.startswith(prefixes) and tensor.is_floating_point()
    )
    return next((name for name in floats if not bool(torch.isfinite(state[name]).all())), "")
