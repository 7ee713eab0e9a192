"""Words that the grammar leaves over and that name no thing: function words, numbers, comparisons, places.

The words are of closed classes, so the rule holds for phrasings that nobody has thought of. A fixed noun phrase keeps
its words: "cup of tea", "mug with a handle", "something to sit on", "table with four legs".
"""

from __future__ import annotations

import re

from lexsplat.queries.kinds import is_kind
from lexsplat.queries.late import late
from lexsplat.queries.vocabulary import COLORS

NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
ORDINALS = (
    "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth", "eleventh",
    "twelfth",
)  # fmt: skip
_SIZES = "big large great huge giant small little tiny tall short high low long wide medium mini"
_RELATIVE = "big large huge small little tiny tall"
"""Sizes that say something only among several things."""
_GRADED = (
    _SIZES
    + """
    near close far heavy narrow thick thin old new young bright dark round soft hard fast slow cheap expensive pretty
    ugly nice good flat deep cold hot fat sharp smooth rough strong weak quiet wet safe easy red green blue brown
    black white gray pale rich few shiny dirty happy
"""
)
_FUNCTION_WORDS = """
    better best worse worst farther farthest further furthest leftmost rightmost topmost
    i me you he him she her it its we us they them myself yourself itself himself herself themselves mine yours
    ours theirs this that these those each everyone everybody everything anyone anybody nobody someone somebody
    else another same other others similar identical alike
    am is are was were be been being do does did doing done has have had having would should shall must
    cannot could ought
    all every any some no none nothing both half most more less least fewer fewest much many several enough dozen
    neither either
    across after against ahead along amid among amongst apart as away before behind below beneath beside besides
    between beyond during except inside near nearby onto opposite outside past per since than through throughout
    till toward towards under underneath unlike until unto upon versus via within at by into
    and or but nor if because while when whenever where wherever then so unless although though not never only just
    too also very how why what who whom whose which exactly nearly almost roughly approximately probably maybe perhaps
    left right middle center centre background foreground
"""
_VERB_PHRASE = frozenset(
    {"has", "have", "at", "by", "into", "on", "in", "it", "them", "through", "under", "inside"}
)
"""Words that may stand in "something to ..." and "something that ..."."""


def _graded(adjective: str) -> tuple[str, str]:
    """The comparative and the superlative of an adjective."""
    doubled = re.fullmatch(r"[^aeiou]*[aeiou][bdgnt]", adjective) is not None
    stem = adjective.removesuffix("e")
    stem = stem[:-1] + "i" if stem.endswith("y") else stem + stem[-1] * doubled
    return stem + "er", stem + "est"


