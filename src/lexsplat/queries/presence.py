"""Presence: whether the scene holds the thing that a phrase names, without calibration to an encoder.

Every phrase has a best place in every scene, even if the object is absent. Presence is decided by how well the phrase
describes that place, on the scale of everyday words (`lexsplat.queries.everyday`):

- *ratio*: the height of the phrase there, over that of the everyday words that describe its codes best. At the teddy
  bear "giraffe" may score high, but "stuffed animal" scores higher;
- *height*: the height of the phrase there, over those that the scene's best described words reach at their places.

Places are the objects of the scene (`lexsplat.queries.objects`), found with everyday words: a stripe of a ball may
resemble a book, the ball does not. What names a part of a thing, such as "mug handle", is compared at segments of all
levels, only where the mug is described too, and is absent with the mug. A phrase with a color, such as "red apple",
is compared with the colors and names of the scene's objects: at a red mug, "red mug" describes more than "red apple".
A scene without segments is compared at the Gaussians that score best. ``benchmarks/selection.py`` measures the
decisions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.language.segment_codes import SegmentCodes, codes_of_field
from lexsplat.queries import part_names
from lexsplat.queries.everyday import BORDER, EverydayScale, everyday_words, peaks
from lexsplat.queries.objects import whole_segments
from lexsplat.queries.part_names import fits_of
from lexsplat.queries.selection import Presence
from lexsplat.queries.vocabulary import COLORS, has_color, is_part, thing_of_part

YES, NO = 0.74, 0.6
"""Strengths from which the answer is "yes", and below which it is "no"."""
YES_SEGMENT, YES_COLORED, YES_PART = 0.62, 0.82, 0.52
"""The former at objects, whose means are lower than peaks; for phrases with a color, which share the color or the
name with most of what they are confused with; and for parts where their thing is described. Chosen on the second
scene, with the bundled encoder and three of ``benchmarks/web_like.py``; those of "no" with six of them."""
NO_SEGMENT, NO_PART = 0.5, 0.4
"""Lower borders of "no" at objects, for phrases without a color, and for parts where their thing is described."""
AT_THING = 0.3
"""Strength of its thing at a place that may be a part of it."""

BORDER_PART, OVER_THING = 0.72, 1.05
"""Ratios of heights at which the relevancy of a part is 0.5, instead of `BORDER`: over everyday words, and over its
thing. Chosen on the second scene with the bundled encoder, two ways to crop and three codebooks, and checked with six
encoders of ``benchmarks/web_like.py``."""

PEAK_SHARE = 5e-4
PEAK_COUNT = 20
"""A peak is the mean of the best 0.05 percent of the Gaussians, and of at least this many."""
FAINT = 0.1
"""Gaussians of lower opacity do not count."""
_LEAST = 1e-6


@dataclass(frozen=True)
class Evidence:
    """Evidence that the scene holds a phrase (see the module).

    Args:
        ratio: Height at the best place over that of the best everyday words at its codes.
        height: Height at the best place over those of the scene's best described words.
        yes: Strength from which the answer is "yes".
        no: Strength below which it is "no".
    """

    ratio: float
    height: float
    yes: float = YES
    no: float = NO

    @property
    def strength(self) -> float:
        """Geometric mean of the ratio and the lesser of the two, at least 0."""
        return math.sqrt(max(0.0, self.ratio) * max(0.0, min(self.ratio, self.height)))

    @property
    def presence(self) -> Presence:
        """Whether the scene holds the phrase: "yes", "no" or "unsure"."""
        return "yes" if self.strength >= self.yes else "no" if self.strength < self.no else "unsure"


class DescribedPlaces(NamedTuple):
    """Where presence is decided.

    Args:
        distributions: The scene's objects, what no everyday word describes, and the things that are listed, as
            distributions ``[V, K]``.
        words: The everyday words that describe the objects best.
    """

    distributions: Tensor
    words: tuple[str, ...]


class PresenceClassifier:
    """Compares phrases with everyday words in one scene.

    Args:
        gaussians: The geometry of the scene.
        language: Its language.
        scale: Scores of everyday words in it.
        embed: Texts to embeddings ``[T, D]``.
        places: `places` of an earlier classifier of the same scene; None computes them when they are needed.
        things: Distributions of the things that the scene lists ``[V, K]``; None lists none.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        language: LanguageField,
        scale: EverydayScale,
        embed: Callable[[Sequence[str]], Tensor],
        places: DescribedPlaces | None = None,
        things: Callable[[], Tensor] | None = None,
    ) -> None:
        self.language, self.scale, self._embed, self._things = language, scale, embed, things
        self._shown = (gaussians.opacities >= FAINT).detach().nonzero()[:, 0]
        if places is not None:
            self.places = places

    @cached_property
    def segment_codes(self) -> SegmentCodes | None:
        """The language of the segments; None if the field has none or nothing is shown."""
        segments = self.language.segments
        if segments is None or len(self._shown) == 0:
            return None
        return codes_of_field(self.language, segments)

    @torch.no_grad()
    def best_heights(self, phrases: Sequence[str]) -> Tensor:
        """Heights that phrases are compared with at each code ``[K, P]``.

        They are those of everyday words and, for things with a color, of the scene's objects in any color. Parts are
        also compared with their thing, or a mug would be as good a "mug handle" as its handle.
        """
        found = [(self._best(phrase), thing_of_part(phrase)) for phrase in phrases]
        best = [
            self._beside(thing, phrase, best) if thing else best
            for phrase, (best, thing) in zip(phrases, found)
        ]
        return torch.stack(best, dim=1)

    @torch.no_grad()
    def evidence(self, phrases: Sequence[str], texts: Tensor, scores: Tensor) -> list[Evidence]:
        """Evidence for phrases.

        Args:
            phrases: The phrases.
            texts: Their embeddings ``[P, D]``, of any length.
            scores: Their relevancies ``[P, N]``; read where the field has no segments.
        """
        if len(self._shown) == 0:
            return [Evidence(0.0, 0.0)] * len(texts)
        heights = self.scale.heights(self.language.codebook.clip, texts)
        found = []
        for number, phrase in enumerate(phrases):
            yes, no = YES, NO
            if self.language.segments is None:
                places = self._peak(scores[number])[None]
            elif is_part(phrase) and (codes := self.segment_codes) is not None:
                places, yes, no = codes.distributions, YES_SEGMENT, NO_SEGMENT
                if thing := thing_of_part(phrase):
                    places, yes, no = self._at_thing(thing, places), YES_PART, NO_PART
                if not len(places):
                    found.append(Evidence(0.0, 0.0, yes, no))
                    continue
            else:
                places = self.places.distributions
                yes, no = (YES_COLORED, NO) if has_color(phrase) else (YES_SEGMENT, NO_SEGMENT)
            ratios, reached = self._compared(heights[:, number : number + 1], places, self._best(phrase))
            place = _strength(ratios, reached)[:, 0].argmax()
            found.append(Evidence(float(ratios[place]), float(reached[place]), yes, no))
        return found

    @property
    def tables(self) -> dict[str, Tensor]:
        """Tables for pages: distributions ``[V, K]`` of objects, and the best heights for colors ``[K]``."""
        return {"places": self.places.distributions, "best_colored": self._best_colored}

    def strengths(self, texts: Tensor, places: Tensor) -> NDArray[np.float64]:
        """`Evidence.strength` of phrases ``[P, D]`` at places with distributions ``[V, K]``: ``[V, P]``."""
        heights = self.scale.heights(self.language.codebook.clip, texts)
        return np.asarray(_strength(*self._compared(heights, places, self.scale.best)).cpu().double().numpy())

    def classify(self, phrases: Sequence[str], texts: Tensor, scores: Tensor) -> tuple[Presence, ...]:
        """Whether the scene holds each phrase; the arguments are those of `evidence`."""
        return tuple(evidence.presence for evidence in self.evidence(phrases, texts, scores))

    @cached_property
    def places(self) -> DescribedPlaces:
        """The segments that everyday words describe as wholes, and those words; and listed things.

        A thing is listed without the strip of cloth that its segment has, and so it is more like its name.
        """
        codes, words = self.segment_codes, everyday_words()
        if codes is None:
            return DescribedPlaces(torch.zeros(0, len(self.language.codebook.clip)), ())
        texts = self._embed(words)
        whole = whole_segments(
            codes, lambda part: self.strengths(texts[part], codes.distributions), [False] * len(words)
        )
        # What no word describes takes part with its lowest segments.
        places = np.unique(np.where(whole.places < 0, codes.numbers[0], whole.places))
        named = whole.words[np.unique(whole.places[whole.places >= 0])]
        found = codes.distributions[torch.from_numpy(places)]
        if self._things is not None:
            found = torch.cat([found, self._things().to(found)])
        return DescribedPlaces(found, tuple(dict.fromkeys(words[word] for word in named)))

    @property
    def colored(self) -> list[str]:
        """The scene's objects in any color, as phrases."""
        return [f"{color} {name}" for color in sorted(COLORS) for name in self.places.words]

    @cached_property
    def part_fits(self) -> Tensor:
        """How well the names of parts fit the codes ``[K, W]`` (`lexsplat.queries.part_names`)."""
        return fits_of(self.scale.heights(self.language.codebook.clip, self._embed(part_names.NAMES)))

    @cached_property
    def _best_colored(self) -> Tensor:
        """The best height at each code ``[K]`` of everyday words and of the scene's objects in any color."""
        phrases = self.colored
        if not phrases:
            return self.scale.best
        heights = self.scale.heights(self.language.codebook.clip, self._embed(phrases))
        return torch.maximum(self.scale.best, heights.amax(1))

    def _best(self, phrase: str) -> Tensor:
        """The heights ``[K]`` that a phrase is compared with."""
        return self._best_colored if has_color(phrase) and not is_part(phrase) else self.scale.best

    def _beside(self, thing: str, part: str, best: Tensor) -> Tensor:
        """The heights ``[K]`` that a part is compared with, from those of everyday words.

        A code shows the part where it reaches a larger share of its best height than its thing does there.
        """
        heights = self.scale.heights(self.language.codebook.clip, self._embed([part, thing]))
        reached = peaks(heights).clamp_min(_LEAST)
        thing_at_best = heights[:, 1].clamp_min(_LEAST) * reached[0] / reached[1]
        return torch.maximum(BORDER_PART * best, OVER_THING * thing_at_best) / BORDER

    def _compared(self, heights: Tensor, places: Tensor, best: Tensor) -> tuple[Tensor, Tensor]:
        """Ratios and heights of phrases at places ``[V, P]`` each, from their heights at the codes ``[K, P]``."""
        places = places.to(heights)
        reached = places @ heights
        return reached / (places @ best).clamp_min(_LEAST)[:, None], reached / self.scale.peak

    def _at_thing(self, thing: str, places: Tensor) -> Tensor:
        """The places ``[V', K]`` where a thing is described; none where the scene does not hold it."""
        heights, best = (
            self.scale.heights(self.language.codebook.clip, self._embed([thing])),
            self._best(thing),
        )
        at_objects, at_places = (
            _strength(*self._compared(heights, each, best))[:, 0]
            for each in (self.places.distributions, places)
        )
        return places[(at_places >= AT_THING) & (at_objects >= NO_SEGMENT).any()]

    def _peak(self, scores: Tensor) -> Tensor:
        """Mean distribution ``[K]`` over the codes of the Gaussians that score best."""
        count = min(len(self._shown), max(PEAK_COUNT, int(PEAK_SHARE * len(self._shown))))
        best = self._shown[scores.to(self._shown.device)[self._shown].topk(count).indices]
        return self.language.select(best).code_probabilities().mean(0)


def _strength(ratios: Tensor, heights: Tensor) -> Tensor:
    return (ratios.clamp_min(0) * torch.minimum(ratios, heights).clamp_min(0)).sqrt()
