"""Index maps as the training reads them: a code for each pixel, also from a map coarser than the image.

Cell j of w covers the pixels whose centres lie in [j W / w, (j + 1) W / w).
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from lexsplat.codebook import MAX_CODES

MASKED_CODE = MAX_CODES
"""Index of a pixel that takes no part in any loss: above those of every codebook."""


def codes_at_pixels(code_map: Tensor, height: int, width: int, pixels: Tensor) -> Tensor:
    """Codes of the cells in which the centres of pixels lie.

    Args:
        code_map: Index map ``[h, w]``.
        height: Of the image the pixels belong to.
        width: Of that image.
        pixels: Flat indices into it, row by row ``[M]``.

    Returns:
        Codes ``[M]`` int64.
    """
    rows, columns = code_map.shape
    # (p + 1/2) h / H in integers, so that no rounding moves a pixel to the neighbouring cell.
    row = (2 * (pixels // width) + 1) * rows // (2 * height)
    column = (2 * (pixels % width) + 1) * columns // (2 * width)
    return code_map[row, column].long()


def check_views(names: list[str], code_maps: Mapping[str, object]) -> None:
    """Raises ValueError if there is no view or one has no index map."""
    if not names:
        raise ValueError("no training view")
    missing = [name for name in names if name not in code_maps]
    if missing:
        raise ValueError(
            f"no index map for {', '.join(missing[:5])}{' and more' if len(missing) > 5 else ''}"
        )
