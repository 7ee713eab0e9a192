"""Image quality on the held-out views of a capture."""

from __future__ import annotations

import numpy as np
import torch

from lexsplat.evaluation.metrics import psnr
from lexsplat.rendering import render


@torch.no_grad()
def held_out_psnr(trainer, capture) -> float:
    """Mean PSNR in dB of a `Reconstructor` over the held-out views."""
    gaussians = trainer.gaussians()
    scores = []
    for view in capture.test_views:
        image = render(gaussians, view.camera).image.clamp(0, 1).cpu().numpy()
        scores.append(psnr(image, view.load_image()))
    return float(np.mean(scores))
