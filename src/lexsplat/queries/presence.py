"""Whether the scene holds what a phrase names: a calibrated "not in this scene".

Every phrase has a best place in every scene, even if the object is absent. Presence is decided by how good that
place is, and by how it compares with the best places of *other words*. `REFERENCE_PHRASES` are everyday objects, most
of which any one scene lacks; their best places give a scale for the relevancies of an encoder.

- *peak*: the relevancy at the phrase's best place. A calibrated encoder exceeds 0.5 only for what is there;
- *height*: the phrase's peak relevancy, in robust standard deviations above the peaks of the reference phrases;
- *rank*: the share of the reference phrases that score lower than the phrase at its peak. At the teddy bear
  "giraffe" may score high, but "stuffed animal" scores higher.

A logistic function of the three gives the probability. `CALIBRATION` is fitted on the second demo scene alone by
``benchmarks/selection.py`` (docs/selection.md), which prints new numbers when the encoder changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.queries.relevancy import Question, code_relevancy
from lexsplat.queries.selection import Presence

REFERENCE_PHRASES = (
    "chair", "bed", "window", "door", "computer", "telephone", "television", "clock", "shoe", "hat", "umbrella",
    "bicycle", "airplane", "ship", "train", "horse", "dog", "cat", "bird", "fish", "elephant", "tree", "flower",
    "bread", "cheese", "pizza", "cake", "carrot", "knife", "spoon", "plate", "basket", "guitar", "piano", "drum",
    "hammer", "scissors", "key", "camera", "pillow", "curtain", "mirror", "stairs", "bridge", "castle", "river",
    "cloud", "person", "hand", "glove", "backpack", "suitcase", "bottle", "book", "ball", "toy", "lamp", "fruit",
)  # fmt: skip
"""Everyday objects. Nearly every scene lacks more than half of them, which is all that the scale needs."""

_PEAK_SHARE = 5e-4
_PEAK_COUNT = 20
"""A peak is the mean of the best 0.05 percent of the Gaussians, and of at least this many."""
_FAINT = 0.1
"""Gaussians of lower opacity do not count."""


@dataclass(frozen=True)
class Evidence:
    """Evidence that the scene holds a phrase (see the module).

    Args:
        height: Robust standard deviations above the reference peaks.
        rank: Share of reference phrases that score lower at its peak, in 0..1.
        peak: Relevancy at its peak, in 0..1.
    """

    height: float
    rank: float
    peak: float = 0.5

    def values(self) -> list[float]:
        """The bounded terms of the log-odds: 1, height, rank and the log-odds of the peak."""
        peak = min(1 - 1e-3, max(1e-3, self.peak))
        return [1.0, min(10.0, max(-5.0, self.height)), self.rank, math.log(peak / (1 - peak))]


@dataclass(frozen=True)
class Calibration:
    """Weights and limits that turn evidence into an answer.

    Args:
        bias: Of the log-odds.
        height: Weight of `Evidence.height` (clipped to -5..10).
        rank: Weight of `Evidence.rank`.
        yes: Probability from which the answer is "yes".
        no: Probability up to which it is "no".
        peak: Weight of the log-odds of `Evidence.peak`.
    """

    bias: float
    height: float
    rank: float
    yes: float
    no: float
    peak: float = 0.0

    def probability(self, evidence: Evidence) -> float:
        """Probability in 0..1 that the scene holds the phrase."""
        weights = (self.bias, self.height, self.rank, self.peak)
        logit = sum(weight * value for weight, value in zip(weights, evidence.values()))
        return 1 / (1 + math.exp(-max(-60.0, min(60.0, logit))))

    def classify(self, evidence: Evidence) -> Presence:
        """Whether the scene holds the phrase: "yes", "no" or "unsure"."""
        probability = self.probability(evidence)
        return "yes" if probability >= self.yes else "no" if probability <= self.no else "unsure"


CALIBRATION = Calibration(bias=-1.869, height=0.0, rank=0.353, yes=0.457, no=0.457, peak=3.32)


class PresenceClassifier:
    """Compares phrases with the reference phrases in one scene.

    Args:
        gaussians: The geometry of the scene.
        language: Its language.
        references: Embeddings of `REFERENCE_PHRASES`.
    """

    def __init__(self, gaussians: Gaussians, language: LanguageField, references: Question) -> None:
        self.language = language
        self._shown = (gaussians.opacities >= _FAINT).detach().nonzero()[:, 0]
        self._table = code_relevancy(language.codebook.clip.to(gaussians.device), references)
        peaks = self._reference_peaks()
        middle = peaks.median()
        # 1.4826 scales the median absolute deviation to the standard deviation of a normal distribution.
        self.middle, self.spread = float(middle), float((peaks - middle).abs().median()) * 1.4826

    def evidence(self, scores: Tensor) -> Evidence:
        """Evidence for a phrase from its relevancies ``scores [N]``."""
        if len(self._shown) == 0:
            return Evidence(-5.0, 0.0, 0.0)
        best = scores.to(self._shown.device)[self._shown].topk(self._peak_count())
        region = self._shown[best.indices]
        there = (self.language.select(region).code_probabilities() @ self._table).mean(0)
        peak = float(best.values.mean())
        height = (peak - self.middle) / max(self.spread, 1e-4)
        return Evidence(height, float((there < peak).float().mean()), peak)

    def classify(self, scores: Tensor) -> Presence:
        """Whether the scene holds the phrase with relevancies ``scores [N]``."""
        return CALIBRATION.classify(self.evidence(scores))

    def _peak_count(self) -> int:
        return min(len(self._shown), max(_PEAK_COUNT, int(_PEAK_SHARE * len(self._shown))))

    def _reference_peaks(self) -> Tensor:
        """Peaks of the reference phrases ``[V]``, a block of Gaussians at a time."""
        if len(self._shown) == 0:
            return torch.zeros(self._table.shape[1])
        count = self._peak_count()
        best = self._table.new_zeros(0, self._table.shape[1])
        for block in self._shown.split(1 << 16):
            scores = self.language.select(block).code_probabilities() @ self._table
            best = torch.cat([best, scores]).topk(min(count, len(best) + len(scores)), dim=0).values
        return best.mean(0)
