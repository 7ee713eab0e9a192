"""Is it there at all? A calibrated "not in this scene".

The best place in a scene for a phrase always exists, however absent the thing. What tells is how good that place
is, and how it compares with what *other words* reach. `REFERENCE_PHRASES` are everyday things, most of which any one
scene lacks; their best places are a scale that follows how high the relevancies of an encoder run.

- *peak*: the relevancy where the phrase answers best. A calibrated encoder is over 0.5 only for what is there;
- *height*: the phrase's peak relevancy, in robust standard deviations above the peaks of the reference phrases;
- *rank*: the share of the reference phrases that score lower than the phrase where it peaks. At the teddy bear
  "giraffe" may score high, but "stuffed animal" scores higher.

A logistic function of the three gives the probability; `CALIBRATION` was fitted on the second demo scene alone by
``benchmarks/selection.py`` (docs/selection.md), which prints new numbers when encoders change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.queries.relevancy import QueryConfig, code_relevancy, gaussian_relevancy
from lexsplat.queries.selection import Presence
from lexsplat.queries.thresholds import BORDER, scene_threshold

REFERENCE_PHRASES = (
    "chair", "bed", "window", "door", "computer", "telephone", "television", "clock", "shoe", "hat", "umbrella",
    "bicycle", "airplane", "ship", "train", "horse", "dog", "cat", "bird", "fish", "elephant", "tree", "flower",
    "bread", "cheese", "pizza", "cake", "carrot", "knife", "spoon", "plate", "basket", "guitar", "piano", "drum",
    "hammer", "scissors", "key", "camera", "pillow", "curtain", "mirror", "stairs", "bridge", "castle", "river",
    "cloud", "person", "hand", "glove", "backpack", "suitcase", "bottle", "book", "ball", "toy", "lamp", "fruit",
)  # fmt: skip
"""Everyday things; more than half of them are missing from nearly any scene, which is all that is asked of them."""

_PEAK_SHARE = 5e-4
_PEAK_COUNT = 20
"""A peak is the mean of the best 0.05 percent of the Gaussians, and of at least this many."""
_FAINT = 0.1


@dataclass(frozen=True)
class Evidence:
    """What speaks for a phrase (see the module).

    Args:
        height: Robust standard deviations above the reference peaks.
        rank: Share of reference phrases that score lower at its peak, in 0..1.
        peak: Relevancy at its peak, in 0..1.
    """

    height: float
    rank: float
    peak: float = 0.5

    def values(self) -> list[float]:
        """What the log-odds are linear in: bounded, and the peak by its own log-odds."""
        peak = min(1 - 1e-3, max(1e-3, self.peak))
        return [1.0, min(10.0, max(-5.0, self.height)), self.rank, math.log(peak / (1 - peak))]


@dataclass(frozen=True)
class Calibration:
    """How evidence becomes an answer.

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
        """That the thing is in the scene, 0..1."""
        weights = (self.bias, self.height, self.rank, self.peak)
        logit = sum(weight * value for weight, value in zip(weights, evidence.values()))
        return 1 / (1 + math.exp(-max(-60.0, min(60.0, logit))))

    def judge(self, evidence: Evidence) -> Presence:
        """ "yes", "no" or "unsure"."""
        probability = self.probability(evidence)
        return "yes" if probability >= self.yes else "no" if probability <= self.no else "unsure"


CALIBRATION = Calibration(bias=-1.869, height=0.0, rank=0.353, yes=0.457, no=0.457, peak=3.32)


