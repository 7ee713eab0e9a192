"""What a page needs beside the splats: the codes of each, pixels for thresholds, and the rule of presence."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lexsplat.queries.presence import CALIBRATION, REFERENCE_PHRASES
from lexsplat.queries.thresholds import THRESHOLD_VIEWS
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.formats.language import StoredLanguage
from lexsplat.scenes.scene import Scene

_SAMPLES = 1 << 14
_SAMPLE_CODES = 8
_LONG_SIDE = 320
"""Longer side in pixels of the renderings that thresholds come from, as in `lexsplat.queries.thresholds`."""


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


@torch.no_grad()
def threshold_samples(scene: Scene) -> bytes:
    """Pixels of training views as distributions over codes: codes ``[S, 8]`` and weights ``[S, 8]`` in 255ths.

    From them the page finds the automatic threshold of any prompt. The views are those of
    `lexsplat.queries.thresholds.scene_thresholds`; of their pixels, 2^14 are taken at even distances.
    """
    views = list(scene.views.values())
    cameras = [view.camera for view in views if view.split == "train"] or [view.camera for view in views]
    chosen = evenly(cameras, THRESHOLD_VIEWS)
    codes, weights = [], []
    for camera in chosen:
        small = camera.downscaled(max(1.0, max(camera.width, camera.height) / _LONG_SIDE))
        pixels = scene.field.render_code_probabilities(scene.gaussians, small).flatten(0, 1)
        index = torch.linspace(0, len(pixels) - 1, min(len(pixels), _SAMPLES // len(chosen))).long()
        best, where = pixels[index].topk(min(_SAMPLE_CODES, pixels.shape[1]), dim=1)
        pad = (0, _SAMPLE_CODES - best.shape[1])
        codes.append(torch.nn.functional.pad(where, pad).cpu())
        weights.append(torch.nn.functional.pad(best, pad).cpu())
    return _bytes(torch.cat(codes)) + _bytes((torch.cat(weights) * 255).round().clamp(0, 255))


def presence_rule(scene: Scene) -> dict[str, Any]:
    """The numbers of `lexsplat.queries.presence` with which the page decides what the scene holds."""
    classifier = scene.presence_classifier
    return {
        "weights": {name: getattr(CALIBRATION, name) for name in ("bias", "height", "rank", "peak")},
        "yes": CALIBRATION.yes,
        "no": CALIBRATION.no,
        "middle": classifier.middle,
        "spread": classifier.spread,
        "references": list(REFERENCE_PHRASES),
    }


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


def _bytes(values: Tensor) -> bytes:
    return values.to(torch.uint8).numpy().tobytes()
