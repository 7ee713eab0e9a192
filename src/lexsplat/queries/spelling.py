"""Words: singulars, and typing errors against a vocabulary. simplemma has the dictionary."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from functools import lru_cache

_SAME_FORM = {"glass", "cloth", "cutlery", "stairs", "people", "scissors", "trousers", "clothes", "pants"}
_NOT_BY_LEMMA = {"leaves": "leaf", "shelves": "shelf", "lenses": "lens"}
"""Plurals that simplemma takes for verbs, or has under a rare spelling."""
_ALIKE = 0.74
"""Smallest similarity of a word and its typing error (`difflib`): two letters of four changed places."""


def singular(words: str) -> str:
    """The head of a noun phrase in the singular: the last word, or the last before " of "."""
    head, of, rest = words.partition(" of ")
    before, space, last = head.rpartition(" ")
    if not re.fullmatch(r"[A-Za-z]{3,}", last):
        return words
    return before + space + _singular_word(last) + of + rest


@lru_cache(4096)
def _singular_word(word: str) -> str:
    small = word.lower()
    if small in _SAME_FORM or small.endswith(("ss", "us", "is")):
        return word
    lemma = _NOT_BY_LEMMA.get(small)
    if lemma is None:
        if not small.endswith("s") and small not in _IRREGULAR:
            return word
        import simplemma

        lemma = simplemma.lemmatize(small, lang="en")
    if lemma == small:
        return word
    return word[: len(lemma)] if word.lower().startswith(lemma) else lemma


_IRREGULAR = {"men", "women", "children", "mice", "geese", "teeth", "feet", "oxen", "dice"}
"""Plurals without an s; other words keep their form, as their lemma may be a verb's ("burning")."""


def is_word(word: str) -> bool:
    """Whether a word is in the English dictionary."""
    import simplemma

    return bool(simplemma.is_known(word.lower(), lang="en"))


def strange(phrase: str, vocabulary: Iterable[str]) -> list[str]:
    """The words of a phrase that are neither English nor in a vocabulary, nor numbers."""
    known = {word.lower() for entry in vocabulary for word in entry.split()}
    return [
        word
        for word in phrase.split()
        if not (
            word.isdecimal() or all(_is_known(part, known) for part in re.split(r"[-',.&/]", word) if part)
        )
    ]


def _is_known(word: str, known: set[str]) -> bool:
    small = word.lower()
    return small in known or (small.isascii() and small.isalpha() and (len(small) < 4 or is_word(small)))


def corrected(phrase: str, vocabulary: Iterable[str]) -> str:
    """A phrase with typing errors mended: words of the vocabulary for similar words that are in no dictionary.

    A word that the dictionary knows is mended only if the vocabulary has one that differs by a doubled letter
    ("stripped", "striped").

    Args:
        phrase: Words without grammar.
        vocabulary: Phrases that can be found; their words are the candidates.
    """
    known = {word.lower() for entry in vocabulary for word in entry.split()}
    return " ".join(_corrected_word(word, known) for word in phrase.split())


def _corrected_word(word: str, known: set[str]) -> str:
    small = word.lower()
    if len(small) < 4 or small in known or not small.isalpha() or _singular_word(small) in known:
        return word
    if is_word(small):
        undoubled = [entry for entry in known if _undoubled(entry) == _undoubled(small)]
        return undoubled[0] if len(undoubled) == 1 else word
    close = difflib.get_close_matches(small, sorted(known), n=1, cutoff=_ALIKE)
    return close[0] if close else word


def _undoubled(word: str) -> str:
    return re.sub(r"(.)\1", r"\1", word)