class PresenceClassifier:
    """Compares phrases with the reference phrases in one scene.

    Args:
        gaussians: The scene.
        language: Its language.
        references: Text embeddings of `REFERENCE_PHRASES` ``[V, D]``.
        negatives: Text embeddings of the canonical phrases ``[M, D]``.
        temperature: See `lexsplat.queries.relevancy.QueryConfig`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        language: LanguageField,
        references: Tensor,
        negatives: Tensor,
        temperature: float,
    ) -> None:
        self.language = language
        self._shown = (gaussians.opacities >= _FAINT).detach().nonzero()[:, 0]
        codewords = language.codebook.clip.to(gaussians.device)
        self._table = code_relevancy(codewords, references, negatives, temperature)
        peaks = self._reference_peaks()
        middle = peaks.median()
        # 1.4826 makes the median deviation that of a normal distribution.
        self._middle, self._spread = float(middle), float((peaks - middle).abs().median()) * 1.4826

    def evidence(self, scores: Tensor) -> Evidence:
        """What speaks for a phrase with relevancies ``scores [N]`` (form "code")."""
        if len(self._shown) == 0:
            return Evidence(-5.0, 0.0, 0.0)
        best = scores.to(self._shown.device)[self._shown].topk(self._peak_count())
        region = self._shown[best.indices]
        there = (self.language.select(region).code_probabilities() @ self._table).mean(0)
        peak = float(best.values.mean())
        height = (peak - self._middle) / max(self._spread, 1e-4)
        return Evidence(height, float((there < peak).float().mean()), peak)

    def judge(self, scores: Tensor) -> Presence:
        """Whether the scene has what the scores are for."""
        return CALIBRATION.judge(self.evidence(scores))

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


def found_thresholds(
    judge: PresenceClassifier,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    positives: Tensor,
    negatives: Tensor,
    config: QueryConfig | None = None,
) -> Tensor:
    """The automatic threshold ``[P]`` of each prompt: `thresholds.scene_threshold`, and 0.5 for what is not there.

    What is not in the scene has no two classes that could be told apart: an automatic cut would mark whatever is a
    little less unlike the prompt than the rest, such as the whole table for a mug's handle that the encoder does
    not see. At 0.5, where a canonical phrase is as near as the prompt, next to nothing is marked. What the judge
    is "unsure" of keeps its cut: a guess that is shown with the doubt beside it helps more than an empty picture.

    Every mask and selection of lexsplat takes its threshold from here: query, find, edit, export, viewer, evaluation.

    Args:
        judge: Says what is in the scene; it holds the scene's language.
        gaussians: The scene.
        cameras: See `thresholds.scene_threshold`: views that are not evaluated.
        positives: Text embeddings of the prompts ``[P, D]``.
        negatives: Text embeddings of the canonical phrases ``[M, D]``.
        config: Form, temperature, coverage.
    """
    found = scene_threshold(judge.language, gaussians, cameras, positives, negatives, config)
    scores = gaussian_relevancy(judge.language, positives, negatives, config)
    absent = torch.tensor([judge.judge(row) == "no" for row in scores], dtype=torch.bool)
    return torch.where(absent, torch.full_like(found, BORDER), found)


def fit_calibration(
    present: list[Evidence], absent: list[Evidence], *, recall: float = 0.9, false_positives: float = 0.1
) -> Calibration:
    """Logistic regression with a little shrinkage (there are few phrases), and limits from the phrases themselves.

    "no" ends where ``recall`` of the present phrases lies above; "yes" begins where at most ``false_positives`` of
    the absent ones do. Where these cross, both are their mean, and nothing is "unsure".

    Raises:
        ValueError: If there is no example of either kind.
    """
    if not present or not absent:
        raise ValueError("a calibration needs phrases that are present and phrases that are absent")
    rows = [evidence.values() for evidence in (*present, *absent)]
    x = torch.tensor(rows, dtype=torch.float64)
    y = torch.tensor([1.0] * len(present) + [0.0] * len(absent), dtype=torch.float64)
    share = torch.where(y > 0, 0.5 / len(present), 0.5 / len(absent)) * len(y)
    weights = _logistic_weights(x, y, share)
    p = torch.sigmoid(x @ weights)
    low = float(torch.quantile(p[y > 0], 1 - recall))
    high = float(torch.quantile(p[y == 0], 1 - false_positives))
    if high <= low:
        low = high = (low + high) / 2
    bias, height, rank, peak = (round(float(w), 3) for w in weights)
    return Calibration(bias, height, rank, yes=round(high, 3), no=round(low, 3), peak=peak)


def _logistic_weights(x: Tensor, y: Tensor, share: Tensor) -> Tensor:
    """Weights ``[4]`` of a logistic regression, none of the evidence counting against a phrase.

    A weight that comes out negative has been fitted to chance (more evidence never means less): it is set to zero
    and the others are fitted again.
    """
    used = [0, 1, 2, 3]
    while True:
        columns = x[:, used]
        eye = torch.eye(len(used), dtype=torch.float64)
        penalty = 0.1 * eye
        penalty[0, 0] = 0.0
        found = torch.zeros(len(used), dtype=torch.float64)
        for _ in range(50):  # Newton's method
            p = torch.sigmoid(columns @ found)
            gradient = columns.T @ (share * (p - y)) + penalty @ found
            hessian = columns.T @ (columns * (share * p * (1 - p))[:, None]) + penalty + 1e-9 * eye
            found = found - torch.linalg.solve(hessian, gradient)
        kept = [place for place, weight in zip(used, found.tolist()) if place == 0 or weight >= 0]
        if kept == used:
            weights = torch.zeros(4, dtype=torch.float64)
            weights[used] = found
            return weights
        used = kept
