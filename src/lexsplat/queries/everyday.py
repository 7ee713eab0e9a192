"""A scale for cosines that comes from the scene itself: how well everyday words describe each code.

Encoders differ in where their cosines lie, in how far they spread, and in an offset of each word. Fixed numbers such
as a relevancy of 0.5 over a canonical phrase hold for one encoder at best. Here a prompt is compared with about a
thousand everyday words (``everyday_words.txt``), most of which any one scene lacks. With c_kp the cosine of code k
and text p,

    h_kp = (c_kp - mean of c_kw over all words w) - its 40th percentile over the codes

is the *height* of the text: the first difference removes what all texts share at a code, the second the offset of the
text, because most codes do not show it. Two ratios of heights have no unit and no offset left:

- h_kp over the best height of an everyday word at code k: whether another word describes the code better;
- h_kp over the text's own best height: whether another code fits the text better.

A code shows what a text names if both ratios exceed `BORDER`. The relevancy is a logistic function of the lesser one,
0.5 at the border. Everyday words name no color: "green apple" may exceed them all at a green bowl, where "green bowl"
describes more. So a thing with a color is also compared with the scene's objects in any color, and a part with its
thing. Presence (`lexsplat.queries.presence`) reads the same heights.

The constants were chosen on the second bundled scene with the bundled encoder and three encoders of
``benchmarks/web_like.py`` together (docs/selection.md). None depends on the encoder.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
import torch
from torch import Tensor

BORDER = 0.68
"""Ratio of heights at which the relevancy is 0.5."""
STEEPNESS = 12.0
"""Slope of the log-odds of the relevancy over the ratio."""

OFFSET = 0.4
"""Quantile over the codes at which a text counts as not shown."""
PEAK_SHARE = 0.04
"""The best height of a text is the mean over this share of the codes."""
_BEST_WORDS = 20  # everyday words whose peaks say how high the scene's own things reach
_LEAST = 1e-6


@lru_cache
def everyday_words() -> tuple[str, ...]:
    """About a thousand names of things, materials and parts."""
    return tuple((files("lexsplat.queries") / "everyday_words.txt").read_text("utf-8").split("\n")[:-1])


@dataclass(frozen=True, eq=False, repr=False)
class EverydayScale:
    """Scores of everyday words at the codes of a scene.

    Args:
        mean: Mean embedding of the words ``[D]``; its cosine with a code is the mean over the words.
        best: The best height of a word at each code ``[K]``.
        peak: Mean of the best heights of the 20 words that the codes show best.
    """

    mean: Tensor
    best: Tensor
    peak: float

    def __repr__(self) -> str:
        return f"EverydayScale({len(self.best)} codes, peak {self.peak:.3g})"

    @classmethod
    def of(cls, codewords: Tensor, words: Tensor) -> EverydayScale:
        """The scale of a codebook.

        Args:
            codewords: CLIP part of the codebook ``[K, D]``, of any length.
            words: Embeddings of everyday words ``[W, D]``, of any length, W > 0.
        """
        words = torch.nn.functional.normalize(words.to(codewords.device, torch.float32), dim=-1)
        mean = words.mean(0)
        heights = _heights(codewords, words, mean)
        reached = peaks(heights)
        count = min(_BEST_WORDS, len(reached))
        return cls(
            mean, heights.amax(1).clamp_min(_LEAST), max(float(reached.topk(count).values.mean()), _LEAST)
        )

    def heights(self, codewords: Tensor, texts: Tensor) -> Tensor:
        """Heights of texts ``[P, D]`` at the codes ``[K, D]``: ``[K, P]``."""
        return _heights(codewords, torch.nn.functional.normalize(texts.to(self.mean), dim=-1), self.mean)

    def relevancy(self, codewords: Tensor, texts: Tensor, best: Tensor | None = None) -> Tensor:
        """Relevancy in 0..1 of each code for each text ``[K, P]``.

        Args:
            codewords: CLIP part of the codebook ``[K, D]``, of any length.
            texts: Embeddings ``[P, D]``, of any length.
            best: Positive heights that each text is compared with at each code ``[K, P]``; None takes `best`, those
                of everyday words (`lexsplat.queries.presence.PresenceClassifier.best_heights` has others).
        """
        heights = self.heights(codewords, texts)
        own = heights / peaks(heights).clamp_min(_LEAST)
        ratio = torch.minimum(own, heights / (self.best[:, None] if best is None else best))
        return torch.sigmoid(STEEPNESS * (ratio - BORDER))


def _heights(codewords: Tensor, texts: Tensor, mean: Tensor) -> Tensor:
    codes = torch.nn.functional.normalize(codewords.float(), dim=-1)
    shared = codes @ (texts - mean).T
    return shared - _quantile(shared, OFFSET)


def _quantile(values: Tensor, share: float) -> Tensor:
    """``values.quantile(share, dim=0)`` of finite ``[K, P]``, bit for bit; on a CPU in a third of its time."""
    if not values.is_cpu or values.requires_grad or not values.numel():
        return values.quantile(share, dim=0)
    rank = torch.tensor(share, dtype=values.dtype) * (len(values) - 1)
    ranks = [int(rank), min(int(rank) + 1, len(values) - 1)]
    ordered = np.partition(np.ascontiguousarray(values.numpy().T), ranks, axis=1)
    below, above = (torch.from_numpy(ordered[:, place].copy()) for place in ranks)
    return below.lerp(above, rank - ranks[0])


def peaks(heights: Tensor) -> Tensor:
    """The best height ``[P]`` of texts, from their heights at the codes ``[K, P]``."""
    count = max(1, round(PEAK_SHARE * len(heights)))
    return heights.topk(count, dim=0).values.mean(0)
