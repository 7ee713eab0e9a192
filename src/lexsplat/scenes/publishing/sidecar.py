"""What a page needs beside the splats: the codes of each, and the cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from lexsplat.scenes.formats.language import StoredLanguage
from lexsplat.scenes.scene import Scene


def splat_codes(language: StoredLanguage) -> bytes:
    """Codes ``[N, 4]`` uint8 followed by shares ``[N, 4]`` uint8: eight bytes a Gaussian.

    The first share is the sum of the four weights in 255ths. The others are the weights of the second to fourth code
    in 255ths of the largest value that they can have: weights are sorted, so these are 1/2, 1/3 and 1/4. The weight
    of the first code is what remains. Scores differ by at most 0.55/255 from those of the exact weights.
    """
    weights = language.weights.double()
    largest = torch.tensor([1.0, 1 / 2, 1 / 3, 1 / 4], dtype=torch.float64)
    shares = torch.cat([weights.sum(1, keepdim=True), weights[:, 1:]], dim=1) / largest
    quantized = (shares * 255).round().clamp(0, 255).to(torch.uint8)
    return language.codes.numpy().tobytes() + quantized.numpy().tobytes()


def view_entries(scene: Scene) -> list[dict[str, Any]]:
    """The cameras of the views for the page, in the order of their names."""
    return [
        {
            "name": name,
            "width": view.camera.width,
            "height": view.camera.height,
            "focal": [round(float(view.camera.K[axis, axis]), 4) for axis in (0, 1)],
            "viewmat": [round(float(value), 6) for value in np.asarray(view.camera.viewmat).ravel()],
        }
        for name, view in sorted(scene.views.items())
    ]
