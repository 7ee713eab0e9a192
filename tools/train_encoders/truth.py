"""Which phrases are true of which crops, from the weighted labels of the crops. Needs numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from crops import GRID, Crop
from numpy.typing import NDArray
from words import FALSE, OPEN, TRUE, Label, Phrase

SHOWS, SHOWS_PART = 0.45, 0.25
"""A phrase is true of a crop if what it names has this share of the weight."""
LACKS, LACKS_PART = 0.15, 0.04
"""It is false if what it names, or may name, has less than this; between the two it is open."""
HALF, EIGHTH = 0.5, 0.125
"""The same two of a patch, of which everything weighs the same."""
CENTER = 0.1
"""With this share of the weight a part is shown if it also lies in the very middle."""
BESIDE = 0.15
"""With less than this share of the weight a part that is not in the very middle is only beside what is shown."""


class TruthTable:
    """Truth of phrases for the labels of some frames; equal meanings are computed once.

    Args:
        labels: All labels that occur.
        center: Whether a part is also true of a crop whose middle it is, with ``CENTER`` of the weight. A handle
            is thin: in a crop that also shows what it belongs to, it never has a quarter of the weight.
        beside: A part with less of the weight, and not in the middle, is false of a crop instead of open. Where
            it is open, what lies around a part answers like the part itself, and the best place is any of these.
    """

    def __init__(self, labels: Sequence[Label], *, center: bool = False, beside: float = LACKS_PART) -> None:
        self.labels = list(labels)
        self.center, self.beside = center, beside
        self._known: dict[tuple, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}

    def _columns(self, phrase: Phrase) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The labels for which the phrase is true, and those for which it is not false."""
        meaning = (phrase.kind, phrase.color, phrase.quality, phrase.part, phrase.unknown)
        if meaning not in self._known:
            answers = np.array([phrase.of(label) for label in self.labels])
            self._known[meaning] = (answers == TRUE, answers != FALSE)
        return self._known[meaning]

    def _shares(
        self, phrases: Sequence[Phrase], crops: Sequence[Crop], shown: NDArray[np.integer]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The weight of what each phrase is true of, and of what it may be true of ``[len(crops), len(phrases)]``.

        Args:
            phrases: The phrases.
            crops: The crops, or patches of them.
            shown: Rising codes, of all labels or of those that occur in the crops, so that few patches are quick.
        """
        weights = np.zeros((len(crops), len(shown)), np.float32)
        for row, crop in enumerate(crops):
            weights[row, np.searchsorted(shown, crop.codes)] = crop.weights
        columns = [self._columns(phrase) for phrase in phrases]
        true, possible = (
            weights @ np.stack([column[which][shown] for column in columns], 1).astype(np.float32)
            for which in (0, 1)
        )
        return true, possible

    def of(self, phrases: Sequence[Phrase], crops: Sequence[Crop]) -> NDArray[np.int8]:
        """``TRUE``, ``FALSE`` or ``OPEN`` of each phrase and crop ``[len(crops), len(phrases)]``."""
        true, possible = self._shares(phrases, crops, np.arange(len(self.labels)))
        is_part = np.array([phrase.part is not None for phrase in phrases])
        shows = np.where(is_part, SHOWS_PART, SHOWS)
        lacks = np.where(is_part, LACKS_PART, LACKS)
        if self.center:
            middle = np.array([crop.grid[GRID // 2, GRID // 2] for crop in crops])
            answers = np.stack([self._columns(phrase)[0] for phrase in phrases], 1)
            centered = is_part & answers[middle] & (middle >= 0)[:, None]
            shows = np.where(centered, CENTER, shows)
            lacks = np.where(is_part & ~centered, self.beside, lacks)
        return np.where(true >= shows, TRUE, np.where(possible < lacks, FALSE, OPEN)).astype(np.int8)

    def at_places(self, phrases: Sequence[Phrase], patches: Sequence[Crop]) -> NDArray[np.int8]:
        """The same of single patches (`crops.patch_crop`) ``[len(patches), len(phrases)]``.

        A phrase is true with ``HALF`` of the patch or more, false with an ``EIGHTH`` or less, else open.
        """
        shown = np.unique(np.concatenate([patch.codes for patch in patches]))
        true, possible = self._shares(phrases, patches, shown)
        return np.where(true >= HALF, TRUE, np.where(possible <= EIGHTH, FALSE, OPEN)).astype(np.int8)
