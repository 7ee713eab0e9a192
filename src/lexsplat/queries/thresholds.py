"""Masks from relevancies: by a fixed threshold (the paper's 0.5) or an automatic one for each prompt.

The automatic threshold is found from the scene alone and never sees the truth. Whether a prompt is in the scene at
all has a say too: `lexsplat.queries.presence.found_thresholds`, which every question goes through, puts 0.5
where it is
not. Dimension letters are those of `lexsplat.queries.relevancy`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import QueryableField, QueryConfig, render_relevancy

BORDER = 0.5
"""Relevancy at which a prompt and a canonical phrase are equally near; the paper's threshold."""
_TOP_SHARE = 5e-4
"""What samples reach is the mean of the best 0.05 percent of them."""


def masks(relevancy: Tensor, thresholds: float | Tensor) -> Tensor:
    """Pixels or Gaussians with relevancy at or above the threshold (paper: 0.5).

    Args:
        relevancy: ``[P, ...]``.
        thresholds: One for all, or one for each prompt ``[P]``.
    """
    limits = torch.as_tensor(thresholds, dtype=relevancy.dtype, device=relevancy.device)
    if limits.ndim == 1:
        limits = limits.view(-1, *[1] * (relevancy.ndim - 1))
    return relevancy >= limits


def automatic_threshold(
    samples: Tensor,
    weights: Tensor | None = None,
    *,
    tempering: float = 0.5,
    min_contrast: float = 0.05,
    pull: float = 1.0,
) -> Tensor:
    """A threshold for each prompt from relevancies all over the scene; it never sees the truth.

    Otsu's method on a histogram whose counts are raised to ``tempering``. Otsu wants classes of like size and
    splits the background when an object covers a percent of the scene; the square root lets the object count
    (1 is plain Otsu). Where a gap separates the classes, the middle of the gap is taken. If the means of the two
    classes lie on either side of 0.5, where relevancy itself puts the border, the cut is moved there.

    Where something is over 0.5, the class above the cut has to be so on average, too: otherwise the cut has parted
    what is a little like the prompt from what is not like it at all (half of a bear, asked for its nose), and what
    lies above is split again.

    A prompt without contrast (the 99.8th percentile less than ``min_contrast`` above the median: an absent
    object, or one that is everywhere) has no two classes. It gets 0.5, where relevancy itself says whether
    the prompt or a canonical phrase is nearer.

    Args:
        samples: Relevancy ``[P, S]`` in 0..1, of pixels of several views (`scene_threshold`) or of Gaussians.
        weights: Weight of each sample ``[S]``, such as the visibility of Gaussians; all equal when left out.
        tempering: Exponent on the histogram in 0..1.
        min_contrast: Least contrast that is split.
        pull: How far the cut is moved towards 0.5, in 0..1.

    Returns:
        Thresholds ``[P]`` in 0..1, float32 on the CPU, for `masks`.
    """
    if samples.ndim != 2 or samples.shape[1] == 0:
        raise ValueError(f"samples must be [P, S] with S > 0, got {list(samples.shape)}")
    shares = torch.ones(samples.shape[1]) if weights is None else weights.detach().cpu()
    if shares.shape != samples.shape[1:] or not bool((shares >= 0).all()) or float(shares.sum()) == 0:
        raise ValueError(f"weights must be [{samples.shape[1]}], not negative, and not all zero")
    rows = samples.detach().cpu().double()
    return torch.tensor([_tempered_otsu(row, shares.double(), tempering, min_contrast, pull) for row in rows])


def scene_threshold(
    field: QueryableField,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    positives: Tensor,
    negatives: Tensor,
    config: QueryConfig | None = None,
    *,
    long_side: int = 320,
) -> Tensor:
    """`automatic_threshold` ``[P]`` from renderings of a few views that are not evaluated (training views).

    Args:
        field: The language of the scene.
        gaussians: Its geometry.
        cameras: Views to look from, spread over the scene; they are rendered small.
        positives: Text embeddings of the prompts ``[P, D]``.
        negatives: Text embeddings of the negatives ``[M, D]``.
        config: Form, temperature, coverage.
        long_side: Longer side of the renderings in pixels, at most.

    Raises:
        ValueError: If there are no cameras.
    """
    if not cameras:
        raise ValueError("an automatic threshold needs at least one camera")
    maps = []
    for camera in cameras:
        small = camera.downscaled(max(1.0, max(camera.width, camera.height) / long_side))
        maps.append(render_relevancy(field, gaussians, small, positives, negatives, config).flatten(1).cpu())
    return automatic_threshold(torch.cat(maps, dim=1))


def _tempered_otsu(row: Tensor, shares: Tensor, tempering: float, min_contrast: float, pull: float) -> float:
    """The cut through one prompt's samples; samples above a cut that reach 0.5 only in part are cut again."""
    reached = _top_mean(row, shares) > BORDER
    while True:
        found = _best_cut(row, shares, tempering, min_contrast)
        if found is None:
            return BORDER
        cut, lower, upper = found
        if not (reached and upper < BORDER):
            return cut + pull * (BORDER - cut) if lower < BORDER < upper else cut
        above = row >= cut
        row, shares = row[above], shares[above]


def _top_mean(row: Tensor, shares: Tensor) -> float:
    """The mean of the best `_TOP_SHARE` of weighted samples."""
    values, order = row.sort(descending=True)
    weights = shares[order]
    limit = float(weights.sum()) * _TOP_SHARE
    taken = torch.minimum(weights, (limit - weights.cumsum(0) + weights).clamp_min(0))
    return float((values * taken).sum()) / limit


def _best_cut(
    row: Tensor, shares: Tensor, tempering: float, min_contrast: float
) -> tuple[float, float, float] | None:
    """Otsu's cut on the tempered histogram and the means on either side; None where there is no contrast."""
    bins = 512
    seen = row[shares > 0]
    low, high = float(seen.min()), float(seen.max())
    if high - low < min_contrast:
        return None
    width = (high - low) / bins
    index = ((row - low) / width).long().clamp(0, bins - 1)
    counts = torch.zeros(bins, dtype=torch.float64).index_add_(0, index, shares)
    share = counts.cumsum(0) / counts.sum()
    median, top = (int(torch.searchsorted(share, torch.tensor(q, dtype=share.dtype))) for q in (0.5, 0.998))
    if (top - median) * width < min_contrast:
        return None
    centers = low + width * (torch.arange(bins, dtype=torch.float64) + 0.5)
    heights = counts**tempering * (counts > 0)
    below = heights.cumsum(0)[:-1]
    above = heights.sum() - below
    first = (heights * centers).cumsum(0)[:-1]
    lower, upper = first / below, ((heights * centers).sum() - first) / above
    between = below * above * (lower - upper) ** 2
    # All cuts inside a gap are equally good: take the middle of the best run.
    best = torch.nonzero(between >= between.max() * (1 - 1e-12)).flatten()
    cut = low + width * (float(best.double().mean()) + 1)
    place = int(best[0])
    return cut, float(lower[place]), float(upper[place])
