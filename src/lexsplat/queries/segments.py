"""Relevancy by segments: whole segments are selected or not (`lexsplat.language.segments`).

Each level of the hierarchy is tried. The score of a segment is the mean of its Gaussians, weighted by what the
training views show of them. A cut through the sorted scores separates segments that are taken from those that are
left, in the middle of the widest gap. The level whose gap is widest gives the answer: a mug is taken whole where its
parts score alike, and its handle alone where only the handle scores high. As long as some level has segments above
0.5, levels whose taken segments lie below it do not compete: what is taken there resembles the prompt a little more
than the rest, such as the whole mug for "mug handle". A coarse level may join a thin piece of a thing, such as the
stand of a lamp, to what is behind it. So segments of the lowest level that score higher than most of what is taken
are taken, too, where they weigh enough.

The result is a score in 0..1 for each Gaussian. It is at least 0.5 exactly for Gaussians of taken segments, so the
threshold of masks and of selections is 0.5 for every prompt. On both sides of it the score rises with the Gaussian's
own relevancy, weighted by how far its views agree (1 - u_G). Next to a thing the views disagree, because only some of
the crops show the thing.

Dimension letters: P prompts, N Gaussians, L levels, S segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.language.segments import Segments

SEGMENT_THRESHOLD = 0.5
"""Smallest score of a Gaussian in a taken segment."""

LOWEST = 0.6
"""A cut is above this share of the best segment's score."""
BORDER = 0.5
"""Levels whose taken segments lie below this do not compete."""
BETTER = 0.75
"""A segment of the lowest level that is left scores higher than this share of what is taken, or it stays left."""
ENOUGH = 0.05
"""Such segments are taken if they weigh at least this share of what is taken, and no more than it does."""
OWN_SHARE = 0.7
"""Share of a Gaussian's own relevancy in its score; the rest is its segment's."""
STEEPNESS = 8.0
"""Slope of the score at the cut, relative to the gap between taken and other segments."""
MOST_CERTAIN = 2.0
"""Largest factor of an own relevancy for the agreement of the views."""
BELOW = 1 - 2.0**-20
"""Factor that keeps the largest score of a segment that is left below `SEGMENT_THRESHOLD` in single precision."""
_NEVER = 1e-6
"""Mean certainty of what is taken up to which it counts for nothing: the views agree nowhere."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class _Cut:
    """How one level answers all prompts.

    Args:
        scores: Scores of its segments ``[P, S]``.
        masses: Their masses ``[S]``.
        gaps: Width of the widest gap ``[P]``.
        limits: Its middle ``[P]``.
        taken: Mean score of the taken segments ``[P]``.
        left: Mean score of the others ``[P]``.
    """

    scores: FloatArray
    masses: FloatArray
    gaps: FloatArray
    limits: FloatArray
    taken: FloatArray
    left: FloatArray


@torch.no_grad()
def segment_relevancy(relevancy: Tensor, segments: Segments, uncertainties: Tensor | None = None) -> Tensor:
    """Segment-aware scores from relevancies of Gaussians.

    Args:
        relevancy: ``[P, N]`` in 0..1.
        segments: The segments of the N Gaussians.
        uncertainties: u_G of the Gaussians ``[N]`` in 0..1. The own relevancy of a Gaussian is multiplied by 1 - u,
            relative to the mean of what is taken (at most `MOST_CERTAIN`). None counts all alike.

    Returns:
        ``[P, N]`` in 0..1, on the device of ``relevancy``; at least `SEGMENT_THRESHOLD` exactly where a segment is
        taken.
    """
    own = relevancy.detach().cpu().float().numpy()
    if own.shape[1] == 0 or len(own) == 0:
        return relevancy
    labels, weights = segments.labels.cpu().numpy(), segments.masses.cpu().double().numpy()
    levels = segments.levels.cpu().numpy()
    lowest = np.stack([_sums(labels, weights * row, levels.shape[1]) for row in own])
    masses = _sums(labels, weights, levels.shape[1])
    certainties = None if uncertainties is None else 1 - uncertainties.detach().cpu().float().numpy()
    means = lowest / np.maximum(masses, 1e-12)
    certain = masses if certainties is None else _sums(labels, weights * certainties, levels.shape[1])
    cuts = [_cut(lowest, masses, level) for level in levels]
    result = np.empty_like(own)
    for prompt in range(len(own)):
        # Coarse levels first: of equal gaps the first one wins.
        keys = [(cut.taken[prompt] >= BORDER, cut.gaps[prompt]) for cut in reversed(cuts)]
        place = len(cuts) - 1 - max(range(len(cuts)), key=lambda key: (keys[key], -key))
        cut = cuts[place]
        at_lowest = cut.scores[prompt][levels[place]]
        limit, spread = cut.limits[prompt], max(cut.taken[prompt] - cut.left[prompt], 1e-6)
        taken = at_lowest >= limit
        pieces = _pieces_left(means[prompt], masses, taken)
        at_lowest, taken = np.where(pieces, means[prompt], at_lowest), taken | pieces
        # Single precision, in place: this is all that is done for each Gaussian.
        odds = own[prompt] * np.float32(OWN_SHARE)
        if certainties is not None:
            usual = certain[taken].sum() / max(masses[taken].sum(), 1e-12)
            if usual > _NEVER:
                odds *= np.minimum(certainties / np.float32(usual), np.float32(MOST_CERTAIN))
        odds += ((1 - OWN_SHARE) * at_lowest - limit).astype(np.float32)[labels]
        odds *= np.float32(-STEEPNESS / spread)
        steep = np.exp(np.clip(odds, -60, 60, out=odds), out=odds)
        steep += 1
        np.divide(np.float32(BELOW * (1 - SEGMENT_THRESHOLD)), steep, out=result[prompt])
        result[prompt] += np.where(taken, SEGMENT_THRESHOLD, 0.0).astype(np.float32)[labels]
    return torch.from_numpy(result).to(relevancy)


def _cut(lowest: FloatArray, lowest_masses: FloatArray, level: NDArray[np.int64]) -> _Cut:
    """The widest gap between the scores of the segments of a level, for each prompt."""
    count = int(level.max()) + 1
    masses = _sums(level, lowest_masses, count)
    sums = np.stack([_sums(level, row, count) for row in lowest])
    scores = sums / np.maximum(masses, 1e-12)
    order = np.argsort(-scores, axis=1, kind="stable")
    rows = np.arange(len(scores))
    ranked = scores[rows[:, None], order]
    if count == 1:
        return _Cut(scores, masses, np.zeros(len(scores)), ranked[:, 0], ranked[:, 0], np.zeros(len(scores)))
    gaps = np.where(ranked[:, :-1] >= LOWEST * ranked[:, :1], ranked[:, :-1] - ranked[:, 1:], -1.0)
    best = gaps.argmax(1)
    limits = (ranked[rows, best] + ranked[rows, best + 1]) / 2
    taken = scores >= limits[:, None]
    means = [(sums * side).sum(1) / np.maximum((masses * side).sum(1), 1e-12) for side in (taken, ~taken)]
    return _Cut(scores, masses, gaps[rows, best], limits, *means)


def _pieces_left(means: FloatArray, masses: FloatArray, taken: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The lowest segments ``[S]`` that a cut leaves though they score higher than most of what it takes."""
    order = np.argsort(means[taken], kind="stable")
    running = np.cumsum(masses[taken][order])
    usual = means[taken][order][np.searchsorted(running, BETTER * running[-1])]
    pieces = ~taken & (means >= max(usual, BORDER))
    return pieces & (ENOUGH * running[-1] <= masses[pieces].sum() <= running[-1])


def _sums(places: NDArray[np.int64], values: FloatArray, count: int) -> FloatArray:
    """Sums of the values ``[M]`` at each of ``count`` places, in the order of the values."""
    return np.bincount(places, values, count).astype(np.float64)
