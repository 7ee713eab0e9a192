"""Masks from relevancies: by a fixed threshold (the paper's 0.5) or an automatic one for each prompt.

The automatic threshold comes from the scene alone, never from ground truth. Relevancy relative to everyday words
(`lexsplat.queries.everyday`) has its border at 0.5 in every scene. Relevancy relative to canonical phrases has none
that holds for all encoders: its threshold comes from maps of training views (`scene_thresholds`), and is 0.5 for what
the scene does not hold (`lexsplat.queries.presence`). Dimension letters are those of `lexsplat.queries.relevancy`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.selection import Presence
from lexsplat.runtime.errors import QueryError
from lexsplat.runtime.sampling import evenly

BORDER = 0.5
"""Relevancy at which a prompt and a canonical phrase are equally near; the paper's threshold."""
THRESHOLD_VIEWS = 8
"""Number of training views that the threshold of a scene comes from, at most."""
_LONG_SIDE = 80
"""Longer side of their renderings in pixels, at most."""
_TEMPERING = 0.5
"""Exponent on the histogram; 1 is plain Otsu."""
_MIN_CONTRAST = 0.05
"""Smallest contrast that is split."""
_TOP_SHARE = 5e-4
"""The peak of the samples is the mean of their best 0.05 percent."""


def check_threshold(threshold: float) -> float:
    """The threshold as a float.

    Raises:
        QueryError: If it is not a number in 0..1.
    """
    try:
        number = float(threshold) if hasattr(threshold, "__float__") else math.nan  # a text is no number
    except (TypeError, ValueError, OverflowError, RuntimeError):  # an array of several, 1 with 400 zeros
        number = math.nan
    if isinstance(threshold, bool) or not 0 <= number <= 1:
        raise QueryError("threshold", expected="a number in 0..1", found=repr(threshold)[:40])
    return number


def masks(relevancy: Tensor, thresholds: float | Tensor) -> Tensor:
    """Pixels or Gaussians with relevancy at or above the threshold (paper: 0.5).

    Args:
        relevancy: ``[P, ...]``.
        thresholds: One for all prompts, or one for each ``[P]``.
    """
    limits = torch.as_tensor(thresholds, dtype=relevancy.dtype, device=relevancy.device)
    if limits.ndim == 1:
        limits = limits.view(-1, *[1] * (relevancy.ndim - 1))
    return relevancy >= limits


def automatic_threshold(samples: Tensor, weights: Tensor | None = None) -> Tensor:
    """A threshold for each prompt from relevancies all over the scene, without ground truth.

    Otsu's method on a histogram whose counts are raised to `_TEMPERING`. Otsu's method favors classes of similar
    size and splits the background when an object covers one percent of the scene; the square root gives the object
    more weight. Where a gap separates the classes, the cut is the middle of the gap. If the means
    of the two classes lie on either side of 0.5, the cut moves there.

    If some samples exceed 0.5, the mean of the class above the cut has to exceed it too. Otherwise the cut has
    separated what resembles the prompt a little from what does not resemble it at all (half of a bear, for the
    prompt "nose of the bear"), and the class above is split again.

    A prompt without contrast has no two classes: the 99.8th percentile is less than `_MIN_CONTRAST` above the
    median, as for an object that is absent or everywhere. Its threshold is 0.5.

    Args:
        samples: Relevancy ``[P, S]`` in 0..1, of pixels of several views (`scene_thresholds`) or of Gaussians.
        weights: Weight of each sample ``[S]``, such as the opacity of Gaussians; None weighs all samples equally.

    Returns:
        Thresholds ``[P]`` in 0..1, float32 on the CPU, for `masks`.
    """
    if samples.ndim != 2 or samples.shape[1] == 0:
        raise ValueError(f"samples must be [P, S] with S > 0, got {list(samples.shape)}")
    shares = torch.ones(samples.shape[1]) if weights is None else weights.detach().cpu()
    if shares.shape != samples.shape[1:] or not bool((shares >= 0).all()) or float(shares.sum()) == 0:
        raise ValueError(f"weights must be [{samples.shape[1]}], not negative, and not all zero")
    rows = samples.detach().cpu().double()
    return torch.tensor([_tempered_otsu(row, shares.double()) for row in rows])


