"""The words of relations, places, picks and numbers: the patterns of `lexsplat.queries.grammar`."""

from __future__ import annotations

import re

from lexsplat.queries.late import late
from lexsplat.queries.leftovers import CLOSED, NUMBERS, ORDINALS
from lexsplat.queries.phrases import PartName, PickName, RelationName
from lexsplat.queries.vocabulary import COLORS

RELATIONS: tuple[tuple[str, RelationName], ...] = (
    (r"(?:to|on|at|in) (?:the|my|its) left(?: hand)?(?: side)? of|left of", "left of"),
    (r"(?:to|on|at|in) (?:the|my|its) right(?: hand)?(?: side)? of|right of", "right of"),
    (r"in front of|before", "in front of"),
    (r"behind|(?:at|in|on|to) the (?:back|rear) of|in back of", "behind"),
    (r"on top of|upon|onto|on", "on"),
    (r"underneath|beneath|under", "under"),
    (r"above|over", "above"),
    (r"below", "below"),
    (r"inside of|inside|within|into|in", "inside"),
    (r"(?:the )?(?:nearest|closest)(?: to|(?= (?:the|my|a|an) ))", "nearest to"),
    (r"(?:the )?(?:farthest|furthest|most (?:distant|far))(?: away)? (?:from|to(?! the (?:left|right)\b))",
     "farthest from"),
    (r"next to|beside|besides|close to|near to|near|close by|alongside|around|surrounding|adjacent to|by|"
     r"at(?! (?:least|most)\b)", "next to"),
    (r"(?:bigger|larger|greater) than", "larger than"),
    (r"smaller than", "smaller than"),
    (r"taller than", "taller than"),
    (r"shorter than", "shorter than"),
    (r"longer than", "longer than"),
    (r"(?:wider|broader) than", "wider than"),
)  # fmt: skip
LINK = (
    r"(?:(?:that|which|who)\s)?(?:(?:is|are|was|were|there|stands?|sits?|lies|lie|hangs?|rests?|standing|sitting|"
    r"lying|hanging|resting|located|placed|positioned|found|directly|right|just|immediately|also|much|"
    r"slightly|somewhat|a bit|a little)\s)*"
)
RELATION = late(
    rf"\s{LINK}(?P<not>not\s(?:the\s)?)?(?:"
    + "|".join(f"(?P<r{i}>{words})" for i, (words, _) in enumerate(RELATIONS))
    + r")\s",
    re.IGNORECASE,
)
CLAUSE = late(
    r"^(?P<noun>.+?)\s(?:(?:(?:that|which|who)\s)?(?:(?P<one>is|was)|(?P<many>are|were))\s|(?=not\s))"
    r"(?P<clause>(?P<not>not\s)?.+)$",
    re.IGNORECASE,
)
"""A noun, and a clause behind it with the number of its verb, if it has one."""
BETWEEN = late(rf"^(.*?)\s{LINK}(not\s)?(?:in |halfway |midway )?between\s(.+?)\sand\s(.+)$", re.IGNORECASE)
CORNER = late(
    rf"^(.*?)\s{LINK}(not\s)?(?:in|at|on|into)\s(?:the|a|an|any|one|some)\s(?:(back|front|far|near|rear|top|bottom)"
    r"(?:\s|-)?)?(?:(left|right)(?:\s|-)?(?:hand )?)?corners?(?:\sof\s(.*))?$",
    re.IGNORECASE,
)
PART = late(
    rf"^(.*?)\s{LINK}(not\s)?(?:in|at|on|into|by|near)\s(the\s)?(?:very\s)?(middle|cent(?:er|re)|back|front|rear|edge|border|"
    r"background|foreground|(?:far|near|back|front|left|right)(?=\s(?:side|end|edge|half|part)\b))(?:\s(?:side|part|end|edge|half|row))?"
    r"(?:\sof\s(.+))?$",
    re.IGNORECASE,
)
PARTS: dict[str, PartName] = {
    "back": "back", "rear": "back", "background": "back", "far": "back", "front": "front", "foreground": "front",
    "near": "front", "edge": "edge", "border": "edge",
    "left": "left", "right": "right",
}  # fmt: skip
PLACE = late(
    r"^(?:the |my |this |your )?(?:room|scene|picture|photo|image|view|place|house|area|space|world)$",
    re.IGNORECASE,
)
ASIDE = late(
    rf"^(.*?)\s{LINK}(?:(?:farthest|furthest|closest|nearest|most) )?"
    r"(?:(?:counting |counted |starting )?(?:(?:on|to|at) the |"
    r"from (?:the )?))?(?:far |very )?(left|right)(?: (?:hand )?side)?$",
    re.IGNORECASE,
)
NEAR_ME = late(
    rf"^(.*?)\s{LINK}(?:the )?(nearest|closest|farthest|furthest)(?: away)?(?: one)?$", re.IGNORECASE
)
MY_SIDE = late(r"\b(?:to|on|at) my (left|right)(?: (?:hand )?side)?$", re.IGNORECASE)
DETERMINER = late(
    r"^(?:the|a(?! bit\b)|an|some|all|every(?! other)|each(?! other)|any|my|your|our|his|her|their|its|this|that|"
    r"these|those|one(?! (?:meter|metre|inch|foot|yard|cm|mm|m)\b)|single|of|such|"
    rf"only(?! (?:\d|(?:{'|'.join(NUMBERS)})\b)))\s+",
    re.IGNORECASE,
)
THE_ONE = late(
    r"^(?:(?:the|that|this) )?one (?=(?:on|in|at|to|near|next|close|behind|under|above|beside|by|from|inside)\b)",
    re.IGNORECASE,
)
EXCEPT = late(
    r"\s(?:but not|but|and not(?= (?:the|a|an|my) (?!left|right))|"
    r"without|except for|except|minus|excluding|other than|apart from|aside from|"
    r"(?:(?:that|which) )?(?:is|are) not(?= (?:the|a|an|my) (?!left|right)))\s",
    re.IGNORECASE,
)
BUT = late(r"^\sbut\s(?!not\s)", re.IGNORECASE)
ONLY = late(rf"^(?:only|just) (?!(?:\d|(?:{'|'.join(NUMBERS)})\b))", re.IGNORECASE)
NOT = late(r"^(?:what is |things? that (?:is|are) )?not (?=(?:the|a|an|my) )", re.IGNORECASE)
BOTH = late(r"\s*,\s*(?:and|or)\s|\s(?:and|or|plus|as well as|together with|&|\+)\s|\s*,\s*", re.IGNORECASE)
PICKS: tuple[tuple[str, PickName], ...] = (
    (r"largest|biggest|greatest|hugest|bulkiest", "largest"),
    (r"smallest|tiniest|littlest", "smallest"),
    (r"tallest|highest", "tallest"),
    (r"shortest|lowest|flattest", "shortest"),
    (r"widest|broadest", "widest"),
    (r"longest", "longest"),
    (r"leftmost|left(?! (?:of|side|end|half|part)\b)", "leftmost"),
    (r"rightmost|right(?! (?:of|side|end|half|part)\b)", "rightmost"),
)
PICK_WORDS = "|".join(f"(?P<p{i}>{words})" for i, (words, _) in enumerate(PICKS))
COMPARATIVES: dict[str, PickName] = {
    "bigger": "largest", "larger": "largest", "smaller": "smallest", "taller": "tallest", "shorter": "shortest",
    "longer": "longest", "wider": "widest",
}  # fmt: skip
SIZES: dict[str, PickName] = {
    "big": "largest", "large": "largest", "huge": "largest", "small": "smallest", "little": "smallest",
    "tiny": "smallest", "tall": "tallest", "short": "shortest",
}  # fmt: skip
SIZE = late(rf"^({'|'.join(SIZES)}) (?!sleeved?\b)(?=\S)", re.IGNORECASE)
"""A size says something only among several things: "the small mug" is the smallest one."""
SEVERAL = late(r"\b(?:things|objects|items|ones|stuff)$", re.IGNORECASE)
COMPARATIVE = rf"(?P<more>{'|'.join(COMPARATIVES)})"
OF_TWO = late(rf"^the {COMPARATIVE}(?! than\b)(?: one)?(?: of (?:the )?(?:two|both))?(?:\s|$)", re.IGNORECASE)
WHICH_OF = late(
    rf"^(?:which|what|who)(?: (?:one|thing|object))?(?: of (?:the |these |those )?(?:two|three|things|objects))?"
    rf" (?:is|are) (?:the )?(?:{COMPARATIVE}|{PICK_WORDS}|(?P<near>nearer|closer|nearest|closest)|"
    r"(?P<far>farther|further|farthest|furthest))"
    r"(?(near)(?: to (?P<to>.+?))?|(?(far)(?: (?:away )?from (?P<from>.+?))?))(?: one)?"
    r"(?:\s?[,:;]\s?|\s)(?:between )?(?P<these>(?:the|a|my) .+ (?:or|and) .+)$",
    re.IGNORECASE,
)
PICK = late(rf"^(?:very |single )?(?:{PICK_WORDS})(?:\s+(?:one )?(?:of )?|$)(?!of\b)", re.IGNORECASE)
IS_PICK = late(rf"\s{LINK}(?:the\s)?(?:{PICK_WORDS})(?:\sone)?$", re.IGNORECASE)
EXTREME = late(
    r"^(?:(nearest|closest)|farthest|furthest|most distant)\s+(?!(?:to|from|away)\s)(.+?)"
    r"(?:\s+(?:away )?(?:to|from)\s+(.+))?$",
    re.IGNORECASE,
)
ORDINAL = late(rf"^(?P<number>{'|'.join(ORDINALS)}|\d{{1,2}}(?:st|nd|rd|th))[\s-]+", re.IGNORECASE)
QUANTITY = late(
    rf"^(?P<more>more than |over )?(?:at least )?(?P<exact>(?:exactly|precisely|only|just) )?"
    rf"(?P<number>\d{{1,3}}|{'|'.join(NUMBERS)}|both|several|multiple|many|"
    r"a few|a couple of|a pair of(?! (?:scissors|glasses|trousers|pants|jeans|shorts|binoculars|headphones|pliers|"
    r"tongs)\b))(?: or more)?"
    r"\s+(?!(?:meters?|metres?|centimeters?|inch(?:es)?|feet|yards?|steps?|cm|mm|m)\b)(?:of\s+)?",
    re.IGNORECASE,
)
DEFINITE = late(r"^(?:the|these|those|my|our|your) ", re.IGNORECASE)
AT_MOST = late(
    r"^(?:(?P<below>(?:fewer|less) than)|at (?:the )?most|(?:no|not) more than|up to|(?:a )?maximum(?: of)?) "
    rf"(?P<number>\d{{1,3}}|{'|'.join(NUMBERS)})"
    r"\s+(?!(?:meters?|metres?|centimeters?|inch(?:es)?|feet|yards?|steps?|cm|mm|m)\b)(?:of\s+)?",
    re.IGNORECASE,
)
NONE_OF = late(r"^at most 0 ", re.IGNORECASE)
"""`lexsplat.queries.questions.in_full` makes this of "is there no"; it holds for all that follows."""
NEITHER = late(
    r"^(?:(?P<noun>.+?)\s(?:(?:that|which|who)\s)?(?:(?:is|are|was|were)\s)?)?neither\s(?P<one>.+?)\snor\s(?P<other>.+)$",
    re.IGNORECASE,
)
CLOSER = late(
    r"^(?:is|are|was|were) (?P<one>.+?) (?:(?P<near>closer|nearer)|farther|further)(?: away)?"
    r"(?: (?:to|from) (?P<to>.+?)(?=(?<= me| us) than | than .+ (?:is|are)$))?"
    r" than (?P<other>(?!to\b|from\b).+?)(?: is| are)?$",
    re.IGNORECASE,
)
"""Which of two things is closer, to whoever asks or to a third one. "Closer to A than B" may mean "than to B"."""
_FUNCTION_WORDS = """
    of to from for with about off out up down over in on like without plus minus except twice quite such really
"""
_SIDES = ("left", "right", "middle", "center", "centre", "background", "foreground")
_NO_NOUN = "|".join(sorted(CLOSED.union(_FUNCTION_WORDS.split()).difference(_SIDES)))
IDENTITY = late(
    rf"^(?:is|are|was|were) (?!there\b)(?P<one>(?:\S+ )*?(?!(?:{_NO_NOUN}|"
    rf"(?<!the )(?<!a )(?<!my )(?:\w+ing|{'|'.join(_SIDES)})) )\S+) "
    r"(?P<not>not )?(?P<other>(?:the|an?) (?:.*\S))$",
    re.IGNORECASE,
)
"""A statement on what a thing is: "is the lamp the tallest thing?"."""
QUALITY = late(
    r"\s(?:,\s*)?(?:that|which|who)\s(?:is|are|was|were|looks?|has|have)\s(not\s)?(.+)$", re.IGNORECASE
)
MADE_OF = late(
    r"\s(?:(?:that|which)\s(?:is|are|was|were)\s)?(?:made|built)?(?:\s?(?:out\s)?of|\sfrom)\s(\w+)$",
    re.IGNORECASE,
)
PATTERNS = frozenset({"striped", "checkered", "plain", "shiny", "round", "square"})
ADJECTIVES = rf"(?:{'|'.join(sorted(COLORS | PATTERNS))})"
NAMES_THINGS = late(r"\b(?:things?|objects?|items?)\b", re.IGNORECASE)
MATERIAL = {"wood": "wooden"}
THING_WORD = late(
    r"^(?:(.*?)\s)?(?:things?|objects?|items?|everything|anything|something|stuff|ones?|whatever)$",
    re.IGNORECASE,
)
SOMETHING = late(r"^(?:things?|objects?|items?|everything|anything|something|stuff)\s+(.+)$", re.IGNORECASE)
VIEWER = late(
    r"^(?:me|us|you|myself|here|the (?:camera|viewer|observer)|(?:my|the) (?:position|viewpoint|view))$",
    re.IGNORECASE,
)
INDEFINITE = late(r"^(?:an?|any|some)\s", re.IGNORECASE)
AND_NOT = late(r"\s(?:and|or|nor) not (?=(?:the|a|an|my) )", re.IGNORECASE)
"""Behind "but not", which holds for what follows as well."""
ALL = late(r"^(?:all|any|everyone|anyone)$", re.IGNORECASE)
TO_A_SIDE = late(r"(?:the )?(?:far |very )?(?:left|right)(?: (?:hand )?side)?$", re.IGNORECASE)
AT = late(r"^(?:on|at|to) ", re.IGNORECASE)
HIDDEN = late("\x00(\\d+)\x00")
"""A part in quotation marks, by its number."""
CORNER_SIDES = {"far": "back", "rear": "back", "top": "back", "near": "front", "bottom": "front"}
