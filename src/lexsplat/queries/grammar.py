"""The grammar of phrases and questions, without a language model.

mug                                  a thing; every word goes to the text encoder
mug on the cloth                     things by their place (`_RELATIONS`)
mug not on the cloth                 all other mugs
mug next to the duck on the table    right-associative: mug next to (duck on the table)
mug between the apple and the duck   also "closest to", "farthest from", "in the back left corner"
toy in front of me                   "me" stands where the view was taken
apple and banana                     the union; also "or" and commas
fruit but not the banana             the difference; also "without", "except", "other than"; "not the mug"
largest book, leftmost mug           one of several
two apples                           all of them, if there are as many
mug that is blue; is the mug blue?   the same as "blue mug"; "made of metal" as well
what is on the cloth?                any object; also "thing", "object", "everything"
red thing, yellow toys               the objects, or those of a kind, in a color
what can I drink from?               the same as "something to drink from"
how many apples are there?           the same as "apple"; plurals are asked for in the singular
where is the mug? show me the mug    the same as "mug" (`_FRAMES`)
"something on wheels"                in quotation marks: one thing, whatever its words

What does not fit is one thing, asked for in its own words, and `Understood.note` says so.
"""

from __future__ import annotations

import re
from dataclasses import replace

from lexsplat.queries.colors import COLOR_WORDS
from lexsplat.queries.kinds import is_kind
from lexsplat.queries.phrases import (
    Anything,
    AtLeast,
    Between,
    Both,
    Colored,
    Except,
    InCorner,
    Phrase,
    Pick,
    PickName,
    Related,
    RelationName,
    Thing,
    Understood,
    Viewer,
    mended_note,
    things_of,
    with_things,
)
from lexsplat.queries.questions import as_phrase, not_understood, with_asking_words
from lexsplat.queries.spelling import singular
from lexsplat.queries.vocabulary import QUALITIES
from lexsplat.runtime.errors import QueryError

MAX_PARTS = 40
"""Limit on the number of parts, and so on the depth of the recursion."""
MAX_LENGTH = 600
"""Characters from which a text is one thing: no phrase of that length has grammar."""

