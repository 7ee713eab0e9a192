"""What masked pixels leave of features and index maps: nothing that is learned depends on them.

A pixel that is black in ``masks/`` is filled with the photo's mean colour before anything looks at the photo
(`lexsplat.scenes.View.load_image`). Here its cell gives no feature to the codebook and its pixel no code to the
language: the code map of a masked view is handed out at full resolution with `MASKED_CODE` where pixels do not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.codebook import MAX_CODES
from lexsplat.embedding import MASKED_CODE
from lexsplat.features import FeatureMap, FeatureMaps
from lexsplat.scenes import Scene, View


def without_masked_cells(maps: FeatureMaps, scene: Scene) -> FeatureMaps:
    """Feature maps whose cells without any pixel that counts are zero, which the codebook passes over.

    Args:
        maps: Maps by view name.
        scene: The views.
    """
    if all(scene.views[name].ignore_path is None for name in maps if name in scene.views):
        return maps

    def load(name: str) -> FeatureMap:
        found = maps[name]
        height, width = found.clip.shape[:2]
        share = scene.views[name].valid_share((width, height))
        if share is None:
            return found
        counts = torch.from_numpy(share > 0)[..., None].to(found.clip.device)
        return FeatureMap(found.clip * counts, None if found.dino is None else found.dino * counts)

    return FeatureMaps(list(maps), load, 0, source=maps)


class MaskedCodeMaps(Mapping[str, Any]):
    """Index maps of training views in which masked pixels have the code `MASKED_CODE`.

    Maps of views without a mask are handed out as they are, ``[h, w]`` uint8; those of masked views at the size of
    the view's camera, ``[H, W]`` int16, made at every call from a bit a pixel.

    Args:
        code_maps: Index maps by view name.
        views: The views, with their masks.

    Raises:
        CaptureError: If a mask cannot be read.
    """

    def __init__(self, code_maps: Mapping[str, NDArray[np.uint8]], views: Mapping[str, View]) -> None:
        self._code_maps = code_maps
        self._bits: dict[str, tuple[NDArray[np.uint8], tuple[int, int]]] = {}
        for name in code_maps:
            valid = views[name].load_valid() if name in views else None
            if valid is not None and not valid.all():
                self._bits[name] = (np.packbits(valid), (valid.shape[0], valid.shape[1]))

    def __getitem__(self, name: str) -> NDArray[np.integer]:
        codes = self._code_maps[name]
        if name not in self._bits:
            return codes
        bits, (height, width) = self._bits[name]
        valid = np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)
        # The cell in which a pixel's centre lies, in integers so that none is moved by rounding.
        rows = (2 * np.arange(height) + 1) * codes.shape[0] // (2 * height)
        columns = (2 * np.arange(width) + 1) * codes.shape[1] // (2 * width)
        return np.where(valid, codes[rows[:, None], columns].astype(np.int16), np.int16(MASKED_CODE))

    def __iter__(self) -> Iterator[str]:
        return iter(self._code_maps)

    def __len__(self) -> int:
        return len(self._code_maps)


def mark_masked_cells(code_map: NDArray[np.uint8], view: View, num_codes: int) -> NDArray[np.uint8]:
    """An index map ``[h, w]`` as it is stored: cells without any pixel that counts hold 255 where that is no code."""
    share = view.valid_share((code_map.shape[1], code_map.shape[0]))
    if share is None or num_codes >= MAX_CODES:
        return code_map
    return np.where(share > 0, code_map, np.uint8(255)).astype(np.uint8)
