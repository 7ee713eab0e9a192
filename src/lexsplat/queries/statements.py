"""Statements that two phrases make together: what a thing is, which of two is closer, what is neither of two.

"Is the lamp the tallest thing?" asks for the lamp, as far as it is the tallest thing; "is the duck closer than the
mug?" for the duck, if it is the nearest of both; "toys that are neither red nor blue" for the other toys.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from lexsplat.queries import patterns
from lexsplat.queries.late import late
from lexsplat.queries.phrases import Anything, Both, Except, Phrase, Related, Viewer, among
from lexsplat.queries.wording import describes, undetermined

_ADJECTIVES = late(rf"^(?:{patterns.ADJECTIVES}\s)+", re.IGNORECASE)
Read = Callable[[str], Phrase]
"""Parses words."""


def stated_of_two(asked: str, read: Read) -> Phrase | None:
    """ "Is A the B?" and "is A closer than B?"; None for another question."""
    if found := patterns.CLOSER.match(asked):
        return _closer(found["one"], found["other"], bool(found["near"]), found["to"] or "me", read)
    if not (found := patterns.IDENTITY.match(asked)) or not undetermined(f"{found['one']} ").strip():
        return None
    return among(read(found["one"]), read(found["other"]), inside=not found["not"])


def _closer(one: str, other: str, is_near: bool, to: str, read: Read) -> Phrase:
    first, place = read(one), Viewer() if patterns.VIEWER.match(to) else read(to)
    nearest = Related("nearest to" if is_near else "farthest from", Both(first, read(other)), place)
    return among(first, nearest, inside=True)


def neither(words: str, read: Read) -> Phrase | None:
    """ "Toys that are neither red nor blue", "neither the mug nor the duck"; None for another phrase."""
    found = patterns.NEITHER.match(words)
    if found is None:
        return None
    noun, one, other = undetermined(found["noun"] or ""), found["one"], found["other"]
    if not noun and describes(one) and (rest := _ADJECTIVES.sub("", undetermined(other))) != other:
        noun, other = rest, undetermined(other).removesuffix(rest)  # neither red nor blue toys
    named = [f"{noun} that is {part.strip()}" if noun else part for part in (one, other)]
    return Except(read(noun) if noun else Anything(), Both(read(named[0]), read(named[1])))