_RELATIONS: tuple[tuple[str, RelationName], ...] = (
    (r"(?:to|on|at) (?:the|my|its) left(?: hand)?(?: side)? of|left of", "left of"),
    (r"(?:to|on|at) (?:the|my|its) right(?: hand)?(?: side)? of|right of", "right of"),
    (r"in front of|before", "in front of"),
    (r"behind|(?:at|in|on) the back of|in back of", "behind"),
    (r"on top of|upon|onto|on", "on"),
    (r"underneath|beneath|under", "under"),
    (r"above|over", "above"),
    (r"below", "below"),
    (r"inside of|inside|within|into|in", "inside"),
    (r"(?:the )?(?:nearest|closest) to", "nearest to"),
    (r"(?:the )?(?:farthest|furthest|most distant|most far)(?: away)? (?:from|to)", "farthest from"),
    (r"next to|beside|besides|close to|near to|near|close by|alongside|around|surrounding|adjacent to|by|at", "next to"),
)  # fmt: skip
_LINK = (
    r"(?:(?:that|which|who)\s)?(?:(?:is|are|was|were|there|stands?|sits?|lies|lie|hangs?|rests?|standing|sitting|"
    r"lying|hanging|resting|located|placed|positioned|found|directly|right|just|immediately|also)\s)*"
)
_RELATION = re.compile(
    rf"\s{_LINK}(?P<not>not\s(?:the\s)?)?(?:"
    + "|".join(f"(?P<r{i}>{words})" for i, (words, _) in enumerate(_RELATIONS))
    + r")\s",
    re.IGNORECASE,
)
_BETWEEN = re.compile(rf"^(.*?)\s{_LINK}(not\s)?(?:in )?between\s(.+?)\sand\s(.+)$", re.IGNORECASE)
_CORNER = re.compile(
    rf"^(.*?)\s{_LINK}(not\s)?(?:in|at|on|into)\s(?:the|a|an|any|one|some)\s(?:(back|front|far|near|rear|top|bottom)"
    r"(?:\s|-)?)?(?:(left|right)(?:\s|-)?(?:hand )?)?corners?(?:\sof\s.*)?$",
    re.IGNORECASE,
)
_ASIDE = re.compile(
    rf"^(.*?)\s{_LINK}(?:(?:farthest|furthest|most) )?(?:(?:on|to|at) the )?(?:far |very )?(left|right)(?: (?:hand )?side)?$",
    re.IGNORECASE,
)
_NEAR_ME = re.compile(
    rf"^(.*?)\s{_LINK}(?:the )?(nearest|closest|farthest|furthest)(?: away)?(?: one)?$", re.IGNORECASE
)
_MY_SIDE = re.compile(r"\b(?:to|on|at) my (left|right)(?: (?:hand )?side)?$", re.IGNORECASE)
_DETERMINER = re.compile(
    r"^(?:the|a|an|some|all|every|each|any|my|your|our|his|her|their|its|this|that|these|those|one|single|of|only|"
    r"other|such)\s+",
    re.IGNORECASE,
)
_EXCEPT = re.compile(
    r"\s(?:but not|but|without|except for|except|minus|excluding|other than|apart from|aside from|"
    r"(?:(?:that|which) )?(?:is|are) not(?= (?:the|a|an|my) (?!left|right)))\s",
    re.IGNORECASE,
)
_NOT = re.compile(r"^(?:what is |things? that (?:is|are) )?not (?=(?:the|a|an|my) )", re.IGNORECASE)
_BOTH = re.compile(r"\s*,\s*(?:and|or)\s|\s(?:and|or|plus|as well as|together with)\s|\s*,\s*", re.IGNORECASE)
_PICKS: tuple[tuple[str, PickName], ...] = (
    (r"largest|biggest|greatest|hugest|bulkiest", "largest"),
    (r"smallest|tiniest|littlest", "smallest"),
    (r"tallest|highest", "tallest"),
    (r"shortest|lowest|flattest", "shortest"),
    (r"leftmost|left(?! of\b)", "leftmost"),
    (r"rightmost|right(?! of\b)", "rightmost"),
)
_PICK_WORDS = "|".join(f"(?P<p{i}>{words})" for i, (words, _) in enumerate(_PICKS))
_PICK = re.compile(rf"^(?:very |single )?(?:{_PICK_WORDS})(?:\s+(?:one )?(?:of )?|$)(?!of\b)", re.IGNORECASE)
_IS_PICK = re.compile(rf"\s{_LINK}(?:the\s)?(?:{_PICK_WORDS})(?:\sone)?$", re.IGNORECASE)
_EXTREME = re.compile(
    r"^(?:(nearest|closest)|farthest|furthest|most distant)\s+(.+?)(?:\s+(?:away )?(?:to|from)\s+(.+))?$",
    re.IGNORECASE,
)
_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
_QUANTITY = re.compile(
    rf"^(?P<more>more than |over )?(?:at least )?(?P<number>\d{{1,3}}|{'|'.join(_NUMBERS)}|both|several|multiple|many|"
    r"a few|a couple of|a pair of)\s+(?:of\s+)?",
    re.IGNORECASE,
)
_QUALITY = re.compile(
    r"\s(?:,\s*)?(?:that|which|who)\s(?:is|are|was|were|looks?|has|have)\s(not\s)?(.+)$", re.IGNORECASE
)
_MADE_OF = re.compile(
    r"\s(?:(?:that|which)\s(?:is|are|was|were)\s)?(?:made|built)?(?:\s?(?:out\s)?of|\sfrom)\s(\w+)$",
    re.IGNORECASE,
)
_MATERIAL = {"wood": "wooden"}
_THING_WORD = re.compile(
    r"^(?:(.*?)\s)?(?:things?|objects?|items?|everything|anything|something|stuff|ones?|whatever)$",
    re.IGNORECASE,
)
_SOMETHING = re.compile(r"^(?:things?|objects?|items?|anything|something|stuff)\s+(.+)$", re.IGNORECASE)
_VIEWER = re.compile(
    r"^(?:me|us|you|myself|here|the (?:camera|viewer|observer)|(?:my|the) (?:position|viewpoint|view))$",
    re.IGNORECASE,
)
_CORNER_SIDES = {"far": "back", "rear": "back", "top": "back", "near": "front", "bottom": "front"}


def parse(text: str) -> Phrase:
    """The parsed phrase; see `understand`."""
    return understand(text).phrase


