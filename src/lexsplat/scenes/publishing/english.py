"""The English words for the page, which finds typing errors with them: a Bloom filter."""

from __future__ import annotations

from functools import cache

import numpy as np

from lexsplat.queries.dictionary import english_words

HASHES = 5
"""Bits of each word. With eight bits of the filter for a word, 2 % of other texts count as words."""


@cache
def english_file() -> bytes:
    """A Bloom filter of the English words of `lexsplat.queries.spelling.is_word`.

    Bit ``(a + n b) mod m`` of the m bits is set for each word and each n below `HASHES`; a is the 32-bit FNV-1a hash
    of the word, and b that of the word and a zero byte, made odd. Bit k is bit ``k mod 8`` of byte ``k // 8``.
    """
    words = sorted({text.lower() for text in english_words() if text.isascii() and text.isalpha()})
    letters = np.array(words, dtype="S").view(np.uint8).reshape(len(words), -1)
    first = np.full(len(words), 2166136261, np.uint32)
    for column in np.ascontiguousarray(letters.T):
        longer = np.flatnonzero(column)  # few words are long
        first[longer] = _hashed(first[longer], column[longer])
    second = (_hashed(first, np.zeros_like(first)) | np.uint32(1)).astype(np.uint64)
    first = first.astype(np.uint64)
    filled = np.zeros(8 * len(words), np.uint8)
    for n in range(HASHES):
        filled[(first + np.uint64(n) * second) % np.uint64(len(filled))] = 1
    return np.packbits(filled, bitorder="little").tobytes()


def _hashed(before: np.ndarray, letter: np.ndarray) -> np.ndarray:
    """A step of FNV-1a, modulo 2**32."""
    return (before ^ letter) * np.uint32(16777619)
