"""Words: singulars, and typing errors against a vocabulary."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence, Set
from functools import lru_cache
from itertools import islice, product

from lexsplat.queries import dictionary

_SAME_FORM = {"glass", "cloth", "cutlery", "stairs", "people", "scissors", "trousers", "clothes", "pants"}
_NOT_BY_LEMMA = {
    "leaves": "leaf", "shelves": "shelf", "lenses": "lens", "loaves": "loaf", "halves": "half", "calves": "calf",
    "thieves": "thief", "wives": "wife", "lives": "life", "sheaves": "sheaf", "midwives": "midwife",
}  # fmt: skip
"""Plurals that simplemma takes for verbs, or has under a rare spelling."""
_SPELLINGS = 4
"""Maximum number of corrections of a phrase with several typing errors."""
_ALIKE = 0.74
"""Smallest similarity of a word and its typing error (`difflib`): two letters of four changed places."""


def straight_quotes(text: str) -> str:
    """A text with the quotation marks of phones and of other languages as `"`."""
    return text.translate(_QUOTES)


_QUOTES = str.maketrans(dict.fromkeys("“”„‟«»", '"'))


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
        lemma = dictionary.lemma(small)
    if lemma == small:
        return word
    return word[: len(lemma)] if word.lower().startswith(lemma) else lemma


_IRREGULAR = {"men", "women", "children", "mice", "geese", "teeth", "feet", "oxen", "dice"}
"""Plurals without an s; other words keep their form, as their lemma may be a verb's ("burning")."""


def is_word(word: str) -> bool:
    """Whether a word is in the English dictionary."""
    small = word.lower()
    return small in _everyday() or dictionary.is_english(small)


@lru_cache(1)
def _everyday() -> Set[str]:
    """Words of things and colors, which spare the dictionary. It lacks one of them."""
    from lexsplat.queries.everyday import everyday_words
    from lexsplat.queries.vocabulary import COLORS

    return _words_of((*everyday_words(), *COLORS)) - {"placemat"}


def strange(phrase: str, vocabulary: Iterable[str]) -> list[str]:
    """The words of a phrase that are neither English nor in a vocabulary; numbers are neither."""
    known = _words_of(vocabulary)
    return [
        word
        for word in phrase.split()
        if not all(_is_known(part, known) for part in re.split(r"[-',.&/]", word) if part)
    ]


def _is_known(word: str, known: Set[str]) -> bool:
    small = word.lower()
    if not (small.isascii() and small.isalpha()):
        return small in known
    return small in known or len(small) < (4 if word.isupper() else 3) or is_word(small)


def corrected(phrase: str, vocabulary: Iterable[str]) -> str:
    """A phrase with typing errors corrected (`spellings`)."""
    return spellings(phrase, vocabulary)[0]


def spellings(phrase: str, vocabulary: Iterable[str]) -> tuple[str, ...]:
    """Corrections of a phrase, the likeliest first: words of the vocabulary replace similar words in no dictionary.

    A word that the dictionary knows is corrected only if the vocabulary has one that differs by a doubled letter
    ("stripped", "striped"), by two neighbors in the other order ("appel"), or by the last of six letters ("orang").

    Args:
        phrase: Words without grammar.
        vocabulary: Phrases that can be found; their words are the candidates.

    Returns:
        At most `_SPELLINGS`; the phrase itself where nothing is corrected.
    """
    known = _words_of(vocabulary)
    meant = product(*(_meant(word, known) for word in phrase.split()))
    return tuple(" ".join(words) for words in islice(meant, _SPELLINGS)) or (phrase,)


def frame_errors(text: str, frame: Set[str], vocabulary: Set[str], known: Set[str]) -> dict[str, str]:
    """The typing errors in the words around a thing, with what is meant: "whre", "where".

    Args:
        text: A question.
        frame: The words of questions, in small letters, which are the candidates.
        vocabulary: Words of things: what may mean one of them stays.
        known: Other words that are no typing errors; they spare the dictionary.
    """
    found = {}
    for word in re.findall(r"\b[^\W\d_]+\b(?!['\u2019\u02bc]t\b)", text):
        small = word.lower()
        if small in known or small in frame or small in vocabulary or not _is_typed_wrong(word):
            continue
        near = _nearest(small, frame | vocabulary)
        if near and near[0] in frame:
            found[word] = near[0]
    return found


def _words_of(phrases: Iterable[str]) -> frozenset[str]:
    return _split(tuple(phrases))


@lru_cache(16)
def _split(phrases: tuple[str, ...]) -> frozenset[str]:
    return frozenset(word.lower() for entry in phrases for word in entry.split())


def _is_typed_wrong(word: str) -> bool:
    """Whether letters are no English word; abbreviations in capitals are none, and no typing errors."""
    return len(word) > 2 and word.isascii() and word.isalpha() and not word.isupper() and not is_word(word)


def _meant(word: str, known: Set[str]) -> Sequence[str]:
    """Corrections of a word, the likeliest first."""
    small = word.lower()
    if len(small) < 3 or small in known or not small.isalpha() or _singular_word(small) in known:
        return (word,)
    if is_word(small):
        meant = [entry for entry in known if _may_be_meant(entry, small)]
        return meant if len(meant) == 1 else (word,)
    near = _nearest(small, known) if _is_typed_wrong(word) else []
    if not near and small.endswith("s") and len(small) > 3 and _is_typed_wrong(word):
        near = _nearest(small[:-1], known)
    if not near and len(small) > 3:
        near = difflib.get_close_matches(small, sorted(known), n=1, cutoff=_ALIKE)
    return near or (word,)


def _may_be_meant(entry: str, word: str) -> bool:
    """Whether an English word may be a typing error of another one."""
    left_out = len(entry) > 5 and entry[:-1] == word
    return left_out or _is_swapped(entry, word) or _undoubled(entry) == _undoubled(word)


def _nearest(word: str, known: Set[str]) -> list[str]:
    """The known words at one edit from a word, the likeliest first: the same first letter, then swapped ones."""
    near = [entry for entry in known if len(entry) > 2 and _is_one_edit(entry, word)]
    return sorted(near, key=lambda one: (one[0] != word[0], not _is_swapped(one, word), -len(one), one))


def _is_swapped(one: str, other: str) -> bool:
    """Whether two words differ by the order of two neighbors."""
    return len(one) == len(other) and any(
        one == other[:place] + other[place + 1] + other[place] + other[place + 2 :]
        for place in range(len(other) - 1)
        if other[place] != other[place + 1]
    )


def _is_one_edit(one: str, other: str) -> bool:
    """Whether a letter more, less or changed, or two neighbors in the other order, make one word the other."""
    if abs(len(one) - len(other)) > 1:
        return False
    if len(one) == len(other):
        return sum(a != b for a, b in zip(one, other)) == 1 or _is_swapped(one, other)
    short, long = sorted((one, other), key=len)
    return any(long[:place] + long[place + 1 :] == short for place in range(len(long)))


@lru_cache(1 << 14)  # of each known word, for each word that is asked for
def _undoubled(word: str) -> str:
    return re.sub(r"(.)\1", r"\1", word)