CLOSED = frozenset(_FUNCTION_WORDS.split()).union(*map(_graded, _GRADED.split()))
_WORD = late(r"[^\W_]+(?:['\u2019-][^\W_]+)*")
_PART_WORD = (
    "middle|center|centre|back|front|rear|top|bottom|edge|border|side|end|rest|half|background|foreground"
)
_PART = late(
    rf"^(?:(?:very|far|near|other|outer|inner) )?(?:{_PART_WORD})(?:$|\s(?:of|side|part|end|half|row)\b)|"
    r"^something (?:front|back|rear|top|bottom|upper|lower|last|next|central|close|far|near)$|^(?:last|next|final)\b|"
    r"\b(?:number|amount|couple|majority|lots?) of\b|\b(?!rally\b)\w{3,}ally\b|"
    r"\b(?!almost\b)\w{2,}most\b",
    re.IGNORECASE,
)
_NUMBER = late(
    rf"(?<![\w-])(?:\d+(?:[.,]\d+)?(?:st|nd|rd|th|cm|mm|m|km|(?=\s))|{'|'.join((*NUMBERS, *ORDINALS))})(?![\w-])",
    re.IGNORECASE,
)
"""Numbers, but not the one at the end of a name: "room 101"."""
_UNIT = late(
    r"^(?:(?:centi|milli|kilo)?met(?:er|re)s?|cm|mm|km|inch(?:es)?|feet|foot|yards?) of\b|"
    r"^(?:distance|height|width|weight|volume|position|location)(?:$| (?:of|between|from|to)\b)",
    re.IGNORECASE,
)
"""What is measured, and in which unit."""
_FIXED = late(
    rf"\b(?:{'|'.join(sorted(COLORS))}),? and (?=(?:{'|'.join(sorted(COLORS))})\b)|"
    rf"\b(?:with|of) (?:no|\d+|{'|'.join(NUMBERS)}) (?=\w)|\b(?:made|built)(?: out)? of\b|\bfirst aid\b|"
    r"^no \w+ing\b|\bcan of\b|(?<=\w )(?:on|in|at|by) (?=it$)",
    re.IGNORECASE,
)
"""Function words of fixed noun phrases."""
_DESCRIBES = late(r"something (?:to|that|which|who|made|with)\b|.*\S to (?=\w)", re.IGNORECASE)
"""Words that are followed by a verb phrase."""
_ARTICLE = late(
    r"\b(?!(?:with|of|for|without|like|from|\w+ing)\b)\w+ (?:the|a|an|my|your)\b(?= \w)|^(?:order|size)\b",
    re.IGNORECASE,
)
"""An article behind a word that joins nothing to it: "shelf holds the book"."""
_DOES = late(
    r"\btouch(?:es|ing)\b|(?<!for )(?<!like )\b(?!\w+thing\b)\w+ing(?= (?:the|my|your|our|this|that) \w)|"
    r"(?<=^something that )\w+s(?= (?:the|my|your|our|this|that) \w)",
    re.IGNORECASE,
)
"""A verb that relates two things, of which the grammar has no relation: "apple touching the banana"."""
_STARTS = late(r"^(?:of|to|from|for|with|without|about|off|out|up|down|over|in|on)\b", re.IGNORECASE)
_LATER = late(r"(?<=\w )(?:from|about|off|out|up|down|in|on|over)\b", re.IGNORECASE)


def left_over(text: str) -> str:
    """The first words of a thing's text that name no thing; "" if there are none.

    Args:
        text: A thing that the grammar found, in any case.
    """
    if text.lower() == "can":
        return ""
    described = _DESCRIBES.match(text)
    verbs = described.end() if described else len(text)
    shown = _FIXED.sub(lambda found: "." * len(found[0]), text)
    patterns = (_PART, _UNIT, _NUMBER, _DOES, _STARTS, *(() if described else (_LATER, _ARTICLE)))
    places = [found.span() for pattern in patterns if (found := pattern.search(shown))]
    for word in _WORD.finditer(shown):
        small, is_verb = word[0].lower(), described is not None and word.end() <= verbs
        allowed = (is_verb and small in ("that", "which", "who")) or (
            word.start() >= verbs and small in _VERB_PHRASE
        )
        if small in CLOSED and not allowed:
            places.append(word.span())
            break
    if places:
        start, end = min(places)
        return text[start:end].strip()
    return _size(text)


def _size(text: str) -> str:
    """A size word without a noun to compare: "big toys", "something small red"."""
    words = text.lower().split()
    sizes = _SIZES if len(words) > 1 and (words[0] == "something" or is_kind(words[-1])) else _RELATIVE
    return next((word for word in words[: len(words) - 1] if word in sizes.split()), "")


FOR_PAGES = {
    "part_of": _PART, "unit": _UNIT, "numeral": _NUMBER, "fixed": _FIXED, "describes": _DESCRIBES,
    "article": _ARTICLE, "does": _DOES, "starts": _STARTS, "later": _LATER,
}  # fmt: skip
"""Patterns by which published pages find what names no thing (`lexsplat.scenes.publishing.grammar`)."""
WORDS_FOR_PAGES = {
    "closed": sorted(CLOSED), "verb_phrase": sorted(_VERB_PHRASE), "sizes": _SIZES.split(),
    "relative": _RELATIVE.split(),
}  # fmt: skip
"""Closed classes of words."""
