"""Compilation of the kernels that draw Gaussians on a CPU, before the first drawing of a machine."""

from __future__ import annotations

import itertools
from contextlib import suppress

import numpy as np
import torch

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering.compositing import render
from lexsplat.runtime.progress import Event, Listener, silent, uncounted

STAGE = "kernels"
KERNELS = 9
"""Kernels that Python calls to draw colors and features."""


def compile_drawing(device: torch.device | str, listener: Listener = silent) -> None:
    """Compile the kernels that draw, unless a run has compiled them before.

    Args:
        device: Device of the Gaussians; nothing is compiled for others than the CPU.
        listener: Hears the import of the compiler as stage "rasterizer", and an event of stage "kernels" for each.
    """
    if torch.device(device).type != "cpu":
        return
    with uncounted(listener, "rasterizer"):
        from lexsplat.rendering.kernels import jit

    marker = jit.marker_of("drawing")
    if marker.exists() or jit.marker_of("training").exists():
        return
    done = itertools.count(1)
    listener(Event(STAGE, 0, KERNELS))
    with (
        jit.each_compiled(lambda: listener(Event(STAGE, min(next(done), KERNELS - 1), KERNELS))),
        torch.no_grad(),
    ):
        draw_a_little()
    listener(Event(STAGE, KERNELS, KERNELS))
    with suppress(OSError):  # the next run asks again
        marker.touch()


def draw_a_little() -> None:
    """Draw one Gaussian with a feature."""
    render(*small_scene(), features=torch.ones(1, 4))


def small_scene() -> tuple[Gaussians, Camera]:
    """One Gaussian with gradients, and a camera that sees it."""
    means, quats, scales, logits, sh0, shN = (
        torch.ones(*shape, requires_grad=True)
        for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3), (1, 3, 3))
    )
    gaussians = Gaussians(means, quats, scales, logits, sh0, shN)
    eye, center, up = np.array([1.0, 1.0, 9.0]), np.ones(3), np.array([0.0, 1.0, 0.0])
    return gaussians, look_at(eye, center, up, 16, 16, 1.0)
