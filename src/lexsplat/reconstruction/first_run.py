"""Compilation of a training's kernels in a process of its own, since a compiler keeps its memory until it ends."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch

from lexsplat.rendering.first_drawing import STAGE, small_scene
from lexsplat.runtime.progress import Event, Listener, silent

KERNELS = 21
"""Kernels that a training calls. Each takes about a second with those that it calls itself."""


def compile_kernels(device: torch.device | str, listener: Listener = silent) -> None:
    """Compile the kernels of a training on the CPU that no run has compiled yet; the training loads them then.

    Where the other process cannot be started or fails, this one compiles them.

    Args:
        device: Device of the training.
        listener: Hears an event of stage "kernels" for each.
    """
    if torch.device(device).type != "cpu":
        return
    from lexsplat.rendering.kernels import jit

    marker = jit.marker_of("training")
    if marker.exists():
        return
    jit.announce()
    done = itertools.count(1)

    def count() -> None:
        listener(Event(STAGE, min(next(done), KERNELS - 1), KERNELS))

    listener(Event(STAGE, 0, KERNELS))
    if not _compiled_elsewhere(marker.parent, count):
        with jit.each_compiled(count):
            _train_a_little()
    with suppress(OSError):  # the next training asks again
        marker.touch()
    listener(Event(STAGE, KERNELS, KERNELS))


def _compiled_elsewhere(folder: Path, count: Callable[[], None]) -> bool:
    """Whether another process has compiled the kernels; it writes a line after each, which is counted."""
    # In a folder of ours: Python looks for modules where it starts.
    command = [sys.executable, "-m", __name__]
    try:
        started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder)
    except (OSError, TypeError):  # a Python inside another program has no executable
        return False
    with started as process:
        try:
            for _ in process.stdout or ():
                count()
        except BaseException:  # such as Ctrl-C, which need not reach the other process
            process.kill()
            raise
    return process.returncode == 0


def _train_a_little() -> None:
    """One step of a training with features, and one of an average, on one Gaussian."""
    from lexsplat.reconstruction.image_losses import photometric_loss, ssim_target
    from lexsplat.rendering import prepare, render, weigh_cells

    gaussians, camera = small_scene()
    features = torch.ones(1, 4, requires_grad=True)
    photo = ssim_target(torch.zeros(16, 16, 3))
    for channels in (None, features):
        rendering = render(gaussians, camera, features=channels)
        (photometric_loss(rendering.image, photo) + rendering.channels.sum()).backward()
    with torch.no_grad():
        prepared = prepare(gaussians, camera)
        weights = weigh_cells(gaussians, camera, (2, 2), torch.ones(16, 16), prepared)
        weights.add_to(torch.zeros(1, 4), torch.ones(4, 4))
        weights.totals()


def _main() -> None:
    from lexsplat.rendering.kernels import jit

    with jit.each_compiled(lambda: print(flush=True)):
        _train_a_little()


if __name__ == "__main__":
    _main()
