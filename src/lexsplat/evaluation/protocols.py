"""Other people's protocols, by name, to be comparable with numbers made by them.

- **official**: the authors' released evaluation of LEGaussians, quirks included (`official_scores`).
- **lerf-2d**: LangSplat's evaluation on LERF-OVS: localization by the peak of a blurred map, IoU of a mask cut
  from the map stretched to its own range (`lerf_2d_scores`).
- **lerf-3d**: Gaussians are selected in 3D, then rendered alone (OpenGaussian's evaluation on LERF-OVS); the two
  LERF-OVS protocols cannot be compared (`silhouette_iou`).

The strict protocol, which is ours, stands in `lexsplat.evaluation.metrics`. Arrays in, numbers out, never a disk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import ndimage

PROTOCOLS = ("strict", "official", "lerf-2d", "lerf-3d")
"""Names of the protocols."""

LERF_2D_THRESHOLD = 0.4
"""LangSplat's cut through a map stretched to -1..1."""

LERF_2D_WINDOW = 30
"""Side in pixels of LangSplat's blur."""

SILHOUETTE_ALPHA = 0.7
"""Opacity beyond which a pixel belongs to the silhouette of selected Gaussians (OpenGaussian)."""

_EPSILON = np.float32(1e-6)


# Official


@dataclass(frozen=True)
class OfficialScores:
    """Numbers of one image and prompt under the official protocol: float32 as in the code, the AP float64."""

    iou: float
    accuracy: float
    precision: float
    average_precision: float


def official_truth(mask: ArrayLike, width: int, height: int) -> NDArray[np.float32]:
    """A mask resized by a bicubic filter and not made binary again: ``[H, W]`` in 0..1, edges soft."""
    picture = Image.fromarray(np.asarray(mask, dtype=bool).astype(np.uint8) * 255)
    if picture.size != (width, height):
        picture = picture.resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(picture, dtype=np.float32) / np.float32(255)


def official_scores(relevancy: ArrayLike, mask: ArrayLike, threshold: float = 0.5) -> OfficialScores:
    """The authors' evaluation of one map, quirks included, in float32 as they compute it.

    - Truth is resized to the map (`official_truth`) and keeps soft edges. Logic takes every number that is not 0
      for true, so a soft pixel belongs to the object, and 1 - soft to the background as well: a soft pixel that
      is predicted counts as a true *and* as a false positive.
    - The accuracy compares floats, so soft pixels are wrong whatever is predicted.
    - The mask is relevancy >= threshold. IoU is I / (U + 1e-6), precision TP / (TP + FP + 1e-6); empty gives 0.
    - Average precision: thresholds 0, 0.01, ..., 1 with >, recall TP / (TP + FN + 1e-6), the best precision at each
      of 101 recalls or beyond, divided by **100**: 1.01 at most.

    Where the result depends on the version of numpy (float32 recalls meet float64 levels, float32 precisions a
    Python sum), it is that of 1.24, which the authors pin: compared in float32, added up in float64.

    Args:
        relevancy: ``[H, W]`` in 0..1, at the size of the rendered image.
        mask: Boolean ground truth at its own size.
        threshold: For everything but the average precision.
    """
    values = np.asarray(relevancy, dtype=np.float32)
    ground_truth = official_truth(mask, values.shape[1], values.shape[0])
    predicted = values >= np.float32(threshold)
    thing, ground = ground_truth != 0, ground_truth != 1
    hits, alarms = _count(predicted & thing), _count(predicted & ground)
    return OfficialScores(
        iou=float(hits / (_count(predicted | thing) + _EPSILON)),
        accuracy=float(_count(predicted.astype(np.float32) == ground_truth) / np.float32(ground_truth.size)),
        precision=float(hits / (hits + alarms + _EPSILON)),
        average_precision=_official_average_precision(values, thing, ground),
    )


def _count(mask: NDArray[np.bool_]) -> np.float32:
    return np.float32(np.count_nonzero(mask))


def _official_average_precision(
    values: NDArray[np.float32], thing: NDArray[np.bool_], ground: NDArray[np.bool_]
) -> float:
    levels = np.arange(0.0, 1.01, 0.01).astype(np.float32)
    # Pixel v is found by thresholds below v: the first `n` of them, with n = how many levels are < v.
    found_by = np.searchsorted(levels, values, side="left")
    hits, alarms = (
        np.bincount(found_by[side], minlength=102)[::-1].cumsum()[::-1][1:].astype(np.float32)
        for side in (thing, ground)
    )
    misses = _count(thing) - hits
    precisions, recalls = hits / (hits + alarms + _EPSILON), hits / (hits + misses + _EPSILON)
    best = np.append(np.float32(0), np.maximum.accumulate(precisions))
    reached = len(recalls) - np.searchsorted(recalls[::-1], levels, side="left")
    # A running sum, one after the other, as the authors' loop adds them: in float64, since in numpy 1 a Python
    # number plus a float32 is one.
    return float(np.cumsum(best[reached], dtype=np.float64)[-1] / 100)


# LERF-OVS in 2D


