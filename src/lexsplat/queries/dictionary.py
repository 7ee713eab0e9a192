"""The English dictionary of simplemma, kept sorted: reading it takes half a second, a search in it microseconds."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import version
from typing import TYPE_CHECKING

from lexsplat.runtime.files import write_file
from lexsplat.runtime.user_cache import user_cache

if TYPE_CHECKING:
    from simplemma import Lemmatizer

_END = b"\n\xff\t"
"""Ends a file that is whole; no text in UTF-8 has the second byte."""


def is_english(word: str) -> bool:
    """Whether a word in small letters, or a name with these letters, is in the dictionary."""
    return _lemma_of(word) is not None


def lemma(word: str) -> str:
    """The form of a word in small letters under which a dictionary has it; rules make one for words that it lacks."""
    found = _lemma_of(word)
    return _lemmatizer().lemmatize(word, lang="en") if found is None else found


@lru_cache(1)
def _lemmatizer() -> Lemmatizer:
    """The rules of simplemma, which look parts of words up in the lines, not in a dictionary that is read first."""
    from simplemma import Lemmatizer
    from simplemma.strategies import DefaultStrategy

    return Lemmatizer(lemmatization_strategy=DefaultStrategy(dictionary_factory=_Kept()))


class _Kept(Mapping[str, str]):
    """The lemmas of the lines, which are also the factory of simplemma's that gives them."""

    def get_dictionary(self, lang: str) -> Mapping[str, str]:
        return self

    def __getitem__(self, word: str) -> str:
        found = _entry(word)
        if found is None:
            raise KeyError(word)
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(english_words())

    def __len__(self) -> int:
        return len(english_words())


def english_words() -> list[str]:
    """All words of the dictionary, as it spells them."""
    return [line.split("\t")[0] for line in _lines()[: -len(_END)].decode().split("\n")[1:]]


@lru_cache(4096)
def _lemma_of(word: str) -> str | None:
    word = unicodedata.normalize("NFC", word)
    found = _entry(word)
    return _entry(word.capitalize()) if found is None else found


def _entry(word: str) -> str | None:
    """The lemma of a word that is spelled so."""
    start = f"\n{word}\t".encode()
    lines = _lines()
    low, high = 0, len(lines) - len(_END)
    # The first newline at or after the middle begins the line that is compared.
    while low < high:
        at = lines.index(b"\n", (low + high) // 2)
        if at >= high:
            at = lines.rindex(b"\n", low, high)
        key = lines[at : lines.index(b"\t", at) + 1]
        if key == start:
            return lines[at + len(start) : lines.index(b"\n", at + 1)].decode()
        low, high = (lines.index(b"\n", at + 1), high) if key < start else (low, at)
    return None


@lru_cache(1)
def _lines() -> bytes:
    """A line of each word, a tab and its lemma, sorted: from the user's cache, or made and written there."""
    kept = None
    with suppress(OSError, RuntimeError):
        kept = user_cache() / f"english-{version('simplemma')}.tsv"
        lines = kept.read_bytes()
        if lines.endswith(_END):
            return lines
    lines = _made()
    if kept is not None:
        with suppress(OSError):
            write_file(kept, lines)
    return lines


def _made() -> bytes:
    from simplemma.strategies.dictionaries.dictionary_factory import DefaultDictionaryFactory

    entries = DefaultDictionaryFactory().get_dictionary("en")
    # Sorted with the tab, as they are compared: "a-b" comes after "a".
    lines = sorted(f"\n{word}\t{entries[word]}".encode() for word in entries)
    return b"".join(lines) + _END
