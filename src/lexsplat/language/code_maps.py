"""Index maps as training reads them: a code for every pixel of a view, even if the map is coarser than the view.

Cell j of w covers the pixels whose centers lie in [j W / w, (j + 1) W / w).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.captures.capture import View
from lexsplat.codebook import MAX_CODES
from lexsplat.rendering.back_projection import cell_of

MASKED_CODE = MAX_CODES
"""Index of a pixel that no loss uses; it is above the codes of every codebook."""


def codes_at_pixels(code_map: Tensor, height: int, width: int, pixels: Tensor) -> Tensor:
    """Codes of the cells that contain the centers of the given pixels.

    Args:
        code_map: Index map ``[h, w]``.
        height: Height of the image that the pixels belong to.
        width: Width of that image.
        pixels: Row-major indices into it ``[M]``.

    Returns:
        Codes ``[M]`` int64.
    """
    rows, columns = code_map.shape
    row, column = cell_of(pixels // width, height, rows), cell_of(pixels % width, width, columns)
    return code_map[row, column].long()


def check_views(names: list[str], code_maps: Mapping[str, object]) -> None:
    """Refuse training views without index maps or feature maps.

    Raises:
        ValueError: If there is no view, or a view has no map.
    """
    if not names:
        raise ValueError("no training view")
    missing = [name for name in names if name not in code_maps]
    if missing:
        raise ValueError(
            f"no index map for {', '.join(missing[:5])}{' and more' if len(missing) > 5 else ''}"
        )


class MaskedCodeMaps(Mapping[str, Any]):
    """Index maps of training views in which masked pixels have the code `MASKED_CODE`.

    Maps of views without a mask are returned unchanged, ``[h, w]`` uint8. Maps of masked views have the size of the
    view's camera, ``[H, W]`` int16; they are computed on each access from a mask of one bit a pixel.

    Args:
        code_maps: Index maps by view name.
        views: Views by name, with their masks.

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
        at = codes_at_pixels(torch.from_numpy(codes), height, width, torch.arange(height * width))
        return np.where(valid, at.view(height, width).numpy(), MASKED_CODE).astype(np.int16)

    def __iter__(self) -> Iterator[str]:
        return iter(self._code_maps)

    def __len__(self) -> int:
        return len(self._code_maps)


def mark_masked_cells(code_map: NDArray[np.uint8], view: View, num_codes: int) -> NDArray[np.uint8]:
    """An index map ``[h, w]`` as it is stored: fully masked cells hold 255, unless 255 is a code."""
    share = view.valid_share((code_map.shape[1], code_map.shape[0]))
    if share is None or num_codes >= MAX_CODES:
        return code_map
    return np.where(share > 0, code_map, np.uint8(255)).astype(np.uint8)