@dataclass(frozen=True)
class Lerf2dScores:
    """LangSplat's numbers of one image and prompt.

    Args:
        iou: Of the mask cut from the stretched map; NaN when both masks are empty.
        hit: Whether the peak of the blurred map lies in one of the boxes.
    """

    iou: float
    hit: bool


def lerf_2d_scores(
    relevancy: ArrayLike,
    ground_truth: ArrayLike,
    boxes: ArrayLike | None = None,
    threshold: float = LERF_2D_THRESHOLD,
) -> Lerf2dScores:
    """LangSplat's evaluation of one map: localization and IoU.

    The map is blurred by a box of 30 pixels, borders mirrored. Localization: does a highest pixel of the blurred
    map lie in a box, edges included? IoU: the mean of map and blurred map is stretched to its own range, to -1..1,
    cut above ``threshold`` and smoothed by a majority of 7x7 pixels. A map is thus always cut somewhere,
    whatever its absolute values.

    LangSplat has three maps for a prompt and takes the one with the highest peak; we have one.

    Args:
        relevancy: ``[H, W]`` at the size of the truth.
        ground truth: Boolean mask ``[H, W]``.
        boxes: Boxes ``[B, 4]`` as x0, y0, x1, y1 in pixels; None takes those of the mask's parts (`mask_boxes`).
        threshold: In -1..1.

    Raises:
        ValueError: If shapes differ.
    """
    values, mask = np.asarray(relevancy, dtype=np.float32), np.asarray(ground_truth, dtype=bool)
    if values.ndim != 2 or values.shape != mask.shape or not values.size:
        raise ValueError(
            f"map {list(values.shape)} and ground truth {list(mask.shape)} must be [H, W] of one size"
        )
    areas = mask_boxes(mask) if boxes is None else np.asarray(boxes, dtype=np.float64).reshape(-1, 4)
    blurred = ndimage.uniform_filter(values, LERF_2D_WINDOW, mode="mirror")
    rows, columns = np.nonzero(blurred == blurred.max())
    left, right = np.minimum(areas[:, 0], areas[:, 2]), np.maximum(areas[:, 0], areas[:, 2])
    top, bottom = np.minimum(areas[:, 1], areas[:, 3]), np.maximum(areas[:, 1], areas[:, 3])
    x, y = columns[:, None], rows[:, None]
    hit = bool(((x >= left) & (x <= right) & (y >= top) & (y <= bottom)).any())
    blended = np.float32(0.5) * (blurred + values)
    stretched = blended - blended.min()
    stretched = stretched / (stretched.max() + np.float32(1e-9)) * 2 - 1
    predicted = _majority(np.clip(stretched, 0, 1) > threshold)
    union = np.count_nonzero(predicted | mask)
    return Lerf2dScores(np.count_nonzero(predicted & mask) / union if union else math.nan, hit)


def mask_boxes(mask: ArrayLike) -> NDArray[np.float64]:
    """Boxes ``[B, 4]`` (x0, y0, x1, y1: first and last pixel) of the parts of a mask that hang together."""
    labels, _ = ndimage.label(np.asarray(mask, dtype=bool))
    slices = [part for part in ndimage.find_objects(labels) if part is not None]
    rows = [(s[1].start, s[0].start, s[1].stop - 1, s[0].stop - 1) for s in slices]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _majority(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """LangSplat's smoothing: more ones than zeros among 7x7 pixels, where the last row and column never count."""
    height, width = mask.shape
    sums = np.zeros((height + 1, width + 1), dtype=np.int64)
    sums[1:, 1:] = mask.cumsum(0).cumsum(1)
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    top, left = np.maximum(rows - 3, 0), np.maximum(columns - 3, 0)
    bottom = np.maximum(np.minimum(rows + 4, height - 1), top)
    right = np.maximum(np.minimum(columns + 4, width - 1), left)
    ones = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return 2 * ones > (bottom - top) * (right - left)


# LERF-OVS in 3D


def silhouette_iou(alpha: ArrayLike, ground_truth: ArrayLike, threshold: float = SILHOUETTE_ALPHA) -> float:
    """IoU of the silhouette of selected Gaussians, rendered alone, with the ground truth; 0 when both are empty.

    Rendered alone means that nothing hides them: an object behind another one is seen through it.

    Args:
        alpha: Opacity of the selected Gaussians ``[H, W]`` in 0..1.
        ground truth: Boolean mask ``[H, W]``.
        threshold: Opacity beyond which a pixel belongs to the silhouette.

    Raises:
        ValueError: If shapes differ.
    """
    found, mask = np.asarray(alpha) > threshold, np.asarray(ground_truth, dtype=bool)
    if found.shape != mask.shape:
        raise ValueError(f"alpha {list(found.shape)} and ground truth {list(mask.shape)} must be of one size")
    union = np.count_nonzero(found | mask)
    return np.count_nonzero(found & mask) / union if union else 0.0


def accuracy_at(ious: Sequence[float], level: float) -> float:
    """Share of IoUs above ``level`` (Acc@0.25, Acc@0.5); NaN without any."""
    known = [value for value in ious if not math.isnan(value)]
    return float(np.mean(np.array(known) > level)) if known else math.nan
