"""The language of the bundled encoder: phrases, and the labels for which each is true. Needs numpy only.

A phrase is true, false, or open (neither: training skips it) of a `Label`, which is what a pixel shows: a
thing's kind, color and finish, and which part of it. Whether a phrase names what a crop shows follows from
the pixels around the crop's middle, see `crops.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from vocabulary import (
    COLORS,
    HELD_OUT_PAIRS,
    IN_ITS_COLOR,
    NAMES,
    NEAR,
    NO_ONE_COLOR,
    OTHER_WORDS,
    OWNERS,
    PARTS,
    QUALITIES,
    SYNONYMS,
    UNKNOWN_TRAINED,
    Quality,
)


@dataclass(frozen=True)
class Label:
    """The label of a pixel."""

    kind: str
    color: str
    finish: str | None = None
    part: str | None = None


TEMPLATES = (
    "{}",
    "a photo of {}",
    "an image of {}",
    "a picture of {}",
    "a close up of {}",
    "a cropped photo of {}",
    "there is {} in the scene",
    "a render of {}",
)

TRUE, FALSE, OPEN = 1, 0, -1

_KNOWN_WORDS = frozenset(
    word
    for group in (
        NAMES, SYNONYMS, PARTS, COLORS, {"": OTHER_WORDS},
        {key: (*quality.phrases, *quality.adjectives) for key, quality in QUALITIES.items()},
    )
    for phrases in group.values()
    for phrase in phrases
    for word in phrase.split()
)  # fmt: skip


@dataclass(frozen=True)
class Phrase:
    """Words and their meaning; None means anything.

    Args:
        words: As a user would type them.
        kind: Key of ``NAMES``.
        color: Key of ``COLORS``.
        quality: Key of ``QUALITIES``.
        part: Key of ``PARTS``.
        unknown: Whether it names something that no scene holds.
    """

    words: str
    kind: str | None = None
    color: str | None = None
    quality: str | None = None
    part: str | None = None
    unknown: bool = False

    def of(self, label: Label) -> int:
        """``TRUE``, ``FALSE`` or ``OPEN`` of a label."""
        if self.unknown:
            return FALSE
        answers = []
        if self.kind is not None:
            answers.append(TRUE if self.kind == label.kind else FALSE)
        if self.part is not None:
            answers.append(TRUE if self.part == label.part else FALSE)
        if self.quality is not None:
            answers.append(_has_quality(QUALITIES[self.quality], label))
        if self.color is not None:
            # A name with a color is about the whole thing; a color alone is about what is seen.
            whole = self.kind is not None and self.part is None
            answers.append(_has_color(self.color, label, whole))
        if FALSE in answers:
            return FALSE
        return OPEN if OPEN in answers else TRUE


def _has_quality(quality: Quality, label: Label) -> int:
    terms = {label.kind, f"{label.kind}:{label.finish}", f"{label.kind}.{label.part}"}
    if terms & set(quality.of):
        return TRUE
    return OPEN if terms & set(quality.open) else FALSE


def _has_color(color: str, label: Label, whole: bool) -> int:
    if label.kind in NO_ONE_COLOR:
        return OPEN
    if not whole and label.part is not None and label.part not in IN_ITS_COLOR:
        return OPEN
    if not whole and label.kind in ("plant", "lamp") and label.part is None:
        return OPEN  # soil and bulb
    if color == label.color:
        return TRUE
    if frozenset((color, label.color)) in NEAR:
        return OPEN
    if label.kind in ("ball", "cloth", "cone", "wall"):  # a second color shows
        return FALSE if whole else OPEN
    return FALSE


def with_article(words: str, rng: np.random.Generator) -> str:
    """``words`` with "a", "an", "the" or nothing before it."""
    if words.startswith(("a ", "some")) or words.endswith("s") or rng.random() > 0.7:
        return words
    if rng.random() < 0.25:
        return f"the {words}"
    return f"an {words}" if words[0] in "aeiou" else f"a {words}"


def in_sentence(phrase: Phrase, rng: np.random.Generator, plain: float = 0.5) -> str:
    """The phrase as typed, with probability ``plain``, or within a sentence."""
    if rng.random() < plain:
        return phrase.words
    return TEMPLATES[int(rng.integers(len(TEMPLATES)))].format(with_article(phrase.words, rng))


def phrase_for(label: Label, rng: np.random.Generator) -> Phrase:
    """A phrase that is true of the label."""
    for _ in range(20):
        phrase = _random_phrase(label.kind, label.color, label.part, rng)
        if phrase.of(label) == TRUE:
            return phrase
    return Phrase(_pick(NAMES[label.kind], rng), kind=label.kind)


def near_miss(label: Label, rng: np.random.Generator) -> Phrase:
    """A phrase that is close to the label but false: another color, kind or part."""
    draw = rng.random()
    kind, color, part = label.kind, label.color, label.part
    if draw < 0.4:
        color = _pick(tuple(c for c in COLORS if (kind, c) not in HELD_OUT_PAIRS), rng)
        return colored(kind, color, rng)
    if draw < 0.7:
        kind = _pick(tuple(k for k in NAMES if (k, color) not in HELD_OUT_PAIRS), rng)
        return colored(kind, color, rng)
    if draw < 0.85:
        parts = tuple(known for known, owners in OWNERS.items() if kind in owners)
        if parts:
            return _part_phrase(kind, _pick(parts, rng), rng)
    return _random_phrase(kind, _pick(tuple(COLORS), rng), part, rng)


def any_phrase(rng: np.random.Generator) -> Phrase:
    """Any phrase, also of objects that no image shows."""
    if rng.random() < 0.3:
        word = _pick(UNKNOWN_TRAINED, rng) if rng.random() < 0.6 else _made_up_word(rng)
        color = f"{_pick(tuple(COLORS), rng)} " if rng.random() < 0.4 else ""
        return Phrase(color + word, unknown=True)
    return _random_phrase(_pick(tuple(NAMES), rng), _pick(tuple(COLORS), rng), None, rng)


def colored(kind: str, color: str, rng: np.random.Generator) -> Phrase:
    """A name of the kind after a word for the color."""
    words = f"{_pick(COLORS[color], rng)} {_pick(NAMES[kind], rng)}"
    return Phrase(words, kind=kind, color=color)


def parallelogram(rng: np.random.Generator) -> list[str]:
    """Two kinds in two colors, as texts (k c, k d, l c, l d): what sets colors apart should not hang on the kind.

    Pairs that training images lack are among them: their words may be read, what they look like may not be seen.
    """
    kind, other = rng.choice([name for name in NAMES if name not in NO_ONE_COLOR], 2, replace=False)
    color, tint = rng.choice(list(COLORS), 2, replace=False)
    return [f"{c} {NAMES[str(k)][0]}" for k in (kind, other) for c in (color, tint)]


def _part_phrase(kind: str, part: str, rng: np.random.Generator) -> Phrase:
    name, word, form = _pick(NAMES[kind], rng), _pick(PARTS[part], rng), rng.random()
    if form < 0.55:
        return Phrase(f"{name.split()[-1]} {word}", kind=kind, part=part)
    if form < 0.75:
        return Phrase(word, part=part)
    return Phrase(f"{word} of {with_article(name, rng)}", kind=kind, part=part)


def any_part(rng: np.random.Generator, handles: int = 1) -> Phrase:
    """A phrase about any part of anything that has it; ``handles`` times as often as any other about a handle."""
    part = _pick(tuple(part for part in OWNERS for _ in range(handles if part == "handle" else 1)), rng)
    return _part_phrase(_pick(OWNERS[part], rng), part, rng)


_ONSETS = (*"bcdfghklmnprstvw", "br", "cl", "dr", "fl", "gr", "pl", "sh", "st", "tr")
_VOWELS, _CODAS = (*"aeiou", "ea", "oo", "ai"), tuple("nrltkms")


def _made_up_word(rng: np.random.Generator) -> str:
    """A made-up word: unknown words should match nothing."""
    while True:
        count = int(rng.integers(1, 4))
        word = "".join(_pick(_ONSETS, rng) + _pick(_VOWELS, rng) for _ in range(count)) + _pick(_CODAS, rng)
        if word not in _KNOWN_WORDS:
            return word


def _random_phrase(kind: str, color: str, part: str | None, rng: np.random.Generator) -> Phrase:
    """A phrase of a random form about these."""
    name, tint = _pick(NAMES[kind], rng), _pick(COLORS[color], rng)
    if part is None and rng.random() < 0.08:
        parts = [known for known, owners in OWNERS.items() if kind in owners]
        part = _pick(tuple(parts), rng) if parts else None
    if part is not None and part in PARTS and rng.random() < 0.7:
        return _part_phrase(kind, part, rng)
    form = rng.random()
    if form < 0.3 or (form < 0.66 and (kind, color) in HELD_OUT_PAIRS):
        # As the name of a held-out pair could only be wrong, it would be learnt as the name of nothing.
        return Phrase(name, kind=kind)
    if form < 0.66:
        return Phrase(f"{tint} {name}", kind=kind, color=color)
    if form < 0.75:
        words = _pick((f"something {tint}", tint, f"{tint} thing", f"{tint} object"), rng)
        return Phrase(words, color=color)
    quality = _pick(tuple(QUALITIES), rng)
    mine = [
        key
        for key, value in QUALITIES.items()
        if any(term.split(":")[0].split(".")[0] == kind for term in value.of)
    ]
    if mine and rng.random() < 0.8:
        quality = _pick(tuple(mine), rng)
    wanted = QUALITIES[quality]
    if wanted.adjectives and rng.random() < 0.45:
        adjective = _pick(wanted.adjectives, rng)
        if adjective not in name:
            return Phrase(f"{adjective} {name}", kind=kind, quality=quality)
    return Phrase(_pick(wanted.phrases, rng), quality=quality)


def _pick(options: tuple[str, ...], rng: np.random.Generator) -> str:
    return options[int(rng.integers(len(options)))]
