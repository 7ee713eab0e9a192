"""Metrics of image quality and of relevancy maps, as functions of arrays.

The strict protocol: ground truth is binary and never resized; where sizes differ, the relevancy map is resized
(`resize_scores`). Average precision uses every distinct score as a threshold and is the mean of the interpolated
precision at the recalls 0, 0.01, ..., 1 (COCO), so it lies in 0..1. The protocols of other authors are in
`evaluation.protocols`.
"""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from lexsplat.runtime.progress import NOTE

log = logging.getLogger("lexsplat")

RECALLS: NDArray[np.float64] = np.arange(101) / 100
"""The 101 recall points. Divided rather than accumulated, so that a recall of exactly 29 in 100 reaches point 29."""

THRESHOLDS: NDArray[np.float64] = np.arange(1001) / 1000
"""Thresholds of `ThresholdCounts`."""

# Image quality


def psnr(image: ArrayLike, target: ArrayLike) -> float:
    """Peak signal-to-noise ratio in dB of images in 0..1; infinite for equal images."""
    first, second = _same_shape(image, target)
    error = float(np.mean((first - second) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: ArrayLike, target: ArrayLike) -> float:
    """Structural similarity of images ``[H, W, 3]`` in 0..1 as in Wang et al. 2004.

    Gaussian window of 11 pixels, sigma 1.5, biased moments, mean over the pixels whose window lies inside the image
    (scikit-image). torchmetrics and the code of splatting papers include the border with reflected or zero padding
    and differ in the third decimal.

    Raises:
        ValueError: If shapes differ or a side is shorter than 11 pixels.
    """
    from skimage.metrics import structural_similarity

    first, second = _same_shape(image, target)
    if min(first.shape[:2]) < 11:
        raise ValueError(f"ssim needs images of at least 11x11, got {first.shape[1]}x{first.shape[0]}")
    value = structural_similarity(
        first,
        second,
        data_range=1.0,
        channel_axis=2 if first.ndim == 3 else None,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return float(value)


Perceptual = Callable[[ArrayLike, ArrayLike], float]


def load_lpips(device: str = "cpu") -> tuple[Perceptual | None, str | None]:
    """LPIPS (VGG) of torchmetrics: the function and None, or None and the reason why it is unavailable.

    The metric needs the extra ``lexsplat[lpips]`` and the weights of VGG-16, which are downloaded once. Their size
    and license are logged first.
    """
    try:
        import torch

        # LPIPS needs it, and torchmetrics takes seconds to load.
        torchvision = importlib.import_module("torchvision")
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        _tell_download(torchvision.models.VGG16_Weights.DEFAULT)
        network = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True).to(device).eval()
    except ImportError as error:
        return None, f"not installed: pip install 'lexsplat[lpips]' ({_first_line(error)})"
    except (OSError, RuntimeError) as error:
        return None, f"no weights of VGG-16: {_first_line(error)}"

    def distance(image: ArrayLike, target: ArrayLike) -> float:
        first, second = _same_shape(image, target)
        with torch.no_grad():
            pair = [
                torch.from_numpy(np.clip(side, 0, 1)).float().permute(2, 0, 1)[None].to(device)
                for side in (first, second)
            ]
            value = float(network(*pair))
            network.reset()
        return value

    return distance, None


def _tell_download(weights: Any) -> None:
    """Log size, place and license of torchvision's weights of VGG-16, unless they are on this machine."""
    import torch

    path = Path(torch.hub.get_dir()) / "checkpoints" / weights.url.rpartition("/")[2]
    if not path.exists():
        log.log(
            NOTE,
            "VGG-16 of torchvision, for LPIPS: %.0f MB are downloaded once to %s; license: BSD-3-Clause "
            "(trained on ImageNet, which has terms of its own)",
            weights.meta.get("_file_size", 528),
            path.parent,
        )


# Relevancy maps, strict protocol


def average_precision(scores: ArrayLike, ground_truth: ArrayLike) -> float:
    """Strict average precision: mean over 101 recalls of the best precision at that recall or a higher one.

    A pixel is predicted when its score is at least the threshold. Of all thresholds with the same hits, the score of
    a hit predicts the fewest pixels, so only those thresholds are tried.

    Returns:
        A number in 0..1; NaN if the ground truth is empty.

    Raises:
        ValueError: If shapes differ, or a score is NaN or infinite.
    """
    values, mask = _scores(scores, ground_truth)
    if not mask.any():
        return math.nan
    hits = np.sort(values[mask])
    ranked = np.sort(values[values >= hits[0]])  # no threshold predicts the others
    # From the lowest threshold to the highest; of ties the first one counts.
    found = np.arange(len(hits), 0, -1)
    predicted = len(ranked) - np.searchsorted(ranked, hits, side="left")
    precisions, recalls = (found / predicted)[::-1], (found / len(hits))[::-1]
    return float(interpolated_precision(precisions, recalls).mean())


def interpolated_precision(precisions: NDArray, recalls: NDArray) -> NDArray:
    """Best precision at each of `RECALLS` or beyond ``[101]``, 0 if not reached; ``recalls`` must be sorted."""
    best = np.append(np.maximum.accumulate(precisions[::-1])[::-1], 0.0)
    return best[np.searchsorted(recalls, RECALLS, side="left")]


def localization(scores: ArrayLike, ground_truth: ArrayLike) -> float:
    """Whether the highest score lies on the object: 1 or 0; NaN if the ground truth is empty.

    If several pixels share the highest score, the fraction of them on the object, the expected value for a random
    choice: a constant map scores the object's share of the area.
    """
    values, mask = _scores(scores, ground_truth)
    return float(mask[values == values.max()].mean()) if mask.any() else math.nan


def resize_scores(scores: ArrayLike, width: int, height: int) -> NDArray[np.float32]:
    """A relevancy map ``[H, W]`` at another size, bilinear, pixel centers aligned; unchanged if sizes agree."""
    values = np.asarray(scores, dtype=np.float32)
    if values.shape == (height, width):
        return values
    resized = Image.fromarray(values, mode="F").resize((width, height), Image.Resampling.BILINEAR)
    return np.asarray(resized, dtype=np.float32)


@dataclass(frozen=True)
class MaskScores:
    """Scores of one mask, in 0..1.

    Args:
        iou: Intersection over union; 1 if both masks are empty.
        accuracy: Share of pixels on which the masks agree.
        precision: Share of predicted pixels that are true; 0 for an empty prediction, 1 if both masks are empty.
    """

    iou: float
    accuracy: float
    precision: float


@dataclass(frozen=True)
class ThresholdCounts:
    """Pixel counts of a map at each of `THRESHOLDS`, small enough to keep for every view and prompt.

    Args:
        hits: Pixels of the ground truth with a score at or above the threshold ``[1001]``.
        false_alarms: Other pixels with a score at or above the threshold ``[1001]``.
    """

    hits: NDArray[np.int64]
    false_alarms: NDArray[np.int64]

    def __add__(self, other: ThresholdCounts) -> ThresholdCounts:
        return ThresholdCounts(self.hits + other.hits, self.false_alarms + other.false_alarms)

    @property
    def iou(self) -> NDArray[np.float64]:
        """Intersection over union at each threshold ``[1001]``."""
        union = self.hits[0] + self.false_alarms
        return np.where(union > 0, self.hits / np.maximum(union, 1), 1.0)

    def at(self, threshold: float) -> MaskScores:
        """Strict scores of the mask at one of `THRESHOLDS`; others are rounded down to the next of them."""
        index = int(np.searchsorted(THRESHOLDS, threshold, side="right")) - 1
        counts = self.hits[index], self.false_alarms[index], self.hits[0], self.false_alarms[0]
        return _scores_of_counts(*map(int, counts))

    @property
    def curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Precision and recall ``[T]`` from the highest threshold with a predicted pixel to the lowest."""
        found = self.hits + self.false_alarms
        keep = np.flatnonzero(found)[::-1]
        return self.hits[keep] / found[keep], self.hits[keep] / max(int(self.hits[0]), 1)


def mask_scores(predicted: NDArray[np.bool_], ground_truth: NDArray[np.bool_]) -> MaskScores:
    """Strict scores of a mask."""
    hits, positives = (int(np.count_nonzero(mask)) for mask in (predicted & ground_truth, ground_truth))
    alarms = int(np.count_nonzero(predicted)) - hits
    return _scores_of_counts(hits, alarms, positives, ground_truth.size - positives)


def _scores_of_counts(hits: int, alarms: int, positives: int, negatives: int) -> MaskScores:
    found, union = hits + alarms, positives + alarms
    return MaskScores(
        iou=hits / union if union else 1.0,
        accuracy=(hits + negatives - alarms) / (positives + negatives),
        precision=hits / found if found else float(positives == 0),
    )


def threshold_counts(scores: ArrayLike, ground_truth: ArrayLike) -> ThresholdCounts:
    """Counts at 1001 thresholds in 0..1; scores outside this range are clipped."""
    values, mask = _scores(scores, ground_truth)
    bins = np.searchsorted(THRESHOLDS, np.clip(values, 0, 1), side="right") - 1
    counts = [np.bincount(bins[side], minlength=1001)[::-1].cumsum()[::-1] for side in (mask, ~mask)]
    return ThresholdCounts(*counts)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _same_shape(image: ArrayLike, target: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first, second = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if first.shape != second.shape or not first.size:
        raise ValueError(f"images must have the same shape, got {list(first.shape)} and {list(second.shape)}")
    return first, second


def _scores(scores: ArrayLike, ground_truth: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    values, mask = np.asarray(scores), np.asarray(ground_truth)
    if mask.dtype != bool or values.shape != mask.shape or not values.size:
        raise ValueError(
            f"scores {list(values.shape)} need a boolean mask of the same shape, got {mask.dtype} {list(mask.shape)}"
        )
    values = values.astype(np.float64).ravel()
    if not np.isfinite(values).all():
        raise ValueError("scores contain NaN or infinity")
    return values, mask.ravel()
