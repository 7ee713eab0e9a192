"""Language of each segment of a field: its mean distribution over the codes.

Dimension letters: N Gaussians, K codes, L levels, S lowest segments, V segments of all levels, each once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from lexsplat.language.fields import LanguageField
from lexsplat.language.segments import Segments


@dataclass(frozen=True, eq=False)
class SegmentCodes:
    """The segments of all levels and their language.

    Args:
        numbers: Number in 0..V-1 of each lowest segment's segment at each level ``[L, S]`` int64, the lowest level
            first. A segment that several levels share has one number.
        distributions: Mean distributions over the codes ``[V, K]``, weighted by what the views show; rows sum to at
            most 1.
        masses: Visible weights ``[V]``.
    """

    numbers: NDArray[np.int64]
    distributions: Tensor
    masses: NDArray[np.float64]


@torch.no_grad()
def codes_of_field(field: LanguageField, segments: Segments) -> SegmentCodes:
    """The language of segments of the Gaussians of a field."""
    return segment_codes(segments, field.sums(segments.labels, segments.masses, segments.levels.shape[1]))


def segment_codes(segments: Segments, sums: NDArray[np.float64]) -> SegmentCodes:
    """The language of segments from the weighted sums over the lowest ones ``[S, K]``."""
    if not len(segments.labels):
        return SegmentCodes(np.zeros((len(segments.levels), 0), np.int64), torch.zeros(0, 1), np.zeros(0))
    labels, weights = segments.labels.cpu().numpy(), segments.masses.cpu().double().numpy()
    levels, lowest = segments.levels.cpu().numpy(), segments.levels.shape[1]
    masses = np.bincount(labels, weights, lowest).astype(np.float64)
    numbers = _numbered(levels)
    of_all = csr_array(
        (np.ones(numbers.size), (numbers.ravel(), np.tile(np.arange(lowest), len(levels)))),
        (int(numbers.max()) + 1, lowest),
    )
    of_all.data[:] = 1.0  # a segment of several levels would count its members more than once
    totals = of_all @ masses
    means = (of_all @ sums) / np.maximum(totals, 1e-12)[:, None]
    return SegmentCodes(numbers, torch.from_numpy(means).float(), totals)


def _numbered(levels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers of segments ``[L, S]``: those that hold the same lowest segments have the same number."""
    numbers, known = np.empty_like(levels), 0
    for place, level in enumerate(levels):
        sizes = np.bincount(level)
        if place == 0:
            numbers[0] = level
            known = len(sizes)
            continue
        below = numbers[place - 1]
        unchanged = np.bincount(numbers[place - 1], minlength=known)[below] == sizes[level]
        fresh = np.full(len(sizes), -1)
        new = np.unique(level[~unchanged])
        fresh[new] = known + np.arange(len(new))
        known += len(new)
        numbers[place] = np.where(unchanged, below, fresh[level])
    return numbers