def understand(text: str) -> Understood:
    """A phrase or question, parsed.

    Raises:
        QueryError: If a part is empty, a quotation mark is missing, or there are too many parts.
    """
    if len(text) > MAX_LENGTH:
        return Understood(Thing(text.strip()), "too long for grammar: asked for as one thing", unknown=True)
    if text.count('"') % 2:
        raise QueryError(f"phrase {text!r}", expected="quotation marks in pairs", found="an odd number")
    # Quoted parts are replaced by a character that no pattern contains.
    quoted: list[str] = re.findall(r'"([^"]*)"', text)
    numbers = iter(range(len(quoted)))
    hidden = re.sub(r'"[^"]*"', lambda _: f"\x00{next(numbers)}\x00", text.replace("\x00", ""))
    plain = " ".join(hidden.split()).rstrip("?.!").strip()
    asked, mended = with_asking_words(plain[:1].lower() + plain[1:])
    parsed = _Parser(text).phrase(as_phrase(asked))
    note, unknown = mended_note(mended), False
    if left := next(filter(None, map(not_understood, things_of(parsed))), ""):
        parsed, unknown = Thing(plain), True
        note = f'not understood as a question ("{left}"): asked for as one thing, in these words'
    return Understood(with_things(parsed, lambda thing: _unhidden(thing, quoted)), note, unknown)


def _unhidden(thing: Thing, quoted: list[str]) -> Thing:
    shown = re.sub("\x00(\\d+)\x00", lambda match: quoted[int(match[1])], thing.text).strip()
    if not shown:
        raise QueryError(
            "phrase", expected="a thing in the quotation marks", found="nothing", remedy='such as "red mug"'
        )
    return Thing(shown, exact=shown != thing.text)


class _Parser:
    """Recursive descent: what binds loosest is split first."""

    def __init__(self, whole: str) -> None:
        self.whole = whole

    def phrase(self, words: str, depth: int = 0) -> Phrase:
        if depth >= MAX_PARTS:
            raise QueryError(
                f"phrase {self.whole[:40]!r}...",
                expected=f"at most {MAX_PARTS} parts",
                found="more",
                remedy="ask for less at once",
            )
        words, deeper = words.strip(" ,"), depth + 1
        if _VIEWER.match(words):
            return Viewer()
        if found := _NOT.match(words):
            return Except(Anything(), self.phrase(words[found.end() :], deeper))
        words = re.sub(r"\s*,\s*(?=(?:that|which|who)\s)", " ", words)
        if found := _BETWEEN.match(f" {words}"):
            target, negated, first, second = found.groups()
            things = self.phrase(target or "thing", deeper)
            middle = Between(things, self.phrase(first, deeper), self.phrase(second, deeper))
            return Except(things, middle) if negated else middle
        if found := _QUALITY.search(f" {words}"):
            noun, rest = undetermined(f" {words}"[: found.start()].strip()), found[2]
            if not found[1] and not _RELATION.search(f" {words} "[found.start() :]) and _is_quality(rest):
                return self.phrase(f"{rest} {noun}", deeper)
        for splitter, kind in ((_EXCEPT, Except), (_BOTH, Both)):
            parts = splitter.split(f" {words} ", maxsplit=1)
            if len(parts) == 2:
                if kind is Both and "," in words and _all_qualities(parts[1]):  # vase, white
                    return self.phrase(f"{parts[1].strip()} {undetermined(parts[0].strip())}", deeper)
                return kind(self.phrase(parts[0], deeper), self.phrase(parts[1], deeper))
        return self.one(words, deeper)

    def one(self, words: str, depth: int) -> Phrase:
        """A phrase without "and" and "but"."""
        bare, before = words, None
        quantity = 0
        while bare != before:
            before = bare
            if not quantity and (found := _QUANTITY.match(bare)):
                word = found["number"].lower()
                number = int(word) if word.isdigit() else _NUMBERS.index(word) + 1 if word in _NUMBERS else 2
                quantity, bare = number + bool(found["more"]), bare[found.end() :]
            bare = _DETERMINER.sub("", bare)
        if quantity > 1:
            target = self.phrase(bare, depth)
            return replace(target, count=quantity) if isinstance(target, Pick) else AtLeast(quantity, target)
        place = self.place(bare, depth)
        return place if place is not None else self.thing(bare)

    def place(self, words: str, depth: int) -> Phrase | None:
        """A phrase with a place or a superlative; None for a thing."""
        if found := _EXTREME.match(words):
            target, reference = self.phrase(found[2], depth), found[3]
            relation: RelationName = "nearest to" if found[1] else "farthest from"
            return Related(relation, target, self.phrase(reference, depth) if reference else Viewer())
        if found := _PICK.match(words):
            return Pick(_picked(found), self.phrase(words[found.end() :] or "thing", depth))
        if found := _CORNER.match(f" {words}"):
            return self.corner(found, depth)
        words = _MY_SIDE.sub(r"\1 of me", words)
        if found := _RELATION.search(f" {words} "):
            related = self.related(f" {words} ", found, depth)
            if related is not None:
                return related
        for pattern in (_NEAR_ME, _ASIDE):
            if (found := pattern.match(f" {words}")) and found[1].strip():
                target, side = self.phrase(found[1], depth), found[2].lower()
                if side in ("left", "right"):
                    return Pick("leftmost" if side == "left" else "rightmost", target)
                return Related(
                    "nearest to" if side in ("nearest", "closest") else "farthest from", target, Viewer()
                )
        if (found := _IS_PICK.search(f" {words}")) and found.start():
            return Pick(_picked(found), self.phrase(f" {words}"[: found.start()], depth))
        return None

    def related(self, words: str, found: re.Match[str], depth: int) -> Phrase | None:
        """Two phrases in a relation; None if the word of the relation belongs to a thing."""
        number = next(i for i in range(len(_RELATIONS)) if found.group(f"r{i}") is not None)
        target, reference = words[: found.start()].strip(), words[found.end() :].strip()
        if not reference and (" to " in f" {target} "):  # "something to sit on" has no reference
            return None
        if reference.lower() in QUALITIES and _RELATIONS[number][1] == "inside":  # a car in red
            return self.thing(f"{reference} {target}")
        if not target or not reference:
            raise QueryError(
                f"phrase {self.whole!r}",
                expected="a thing on either side",
                found="an empty part",
                remedy='such as: mug left of the lamp; words in "quotation marks" stay together',
            )
        if re.match(r"(?:the )?(?:far |very )?(?:left|right)(?: side)?$", reference) and number == 4:
            return None  # mug on the left
        things = self.phrase(target, depth)
        related = Related(_RELATIONS[number][1], things, self.phrase(reference, depth))
        return Except(things, related) if found.group("not") else related

    def corner(self, found: re.Match[str], depth: int) -> Phrase:
        target, negated, one, other = found.groups()
        along = _CORNER_SIDES.get((one or "").lower(), (one or "").lower())
        name = " ".join(filter(None, (along, (other or "").lower())))
        things = self.phrase(target or "thing", depth)
        corner = InCorner(things, name)  # type: ignore[arg-type]
        return Except(things, corner) if negated else corner

    def thing(self, words: str) -> Phrase:
        if (found := _MADE_OF.search(words)) and ("made" in found[0] or found[1].lower() in QUALITIES):
            material = found[1].lower()
            noun = words[: found.start()].strip()
            if _THING_WORD.match(noun):
                return Thing(f"something made of {material}")
            return self.thing(f"{_MATERIAL.get(material, material)} {noun}")
        if found := _THING_WORD.match(words):
            return thing_of(f"something {found[1]}") if found[1] else Anything()
        if found := _SOMETHING.match(words):
            return thing_of(f"something {found[1]}")
        if not words:
            raise QueryError(
                f"phrase {self.whole!r}",
                expected="a thing on either side",
                found="an empty part",
                remedy='such as: mug left of the lamp; words in "quotation marks" stay together',
            )
        return thing_of(words if " to " in words or not_understood(words) else singular(words))


