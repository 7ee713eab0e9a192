"""Compilation of a training's kernels in a process of its own, since a compiler keeps its memory until it ends."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress

import numpy as np
import torch

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import Gaussians


def compile_kernels(device: torch.device | str) -> None:
    """Compile the kernels of a training on the CPU that no run has compiled yet; the training loads them then.

    Where no other process can be started, the training compiles them itself.
    """
    if torch.device(device).type != "cpu":
        return
    from lexsplat.rendering.kernels import jit

    marker = jit.marker_of("training")
    if marker.exists():
        return
    jit.announce()
    with suppress(OSError, TypeError):  # a Python inside another program has no executable
        # In a folder of ours: Python looks for modules where it starts.
        done = subprocess.run([sys.executable, "-m", __name__], capture_output=True, cwd=marker.parent)
        if done.returncode == 0:
            marker.touch()


def _train_a_little() -> None:
    """One step of a training with features, and one of an average, on one Gaussian."""
    from lexsplat.reconstruction.image_losses import photometric_loss, ssim_target
    from lexsplat.rendering import prepare, render, weigh_cells

    means, quats, scales, logits, sh0, shN = (
        torch.ones(*shape, requires_grad=True)
        for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3), (1, 3, 3))
    )
    gaussians = Gaussians(means, quats, scales, logits, sh0, shN)
    center, up = np.ones(3), np.array([0.0, 1.0, 0.0])
    camera = look_at(np.array([1.0, 1.0, 9.0]), center, up, 16, 16, 1.0)
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


if __name__ == "__main__":
    _train_a_little()
