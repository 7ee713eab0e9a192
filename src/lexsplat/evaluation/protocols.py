"""Protocols of other authors, for comparable numbers.

- **official**: the authors' released evaluation of LEGaussians, quirks included (`official_scores`).
- **lerf-2d**: LangSplat's evaluation on LERF-OVS: localization by the peak of a blurred map, IoU of a mask
  obtained by thresholding the map stretched to its own range (`lerf_2d_scores`).
- **lerf-3d**: OpenGaussian's evaluation on LERF-OVS: Gaussians are selected in 3D, then rendered alone
  (`silhouette_iou`). The two LERF-OVS protocols are not comparable.

The strict protocol is in `lexsplat.evaluation.metrics`.
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
"""LangSplat's threshold for a map stretched to -1..1."""

LERF_2D_WINDOW = 30
"""Side of LangSplat's box blur, in pixels."""

SILHOUETTE_ALPHA = 0.7
"""Opacity above which a pixel belongs to the silhouette of the selected Gaussians (OpenGaussian)."""

_EPSILON = np.float32(1e-6)


# Official


@dataclass(frozen=True)
class OfficialScores:
    """Scores of one image and prompt in the official protocol: float32 as in their code, the AP float64."""

    iou: float
    accuracy: float
    precision: float
    average_precision: float


def official_ground_truth(mask: ArrayLike, width: int, height: int) -> NDArray[np.float32]:
    """A mask resized by a bicubic filter and not binarized: ``[H, W]`` in 0..1 with soft edges."""
    image = Image.fromarray(np.asarray(mask, dtype=bool).astype(np.uint8) * 255)
    if image.size != (width, height):
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(image, dtype=np.float32) / np.float32(255)


def official_scores(relevancy: ArrayLike, mask: ArrayLike, threshold: float = 0.5) -> OfficialScores:
    """The authors' evaluation of one map, quirks included, in float32 as they compute it.

    - Ground truth is resized to the map (`official_ground_truth`) and keeps soft edges. Logical operators treat every
      nonzero number as true, so a soft pixel belongs to the object and, as 1 - soft, to the background: if it is
      predicted, it counts as a true *and* as a false positive.
    - The accuracy compares floats, so soft pixels are always wrong.
    - The mask is relevancy >= threshold. IoU is I / (U + 1e-6), precision TP / (TP + FP + 1e-6); empty gives 0.
    - Average precision: thresholds 0, 0.01, ..., 1 with >, recall TP / (TP + FN + 1e-6), the best precision at each
      of 101 recalls or beyond, divided by **100**: at most 1.01.

    Where the result depends on the version of numpy (comparison of float32 recalls with float64 levels, sum of
    float32 precisions), it is that of 1.24, which the authors pin: compared in float32, summed in float64.

    Args:
        relevancy: ``[H, W]`` in 0..1, at the size of the rendered image.
        mask: Boolean ground truth at its own size.
        threshold: Of the mask; the average precision does not depend on it.
    """
    values = np.asarray(relevancy, dtype=np.float32)
    ground_truth = official_ground_truth(mask, values.shape[1], values.shape[0])
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
    # A pixel of value v is predicted at the thresholds below v: the first n, where n levels are < v.
    found_by = np.searchsorted(levels, values, side="left")
    hits, alarms = (
        np.bincount(found_by[side], minlength=102)[::-1].cumsum()[::-1][1:].astype(np.float32)
        for side in (thing, ground)
    )
    misses = _count(thing) - hits
    precisions, recalls = hits / (hits + alarms + _EPSILON), hits / (hits + misses + _EPSILON)
    best = np.append(np.float32(0), np.maximum.accumulate(precisions))
    reached = len(recalls) - np.searchsorted(recalls[::-1], levels, side="left")
    # Sequential, in the order of the authors' loop, and in float64: in numpy 1 a Python number plus a float32 is one.
    return float(np.cumsum(best[reached], dtype=np.float64)[-1] / 100)


# LERF-OVS in 2D


@dataclass(frozen=True)
class Lerf2dScores:
    """LangSplat's scores of one image and prompt.

    Args:
        iou: IoU of the thresholded stretched map; NaN if both masks are empty.
        hit: Whether the peak of the blurred map lies in one of the boxes.
    """

    iou: float
    hit: bool


def lerf_2d_scores(
    relevancy: ArrayLike, ground_truth: ArrayLike, boxes: ArrayLike | None = None
) -> Lerf2dScores:
    """LangSplat's evaluation of one map: localization and IoU.

    The map is blurred by a box of 30 pixels with mirrored borders. Localization: whether a maximum of the blurred map
    lies in a box, edges included. IoU: the mean of map and blurred map is stretched from its own range to -1..1,
    thresholded, and smoothed by a majority vote of 7x7 pixels. Absolute values of the map therefore have no effect.

    LangSplat has three maps per prompt and takes the one with the highest peak; lexsplat has one, or one for each
    level of 2D segments, of which it takes the best before.

    Args:
        relevancy: ``[H, W]`` at the size of the ground truth.
        ground_truth: Boolean mask ``[H, W]``.
        boxes: Boxes ``[B, 4]`` as x0, y0, x1, y1 in pixels; None: those of the connected parts (`mask_boxes`).

    Raises:
        ValueError: If shapes differ.
    """
    values, mask = np.asarray(relevancy, dtype=np.float32), np.asarray(ground_truth, dtype=bool)
    if values.ndim != 2 or values.shape != mask.shape or not values.size:
        raise ValueError(
            f"map {list(values.shape)} and ground truth {list(mask.shape)} must be [H, W] of the same size"
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
    predicted = _majority(np.clip(stretched, 0, 1) > LERF_2D_THRESHOLD)
    union = np.count_nonzero(predicted | mask)
    return Lerf2dScores(np.count_nonzero(predicted & mask) / union if union else math.nan, hit)


def mask_boxes(mask: ArrayLike) -> NDArray[np.float64]:
    """Boxes ``[B, 4]`` (x0, y0, x1, y1: first and last pixel) of the connected components of a mask."""
    labels, _ = ndimage.label(np.asarray(mask, dtype=bool))
    slices = [part for part in ndimage.find_objects(labels) if part is not None]
    rows = [(s[1].start, s[0].start, s[1].stop - 1, s[0].stop - 1) for s in slices]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def _majority(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """LangSplat's smoothing: more ones than zeros among 7x7 pixels; the image's last row and column never count."""
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


def silhouette_iou(alpha: ArrayLike, ground_truth: ArrayLike) -> float:
    """IoU of the silhouette of the selected Gaussians with the ground truth; 0 if both are empty.

    The Gaussians are rendered alone, so other objects do not occlude them.

    Args:
        alpha: Opacity of the selected Gaussians ``[H, W]`` in 0..1.
        ground_truth: Boolean mask ``[H, W]``.

    Raises:
        ValueError: If shapes differ.
    """
    found, mask = np.asarray(alpha) > SILHOUETTE_ALPHA, np.asarray(ground_truth, dtype=bool)
    if found.shape != mask.shape:
        raise ValueError(
            f"alpha {list(found.shape)} and ground truth {list(mask.shape)} must have the same size"
        )
    union = np.count_nonzero(found | mask)
    return np.count_nonzero(found & mask) / union if union else 0.0


def accuracy_at(ious: Sequence[float], level: float) -> float:
    """Share of IoUs above ``level`` (Acc@0.25, Acc@0.5); NaN without any."""
    known = [value for value in ious if not math.isnan(value)]
    return float(np.mean(np.array(known) > level)) if known else math.nan