def thing_of(text: str) -> Phrase:
    """A thing by its words; "something red" and "red toy" are objects of the scene in a color."""
    words = text.lower().split()
    color, target = words.pop() if words[:1] == ["something"] else words.pop(0), " ".join(words)
    color = "gray" if color == "grey" else color
    if color in COLOR_WORDS and (target == "something" or is_kind(target)):
        return Colored(color, Anything() if target == "something" else Thing(target))
    return Thing(text)


def undetermined(words: str) -> str:
    """Words without articles and the like in front."""
    while (shorter := _DETERMINER.sub("", words)) != words:
        words = shorter
    return words


def _picked(found: re.Match[str]) -> PickName:
    return next(name for i, (_, name) in enumerate(_PICKS) if found.group(f"p{i}") is not None)


def _is_quality(words: str) -> bool:
    """Whether words after "that is" describe the noun: at most three, and no superlative or material."""
    parts = words.lower().split()
    first = parts[0]
    names = any(re.fullmatch(pattern, parts[-1]) for pattern, _ in _PICKS)
    return (
        len(parts) <= 3
        and first not in ("the", "a", "an", "made", "built", "not")
        and not names
        and not _NEAR_ME.match(f"x {words}")
    )


def _all_qualities(words: str) -> bool:
    parts = re.split(r"[\s,]+(?:and\s)?", words.strip().lower())
    return all(part in QUALITIES for part in parts)