def scene_thresholds(
    relevancy: Callable[[Camera], Tensor],
    cameras: Sequence[Camera],
    presences: Sequence[Presence] | None = None,
) -> Tensor:
    """The automatic threshold ``[P]`` of each prompt in a scene: the one rule for masks and selections.

    The thresholds are `automatic_threshold` of small renderings of `THRESHOLD_VIEWS` evenly chosen views. Prompts
    that the scene does not hold get 0.5, where next to nothing is marked: they have no two classes, and a cut would
    mark whatever resembles the prompt a little more than the rest, such as a whole table for a mug's handle that the
    encoder does not see. "unsure" prompts keep their cut: a guess marked as doubtful is more useful than an empty
    image.

    Args:
        relevancy: Renders the maps ``[P, H, W]`` of the prompts in a view.
        cameras: All views to choose from, none of which is evaluated: the training views.
        presences: Whether the scene contains each prompt; None for methods that do not determine it.

    Raises:
        ValueError: If there are no cameras.
    """
    if not cameras:
        raise ValueError("an automatic threshold needs at least one camera")
    maps = [relevancy(view.within(_LONG_SIDE)).flatten(1).cpu() for view in evenly(cameras, THRESHOLD_VIEWS)]
    found = automatic_threshold(torch.cat(maps, dim=1))
    absent = torch.tensor(
        [presence == "no" for presence in presences or ["yes"] * len(found)], dtype=torch.bool
    )
    return torch.where(absent, torch.full_like(found, BORDER), found)


def _tempered_otsu(row: Tensor, shares: Tensor) -> float:
    """The cut through one prompt's samples; the class above it is cut again while its mean is below 0.5."""
    reached = _top_mean(row, shares) > BORDER
    while True:
        found = _best_cut(row, shares)
        if found is None:
            return BORDER
        cut, lower, upper = found
        if not (reached and upper < BORDER):
            return BORDER if lower < BORDER < upper else cut
        above = row >= cut
        row, shares = row[above], shares[above]


def _top_mean(row: Tensor, shares: Tensor) -> float:
    """Mean of the best `_TOP_SHARE` of weighted samples."""
    values, order = row.sort(descending=True)
    weights = shares[order]
    limit = float(weights.sum()) * _TOP_SHARE
    taken = torch.minimum(weights, (limit - weights.cumsum(0) + weights).clamp_min(0))
    return float((values * taken).sum()) / limit


def _best_cut(row: Tensor, shares: Tensor) -> tuple[float, float, float] | None:
    """Otsu's cut on the tempered histogram and the means on either side; None without contrast."""
    bins = 512
    seen = row[shares > 0]
    low, high = float(seen.min()), float(seen.max())
    if high - low < _MIN_CONTRAST:
        return None
    width = (high - low) / bins
    index = ((row - low) / width).long().clamp(0, bins - 1)
    counts = torch.zeros(bins, dtype=torch.float64).index_add_(0, index, shares)
    share = counts.cumsum(0) / counts.sum()
    median, top = (int(torch.searchsorted(share, torch.tensor(q, dtype=share.dtype))) for q in (0.5, 0.998))
    if (top - median) * width < _MIN_CONTRAST:
        return None
    centers = low + width * (torch.arange(bins, dtype=torch.float64) + 0.5)
    heights = counts**_TEMPERING * (counts > 0)
    below = heights.cumsum(0)[:-1]
    above = heights.sum() - below
    first = (heights * centers).cumsum(0)[:-1]
    lower, upper = first / below, ((heights * centers).sum() - first) / above
    between = below * above * (lower - upper) ** 2
    # All cuts inside a gap score the same: take the middle of the best run.
    best = torch.nonzero(between >= between.max() * (1 - 1e-12)).flatten()
    cut = low + width * (float(best.double().mean()) + 1)
    place = int(best[0])
    return cut, float(lower[place]), float(upper[place])
