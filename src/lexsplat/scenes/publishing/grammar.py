"""The words and patterns of `lexsplat.queries.grammar` for the page, which reads questions by them."""

from __future__ import annotations

import re
from typing import Any

from lexsplat.queries import having, leftovers, patterns, questions
from lexsplat.queries.colors import COLOR_WORDS, NEAR
from lexsplat.queries.kinds import KIND_PHRASES
from lexsplat.queries.meaning import known_words
from lexsplat.queries.vocabulary import CARRIERS, COLORS, NAMES, QUALITIES, STUFF, SURFACES

_OF_THE_GRAMMAR = (
    "RELATION", "BETWEEN", "CORNER", "PART", "ASIDE", "NEAR_ME", "MY_SIDE", "DETERMINER", "THE_ONE", "EXCEPT", "NOT",
    "BOTH", "SIZE", "OF_TWO", "PICK", "IS_PICK", "EXTREME", "ORDINAL", "QUANTITY", "QUALITY", "MADE_OF", "THING_WORD",
    "SOMETHING", "VIEWER", "TO_A_SIDE", "AND_NOT", "AT_MOST", "NONE_OF", "NEITHER", "CLOSER", "IDENTITY",
)  # fmt: skip
_WHICH_OF = re.compile(
    rf"^(?:which|what|who)\b.*?\b(?:is|are) (?:the )?(?P<which>{'|'.join(patterns.COMPARATIVES)}|nearer|closer|"
    r"farther|further|\w+est|leftmost|rightmost)\b.*?(?:\s?[,:;]\s?|\s)(?:between )?"
    r"(?P<these>(?:the|a|my) .+ (?:or|and) .+)$",
    re.IGNORECASE,
)
"""`patterns.WHICH_OF` without its condition on a group, which browsers do not have."""


def page_grammar(clip: str = "") -> dict[str, Any]:
    """Patterns as sources of regular expressions of browsers, all of which ignore case, and lists of words.

    Args:
        clip: Name of the encoder of the scene, some of whose words the page splits and joins.
    """
    found = {name.lower(): getattr(patterns, name) for name in _OF_THE_GRAMMAR}
    found |= {**questions.FOR_PAGES, **leftovers.FOR_PAGES, **having.FOR_PAGES, "which_of": _WHICH_OF}
    return {
        "patterns": {name: _source(pattern) for name, pattern in found.items()},
        "replaced": {
            name: [[_source(pattern), instead] for pattern, instead in pairs]
            for name, pairs in questions.REPLACED.items()
        },
        "words": {
            **leftovers.WORDS_FOR_PAGES,
            "numbers": list(leftovers.NUMBERS),
            "colors": sorted(COLORS),
            "told_colors": list(COLOR_WORDS),
            "near_colors": list(NEAR),
            "qualities": sorted(QUALITIES),
            "patterns": sorted(patterns.PATTERNS),
            "kinds": list(KIND_PHRASES),
            "names": sorted(NAMES),
            "surfaces": sorted(SURFACES),
            "carriers": sorted(CARRIERS),
            "stuff": sorted(STUFF),
            "in_compounds": sorted(known_words(clip)),
        },
        "materials": patterns.MATERIAL,
    }


def _source(pattern: re.Pattern[str]) -> str:
    """A regular expression of Python as one of a browser; both write all else alike that the patterns use."""
    return pattern.pattern.replace("(?P<", "(?<")
