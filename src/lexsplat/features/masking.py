"""Masking of feature maps: cells that are masked entirely are zero.

Encoders see masked pixels in the photo's mean color (`lexsplat.captures.View.load_image`).
"""

from __future__ import annotations

import torch

from lexsplat.captures import Capture
from lexsplat.features.cache import FeatureMap, FeatureMaps


def without_masked_cells(maps: FeatureMaps, capture: Capture) -> FeatureMaps:
    """Feature maps in which cells without an unmasked pixel are zero; the codebook skips zero cells.

    Args:
        maps: Maps by view name.
        capture: The views.
    """
    if all(capture.views[name].ignore_path is None for name in maps if name in capture.views):
        return maps

    def load(name: str) -> FeatureMap:
        found = maps[name]
        height, width = found.clip.shape[:2]
        share = capture.views[name].valid_share((width, height))
        if share is None:
            return found
        counts = torch.from_numpy(share > 0)[..., None].to(found.clip.device)
        return FeatureMap(found.clip * counts, None if found.dino is None else found.dino * counts)

    return FeatureMaps(list(maps), load, 0, source=maps)
