"""Words of a phrase: articles, numbers, qualities and places, and how a note quotes them."""

from __future__ import annotations

import re
from dataclasses import replace

from lexsplat.queries import patterns
from lexsplat.queries.colors import COLOR_WORDS
from lexsplat.queries.kinds import is_kind
from lexsplat.queries.leftovers import NUMBERS, ORDINALS, left_over
from lexsplat.queries.phrases import (
    Anything,
    AtLeast,
    Between,
    Both,
    Colored,
    Except,
    InCorner,
    InPart,
    Phrase,
    Pick,
    PickName,
    Related,
    RelationName,
    Thing,
    Together,
)
from lexsplat.queries.spelling import singular
from lexsplat.queries.vocabulary import COLORS, NAMES, QUALITIES, SURFACES, is_part_alone
from lexsplat.runtime.errors import QueryError


class IncompleteError(Exception):
    """A phrase is incomplete. The message is the word that is not understood, such as an "on" at its end."""


def own_words(left: str, plain: str) -> str:
    """Words of a text that were not understood, as the text spells them."""
    shown = " ".join(patterns.HIDDEN.sub(" ", plain).split())
    short = re.search(r"\b\w+n['\u2019\u02bc]t\b", shown)
    if short and short[0].lower().startswith(tuple(left.lower().split())):  # don't
        return short[0]
    for words in (left, *left.split(), left_over(shown), *shown.split()[:1]):
        if words and (found := re.search(rf"(?<!\w){re.escape(words)}(?!\w)", shown, re.IGNORECASE)):
            return found[0]
    return shown[:20]


def in_own_letters(note: str, plain: str) -> str:
    """A note whose quotations have the letters of the text, in capitals or not."""

    def own(quoted: re.Match[str]) -> str:
        found = re.search(rf"(?<!\w){re.escape(quoted[1])}(?!\w)", plain, re.IGNORECASE)
        return f'"{found[0]}"' if found else quoted[0]

    return re.sub(r'"([^"]+)"', own, note)


def is_place(words: str) -> bool:
    """Whether words are a place alone: "left of the mug", "not in the corner"."""
    if patterns.RELATION.match(f" {words} "):
        return True
    places = (patterns.BETWEEN, patterns.CORNER, patterns.PART)
    return any((found := place.match(f" {words}")) is not None and not found[1] for place in places)


def thing_of(text: str, own: str = "") -> Phrase:
    """A thing by its words; "something red" and "red toy" are objects of the scene in a color.

    Args:
        text: The words, the last one in the singular.
        own: The words as they were typed.
    """
    words = text.lower().split()
    color, target = words.pop() if words[:1] == ["something"] else words.pop(0), " ".join(words)
    color = "gray" if color == "grey" else color
    if color in COLOR_WORDS and (target == "something" or is_kind(target)):
        return Colored(color, Anything() if target == "something" else Thing(target))
    return Thing(text, own="" if own == text else own)


def unhidden(thing: Thing, quoted: list[str]) -> Thing:
    """A thing with the words of its quoted parts.

    Raises:
        QueryError: If there is nothing in the quotation marks.
    """
    shown = patterns.HIDDEN.sub(lambda match: quoted[int(match[1])], thing.text).strip()
    if not shown:
        raise QueryError(
            "phrase", expected="a thing in the quotation marks", found="nothing", remedy='such as "red mug"'
        )
    return replace(thing, text=shown, exact=shown != thing.text)


def of_the_first(relation: RelationName, reference: str) -> tuple[str, str] | None:
    """What things are related to, and a place behind it that is said of them; None if there is none.

    "Things on the table that are not on the cloth": the table is one, so what "are" is the things. Where the verb
    tells nothing, as in "fruit on the table that is not on the cloth", a second "on" that is denied is of the fruit:
    the table is a surface, of which a scene has few. Any other place is of the nearest noun, as in "mug next to the
    duck on the table".

    Args:
        relation: The relation of the things to the reference.
        reference: The words of the reference, with what is behind it.
    """
    found = patterns.CLAUSE.match(reference)
    if found is None or not is_place(found["clause"]):
        return None
    noun = undetermined(found["noun"])
    several = singular(noun) != noun
    disagrees = bool(found["one"] if several else found["many"])
    second = patterns.RELATION.match(f" {found['clause']} ")
    on_neither = bool(found["not"]) and second is not None and relation_of(second) == relation == "on"
    if disagrees or (on_neither and singular(noun.lower()).split()[-1] in SURFACES):
        return found["noun"], found["clause"]
    return None


