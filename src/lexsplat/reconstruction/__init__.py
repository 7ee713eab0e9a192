"""Reconstruction (section 3.1): 3D Gaussians from photos with cameras, by gradient descent on the
photometric loss."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction.settings import LONG_TRAINING, ReconstructionConfig
from lexsplat.reconstruction.trainer import EVENT_EVERY, STAGE, Reconstructor
from lexsplat.runtime import memory as budget
from lexsplat.runtime.progress import Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.runtime.checkpoints import Checkpoint

__all__ = [
    "EVENT_EVERY",
    "LONG_TRAINING",
    "STAGE",
    "ReconstructionConfig",
    "Reconstructor",
    "check_gaussians",
    "reconstruct",
]


def reconstruct(
    scene: Capture,
    config: ReconstructionConfig,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    cache_dir: Path | None = None,
    memory: int = budget.DEFAULT_MEMORY,
    checkpoint: Checkpoint | None = None,
    listener: Listener = silent,
) -> Gaussians:
    """Train Gaussians on the training views of a scene.

    Args:
        scene: Views, split, and the points to start from; where it has none they are triangulated.
        config: Settings.
        device: Where to train.
        seed: Of the order of views, of density control and of what replaces missing points.
        cache_dir: Where triangulated points are kept for the next call; None keeps nothing.
        memory: Bytes of host memory that the triangulation, and then the Gaussians, may take.
        checkpoint: Where the training is saved on the way, and goes on from.
        listener: Hears an event of stage "reconstruct" every ten iterations, with "psnr" (recent training
            views) and "gaussians".

    Raises:
        TrainingError: If there is nothing to train on or the optimization diverges.
        CaptureError: If a photo cannot be read.
        MemoryBudgetError: If the Gaussians, or the photos while they are triangulated, do not fit into ``memory``.
    """
    from lexsplat.captures.sfm.triangulation import initial_points

    check_gaussians(config, device, memory)
    points = initial_points(scene, seed=seed, cache_dir=cache_dir, memory=memory, listener=listener)
    trainer = Reconstructor(scene, config, points, device=device, seed=seed, memory=memory)
    if checkpoint is not None:
        checkpoint.resume(trainer)
    trainer.run(listener, checkpoint)
    return trainer.gaussians()


def check_gaussians(config: ReconstructionConfig, device: torch.device | str, memory: int) -> None:
    """Refuse to train more Gaussians on the host than half of the budget holds: the rest is for photos.

    Raises:
        MemoryBudgetError: With the number that it holds.
    """
    cap = config.cap(torch.device(device))
    if torch.device(device).type != "cpu":
        return
    room = memory // 2 // budget.GAUSSIAN_BYTES
    need = 2 * budget.gaussian_bytes(cap)
    what, remedy = f"{cap:,} Gaussians beside the photos", f"reconstruction.max-gaussians {room}"
    budget.require("reconstruct", need, memory, what, remedy)
