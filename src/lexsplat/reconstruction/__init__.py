"""Reconstruction (section 3.1): 3D Gaussians from photos with cameras, by gradient descent on the
photometric loss."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lexsplat.gaussians import Gaussians
from lexsplat.progress import Listener, silent
from lexsplat.reconstruction.settings import LONG_TRAINING, ReconstructionConfig
from lexsplat.reconstruction.trainer import EVENT_EVERY, STAGE, Reconstructor

if TYPE_CHECKING:
    import torch

    from lexsplat.checkpoints import Checkpoint
    from lexsplat.scenes import Scene

__all__ = [
    "EVENT_EVERY",
    "LONG_TRAINING",
    "STAGE",
    "ReconstructionConfig",
    "Reconstructor",
    "reconstruct",
]


def reconstruct(
    scene: Scene,
    config: ReconstructionConfig,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    cache_dir: Path | None = None,
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
        checkpoint: Where the training is saved on the way, and goes on from.
        listener: Hears an event of stage "reconstruct" every ten iterations, with "psnr" (recent training
            views) and "gaussians".

    Raises:
        TrainingError: If there is nothing to train on or the optimisation diverges.
        CaptureError: If a photo cannot be read.
    """
    from lexsplat.scenes.triangulation import initial_points

    points = initial_points(scene, seed=seed, cache_dir=cache_dir, listener=listener)
    trainer = Reconstructor(scene, config, points, device=device, seed=seed)
    if checkpoint is not None:
        checkpoint.resume(trainer)
    trainer.run(listener, checkpoint)
    return trainer.gaussians()
