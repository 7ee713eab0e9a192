"""Other words for the same thing, where a scene is not sure of it by its first words: plurals and compound words.

Encoders learn words as people write them. One may know "leaves" and not "leaf", "lamp shade" and not "lampshade".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Set
from functools import lru_cache

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.kinds import words_of_things
from lexsplat.queries.phrases import Thing
from lexsplat.queries.selection import Presence

_SHORTEST = 3
"""Letters of a part of a compound word, at least."""

PresenceOf = Callable[[str], Presence]
"""Whether a scene holds a thing, by its words."""


def in_known_words(thing: Thing, presence_of: PresenceOf, known: Set[str]) -> str:
    """The words that a thing is asked for in: its text, or others that the scene holds.

    A compound word is replaced where the scene does not surely hold it, a singular where the scene lacks it.

    Args:
        thing: A thing; words in quotation marks stay.
        presence_of: The presence of words in the scene.
        known: Words that a compound word may be made of (`known_words`).
    """
    plural, written = [(thing.own, "")] if thing.own else [], [*compounds(thing.text, known)]
    if thing.exact or not (plural or written) or (presence := presence_of(thing.text)) == "yes":
        return thing.text
    others = [*plural, *written] if presence == "no" else written
    for words, head in others:
        if presence_of(words) == "yes" and (not head or presence_of(head) == "yes"):
            return words
    return thing.text


def compounds(text: str, known: Set[str]) -> Iterator[tuple[str, str]]:
    """A text with one compound word written otherwise: "lamp shade" for "lampshade", "tablecloth" for "table cloth".

    Args:
        text: A thing without grammar.
        known: The words that may be joined, and into which a word may be split.

    Yields:
        The text, and the last part of a word that is split, else "". The whole is one of what its last part names: a
        lamp shade is a shade. A cupboard is no board, which keeps a scene with a cup from having one.
    """
    words = text.split()
    for place, word in enumerate(words):
        small = word.lower()
        for end in range(_SHORTEST, len(small) - _SHORTEST + 1):
            if {small[:end], small[end:]} <= known:
                yield " ".join([*words[:place], word[:end], word[end:], *words[place + 1 :]]), word[end:]
        joined = small + "".join(words[place + 1 : place + 2]).lower()
        if joined != small and joined in known:
            yield " ".join([*words[:place], joined, *words[place + 2 :]]), ""


@lru_cache
def known_words(clip: str) -> frozenset[str]:
    """The words of everyday things and of those that an encoder is trained on."""
    return frozenset(
        word for text in (*everyday_words(), *words_of_things(clip)) for word in text.lower().split()
    )