def relation_of(found: re.Match[str]) -> RelationName:
    """The relation of a match of `patterns.RELATION`."""
    return next(name for i, (_, name) in enumerate(patterns.RELATIONS) if found.group(f"r{i}"))


def undetermined(words: str) -> str:
    """Words without articles and the like in front."""
    while (shorter := patterns.DETERMINER.sub("", words)) != words:
        words = shorter
    return words


def picked(found: re.Match[str]) -> PickName:
    """The superlative of a match of `patterns.PICK_WORDS`."""
    return next(name for i, (_, name) in enumerate(patterns.PICKS) if found.group(f"p{i}") is not None)


def number(word: str) -> int:
    """Value of a numeral; "several" and the like are two."""
    small = word.lower()
    if digits := re.match(r"\d+", small):
        return int(digits[0])
    return next((words.index(small) + 1 for words in (NUMBERS, ORDINALS) if small in words), 2)


def counted(words: str) -> tuple[str, int, int, bool]:
    """Words without the numbers and articles in front of them, the quantity, the rank, and whether it is exact.

    Raises:
        IncompleteError: If the quantity is 0.
    """
    before, quantity, rank, exact = "", 0, 0, False
    while words != before:
        before = words
        if not rank and (found := patterns.ORDINAL.match(words)):
            rank, words = number(found["number"]), words[found.end() :]
        if not quantity and (found := patterns.QUANTITY.match(words)):
            quantity, words = number(found["number"]) + bool(found["more"]), words[found.end() :]
            exact = bool(found["exact"])
            if not quantity:
                raise IncompleteError(found["number"])
        words = patterns.DETERMINER.sub("", words)
    return words, quantity, rank, exact


def describes(words: str) -> bool:
    """Whether words name a color or the like, but no thing: "the red"."""
    parts = undetermined(words).lower().split()
    return bool(parts) and all(part in COLORS or part in patterns.PATTERNS for part in parts)


def is_quality(words: str) -> bool:
    """Whether words after "that is" describe the noun: at most three, and no superlative or material."""
    parts = words.lower().split()
    first = parts[0]
    names = any(re.fullmatch(pattern, parts[-1]) for pattern, _ in patterns.PICKS)
    return (
        len(parts) <= 3
        and first not in ("the", "a", "an", "made", "built", "not")
        and not names
        and not patterns.NEAR_ME.match(f"x {words}")
    )


def names_things(words: str) -> bool:
    """Whether words behind "that are" name things: "toys", "red cars", "roses"."""
    last = words.lower().split()[-1]
    is_plural = re.search("[^sui]s$", last) is not None
    return last not in QUALITIES and (is_plural or last in NAMES or is_kind(last))


def lacking(first: Phrase, part: Phrase) -> Phrase | None:
    """What has none of a part: "mug without handle"; None where what is taken off is no part of a thing.

    A place behind the part is that of the thing: "mug without a handle on the table".
    """
    if isinstance(part, (Both, Together)):
        without_one = lacking(first, part.first)
        return without_one and lacking(without_one, part.second)
    if isinstance(part, (Related, Between, InCorner, InPart)):
        target = lacking(first, part.target)
        return target and replace(part, target=target)
    if not isinstance(part, Thing) or not is_part_alone(part.text):
        return None
    if isinstance(first, (Pick, AtLeast)):
        target = lacking(first.target, part)
        return target and replace(first, target=target)
    if isinstance(first, Thing) and not is_kind(first.text):
        part = Thing(f"{first.text} {part.text}")
    return Except(first, part, lacks=True)


def all_qualities(words: str) -> bool:
    """Whether each word describes a thing: "red, striped"."""
    parts = re.split(r"[\s,]+(?:and\s)?", words.strip().lower())
    return all(part in QUALITIES for part in parts)
