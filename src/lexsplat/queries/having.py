"""Things with a part or another attribute: "mug with a handle" is the mug, "vase with flowers" is not certain.

A part is looked for in its thing, as for "mug without handle". No search tells whether a vase has flowers in it.
"""

from __future__ import annotations

import re

from lexsplat.queries import wording
from lexsplat.queries.kinds import is_kind
from lexsplat.queries.late import late
from lexsplat.queries.leftovers import NUMBERS
from lexsplat.queries.phrases import Except, Having, Phrase, Thing, parts_of
from lexsplat.queries.spelling import singular
from lexsplat.queries.vocabulary import PARTS

_PLURALS = {"leaf": "leaves", "foot": "feet"}
_PARTS = "|".join(sorted({*PARTS, *(f"{part}s" for part in PARTS), *_PLURALS.values()}))
_ARTICLE = late(r"\b(?:an?|the|its) \w+$", re.IGNORECASE)
_HAS = r"(?:with|having|(?:that|which|who) (?:has|have)|(?:has|have)(?= an?\b))"
_THING = r"(?!(?:something|things?|objects?|items?|everything|anything|what|all)\b)(.*?\S)"
WITH_PART = late(rf"^{_THING}\s{_HAS}\s(?:(?:an?|the|its|some)\s)?({_PARTS})$", re.IGNORECASE)
"""A thing with a part."""
_PART_OF_ANY = late(rf"^something {_HAS} (?:(?:an?|the|its|some) )?({_PARTS})$", re.IGNORECASE)
_NUMBER = rf"(?:no|\d+|{'|'.join(NUMBERS)})\b"
WITH = late(rf"^{_THING}\s(with\s(?!{_NUMBER})[^\x00]+)$", re.IGNORECASE)
"""A thing with another attribute; a number of parts is a fixed noun phrase: "table with four legs"."""
WITHOUT = late(r"\swithout\s(?!(?:the|a|an|any|my|this|that)\s)", re.IGNORECASE)
"""What is without an attribute: "vase without flowers", but not "table without the lamp"."""


def thing_of(text: str, own: str = "") -> Phrase:
    """A thing by its words (`lexsplat.queries.wording.thing_of`); "mug with a handle" is the mug that has one."""
    return _having(text) or wording.thing_of(text, own)


def part_of_any(text: str) -> str:
    """The part that things of any name have, in the singular: "handle" of "something with a handle"; "" if none."""
    found = _PART_OF_ANY.match(text)
    return singular(found[1]) if found else ""


def unseen(phrase: Phrase, text: str) -> list[str]:
    """Notes on the attributes of things for which nothing looks: "with flowers", "without flowers".

    Args:
        phrase: The phrase.
        text: The text that it is parsed from.
    """
    return [f'"{words}" is not looked for by itself' for words in _attributes(phrase, text)]


def _having(words: str) -> Phrase | None:
    """ "Mug with a handle" as the mug that has one; None for another phrase."""
    found = WITH_PART.match(words)
    if found is None:
        return None
    target = wording.thing_of(singular(wording.undetermined(found[1])))
    lacks = wording.lacking(target, Thing(singular(found[2])))
    if not isinstance(target, Thing) or not isinstance(lacks, Except):
        return None
    part = singular(found[2])
    plural = _PLURALS.get(part, f"{part}s")
    # Encoders know leaves better than a leaf.
    return Having(target, lacks.second, words if _ARTICLE.search(words) else f"{target.text} with {plural}")


def _attributes(phrase: Phrase, text: str) -> list[str]:
    """The words of such attributes, as the text has them."""
    if isinstance(phrase, Thing):
        found = None if phrase.exact else WITH.match(phrase.text)
        return [_as_written(found[2], text)] if found else []
    if isinstance(phrase, Except) and not phrase.lacks and WITHOUT.search(text):
        first, second = phrase.first, phrase.second
        if isinstance(first, Thing) and isinstance(second, Thing) and not is_kind(first.text):
            return [_as_written(f"without {second.text}", text)]
    parts = parts_of(phrase)
    return [words for part in parts.values() for words in _attributes(part, text)]


def _as_written(words: str, text: str) -> str:
    """Words in the singular as a text has them, which may be in the plural."""
    found = re.search(rf"{re.escape(words)}\w*", text, re.IGNORECASE)
    return found[0] if found else words


FOR_PAGES = {"with_part": WITH_PART, "with_attribute": WITH}
"""Patterns by which published pages tell these phrases from names (`lexsplat.scenes.publishing.grammar`)."""
