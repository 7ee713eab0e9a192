"""Reconstruction (section 3.1): 3D Gaussians from photos with cameras, trained on the photometric loss."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction.few_photos import has_few_photos, starting_points, warn_of_few_photos
from lexsplat.reconstruction.first_run import compile_kernels
from lexsplat.reconstruction.forecasting import tell_time
from lexsplat.reconstruction.settings import LONG_TRAINING, ReconstructionConfig
from lexsplat.reconstruction.trainer import EVENT_EVERY, STAGE, Reconstructor
from lexsplat.runtime import memory as budget
from lexsplat.runtime.progress import Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.runtime.training import Checkpoint

__all__ = [
    "EVENT_EVERY",
    "LONG_TRAINING",
    "STAGE",
    "ReconstructionConfig",
    "Reconstructor",
    "check_gaussians",
    "compile_kernels",
    "reconstruct",
    "tell_time",
]


# Eight parameters: two inputs, and the options that every stage takes.
def reconstruct(
    capture: Capture,
    config: ReconstructionConfig,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    cache_dir: Path | None = None,
    memory: int = budget.DEFAULT_MEMORY,
    checkpoint: Checkpoint | None = None,
    listener: Listener = silent,
) -> Gaussians:
    """Train Gaussians on the training views of a capture.

    Args:
        capture: Views, split, and initial points; missing points are triangulated, and few photos get more points.
        config: Settings.
        device: Device of the training.
        seed: Seed of the view order, of density control and of the points that replace missing ones.
        cache_dir: Folder where triangulated points are kept for the next call; None keeps nothing.
        memory: Budget of host memory in bytes, for the triangulation and then for Gaussians and photos.
        checkpoint: Checkpoint to save to on the way and to resume from.
        listener: Receives an event of stage "reconstruct" every ten iterations, with "psnr" (recent training
            views, dB) and "gaussians" (their number); before, events of the stages "triangulate", "matching",
            "kernels" and "calibrate", where there is such work.

    Raises:
        TrainingError: If there is nothing to train on, or the training diverges.
        CaptureError: If a photo cannot be read.
        MemoryBudgetError: If the Gaussians, or the photos during triangulation, do not fit into ``memory``.
    """
    check_gaussians(config, device, memory)
    points = starting_points(capture, seed=seed, cache_dir=cache_dir, memory=memory, listener=listener)
    compile_kernels(device, listener)
    tell_time(capture, config, points, device=device, memory=memory, listener=listener)
    trainer = Reconstructor(capture, config, points, device=device, seed=seed, memory=memory)
    trainer.run(listener, checkpoint)
    if has_few_photos(capture):
        warn_of_few_photos(capture, trainer.gaussians())
    return trainer.gaussians()


def check_gaussians(config: ReconstructionConfig, device: torch.device | str, memory: int) -> None:
    """Refuse a cap on the Gaussians that needs more than half of the host memory; the other half is for photos.

    Raises:
        MemoryBudgetError: With the number of Gaussians that fits.
    """
    device = torch.device(device)
    if device.type != "cpu":
        return
    cap = config.cap(device)
    room = memory // 2 // budget.GAUSSIAN_BYTES
    need = 2 * cap * budget.GAUSSIAN_BYTES
    what, remedy = f"{cap:,} Gaussians in addition to the photos", f"reconstruction.max-gaussians {room}"
    budget.require("reconstruct", need, memory, what, remedy)
