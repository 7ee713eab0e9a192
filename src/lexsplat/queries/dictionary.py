"""The English dictionary of simplemma, kept sorted: reading it takes half a second, a search in it microseconds."""

from __future__ import annotations

import unicodedata
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import version

from lexsplat.runtime.environment import user_cache
from lexsplat.runtime.files import write_file

_END = b"\n\xff\t"
"""Ends a file that is whole; no text in UTF-8 has the second byte."""


def is_english(word: str) -> bool:
    """Whether a word in small letters, or a name with these letters, is in the dictionary."""
    return _lemma_of(word) is not None


def lemma(word: str) -> str:
    """The form of a word in small letters under which a dictionary has it; rules make one for words that it lacks."""
    found = _lemma_of(word)
    if found is None:
        import simplemma

        return str(simplemma.lemmatize(word, lang="en"))
    return found


@lru_cache(4096)
def _lemma_of(word: str) -> str | None:
    word = unicodedata.normalize("NFC", word)
    for form in (word, word.capitalize()):
        start = f"\n{form}\t".encode()
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
