"""Whether the scene holds what a phrase names: a "not in this scene" that needs no fit to an encoder.

Every phrase has a best place in every scene, even if the object is absent. Presence is decided by how well the phrase
describes that place, on the scale of everyday words (`lexsplat.queries.everyday`):

- *ratio*: the height of the phrase there, over that of the everyday word that describes the place best. At the teddy
  bear "giraffe" may score high, but "stuffed animal" scores higher;
- *height*: the height of the phrase there, over those that the scene's best described words reach at their places.

The answer depends on their geometric mean. ``benchmarks/selection.py`` measures it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.queries.everyday import EverydayScale
from lexsplat.queries.selection import Presence

YES, NO = 0.74, 0.6
"""Strengths from which the answer is "yes", and below which it is "no"."""

_PEAK_SHARE = 5e-4
_PEAK_COUNT = 20
"""A peak is the mean of the best 0.05 percent of the Gaussians, and of at least this many."""
_FAINT = 0.1
"""Gaussians of lower opacity do not count."""


@dataclass(frozen=True)
class Evidence:
    """Evidence that the scene holds a phrase (see the module).

    Args:
        ratio: Height at the best place over that of the best everyday word there.
        height: Height at the best place over those of the scene's best described words.
    """

    ratio: float
    height: float

    @property
    def strength(self) -> float:
        """Geometric mean of the two, at least 0."""
        return math.sqrt(max(0.0, self.ratio) * max(0.0, self.height))

    @property
    def presence(self) -> Presence:
        """Whether the scene holds the phrase: "yes", "no" or "unsure"."""
        return "yes" if self.strength >= YES else "no" if self.strength < NO else "unsure"


class PresenceClassifier:
    """Compares phrases with everyday words in one scene.

    Args:
        gaussians: The geometry of the scene.
        language: Its language.
        scale: What everyday words reach in it.
    """

    def __init__(self, gaussians: Gaussians, language: LanguageField, scale: EverydayScale) -> None:
        self.language, self.scale = language, scale
        self._shown = (gaussians.opacities >= _FAINT).detach().nonzero()[:, 0]

    @torch.no_grad()
    def evidence(self, texts: Tensor, scores: Tensor) -> list[Evidence]:
        """Evidence for phrases.

        Args:
            texts: Their embeddings ``[P, D]``, of any length.
            scores: Their scores ``[P, N]``; each phrase is judged at the Gaussians that score best.
        """
        if len(self._shown) == 0:
            return [Evidence(0.0, 0.0)] * len(texts)
        codewords = self.language.codebook.clip.to(self._shown.device)
        heights = self.scale.heights(codewords, texts)
        count = min(len(self._shown), max(_PEAK_COUNT, int(_PEAK_SHARE * len(self._shown))))
        found = []
        for row, height in zip(scores.to(self._shown.device), heights.T):
            region = self._shown[row[self._shown].topk(count).indices]
            place = self.language.select(region).code_probabilities().mean(0)
            reached = float(place @ height)
            best = max(float(place @ self.scale.best), 1e-6)
            found.append(Evidence(reached / best, reached / self.scale.peak))
        return found

    def classify(self, texts: Tensor, scores: Tensor) -> tuple[Presence, ...]:
        """Whether the scene holds each phrase; the arguments are those of `evidence`."""
        return tuple(evidence.presence for evidence in self.evidence(texts, scores))
