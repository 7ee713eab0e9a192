"""The grammar of phrases: things and the relations between them, without a language model.

mug                          a thing; every word goes to the text encoder
mug on the cloth             things by their place
mug not on the cloth         all other mugs
mug next to the duck on the table    right-associative: mug next to (duck on the table)
apple and banana             the union; also "or"
fruit but not the banana     the difference; also "without", "except", "minus"
largest book                 one of several; also "biggest", "smallest"
mug nearest to the lamp      also "closest to"
how many apples              the same as "apple"; the result has the count; also "how many apples are there"
is there a mug               the same as "mug"; also "where is the mug"
"something on wheels"        in quotation marks: one thing, whatever its words
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal, Union

from lexsplat.runtime.errors import QueryError

RelationName = Literal[
    "left of", "right of", "in front of", "behind", "on", "under", "above", "below", "inside", "next to", "nearest to"
]  # fmt: skip

_WORDS: tuple[tuple[str, RelationName], ...] = (
    (r"(?:to|on) the left (?:side )?of|left of", "left of"),
    (r"(?:to|on) the right (?:side )?of|right of", "right of"),
    (r"in front of|before", "in front of"),
    (r"behind|at the back of", "behind"),
    (r"on top of|standing on|lying on|sitting on|upon|on", "on"),
    (r"underneath|beneath|under", "under"),
    (r"above|over", "above"),
    (r"below", "below"),
    (r"inside of|inside|within|in", "inside"),
    (r"next to|beside|close to|near", "next to"),
    (r"nearest to|closest to|nearest|closest", "nearest to"),
)
_RELATION = re.compile(
    r"\s(?:(?:that |which )?(?:is|are)\s(?:there\s)?)?(?P<not>not\s)?(?:"
    + "|".join(f"(?P<r{i}>{words})" for i, (words, _) in enumerate(_WORDS))
    + r")\s",
    re.IGNORECASE,
)
_ARTICLE = re.compile(r"^(?:the|a|an|some|all|every|any|my|this|that)\s+", re.IGNORECASE)
_COUNT = re.compile(r"^(?:how many|count|number of)\s+", re.IGNORECASE)
_QUESTION = re.compile(r"^(?:is there|are there|where is|where are)\s+", re.IGNORECASE)
_THERE = re.compile(r"\s+(?:is|are)(?:\s+there)?$", re.IGNORECASE)
_EXCEPT = re.compile(r"\s(?:but not|without|except for|except|minus)\s", re.IGNORECASE)
_BOTH = re.compile(r"\s(?:and|or)\s|\s*,\s*", re.IGNORECASE)
_PICK = re.compile(r"^(largest|biggest|smallest)\s+", re.IGNORECASE)
_NEAREST = re.compile(r"^(?:nearest|closest)\s+(.+?)\s+to\s+(.+)$", re.IGNORECASE)

_PLURALS = tuple(
    (re.compile(ending, re.IGNORECASE), instead)
    for ending, instead in (
        (r"(\w{2})ies$", r"\1y"),  # berries
        (r"(\w(?:ss|x|z|ch|sh))es$", r"\1"),  # boxes, glasses, brushes
        (r"(\w{2}[^su\Wi])s$", r"\1"),  # apples; not glass, bus, tennis
    )
)


@dataclass(frozen=True)
class Thing:
    """A thing to look for, in words for the text encoder."""

    text: str

    def __str__(self) -> str:
        return f'"{self.text}"'


@dataclass(frozen=True)
class Related:
    """The instances of ``target`` that stand in a relation to an instance of ``reference``."""

    relation: RelationName
    target: Phrase
    reference: Phrase

    def __str__(self) -> str:
        return f"({self.target} {self.relation} {self.reference})"


@dataclass(frozen=True)
class Both:
    """The union of two phrases."""

    first: Phrase
    second: Phrase

    def __str__(self) -> str:
        return f"({self.first} or {self.second})"


@dataclass(frozen=True)
class Except:
    """The first phrase without the second."""

    first: Phrase
    second: Phrase

    def __str__(self) -> str:
        return f"({self.first} minus {self.second})"


@dataclass(frozen=True)
class Pick:
    """One instance of several."""

    which: Literal["largest", "smallest"]
    target: Phrase

    def __str__(self) -> str:
        return f"({self.which} {self.target})"


MAX_PARTS = 100
"""Limit on the number of parts, and so on the depth of the recursion."""

Phrase = Union[Thing, Related, Both, Except, Pick]  # noqa: UP007  (forward references)


def parse(text: str) -> Phrase:
    """The parsed phrase.

    Raises:
        QueryError: If a part is empty, a quotation mark is missing, or there are too many parts.
    """
    if text.count('"') % 2:
        raise QueryError(f"phrase {text!r}", expected="quotation marks in pairs", found="an odd number")
    # Quoted parts are replaced by a character that no pattern contains.
    quoted: list[str] = re.findall(r'"([^"]*)"', text)
    numbers = iter(range(len(quoted)))
    hidden = re.sub(r'"[^"]*"', lambda _: f"\x00{next(numbers)}\x00", text)
    words = " ".join(hidden.split()).rstrip("?.!").strip()
    words = words[:1].lower() + words[1:]
    if (counted := _COUNT.sub("", words)) == words:
        return _parse(_QUESTION.sub("", words), quoted, text)
    return _each(_parse(_THERE.sub("", counted), quoted, text), keep=bool(quoted))


def things_of(phrase: Phrase) -> list[str]:
    """The texts of all things in a phrase, each once, in order."""
    if isinstance(phrase, Thing):
        return [phrase.text]
    if isinstance(phrase, Pick):
        return things_of(phrase.target)
    parts = (
        (phrase.target, phrase.reference) if isinstance(phrase, Related) else (phrase.first, phrase.second)
    )
    return list(dict.fromkeys(text for part in parts for text in things_of(part)))


def _each(phrase: Phrase, keep: bool) -> Phrase:
    """A counted phrase in the singular, as the encoder is asked for one instance. Quoted words stay."""
    if keep:
        return phrase
    if isinstance(phrase, Thing):
        head, of, rest = phrase.text.partition(" of ")
        return Thing(_singular(head) + of + rest)
    if isinstance(phrase, Related):
        return replace(phrase, target=_each(phrase.target, keep))
    if isinstance(phrase, Both):
        return Both(_each(phrase.first, keep), _each(phrase.second, keep))
    if isinstance(phrase, Except):
        second = phrase.second
        if isinstance(second, Related) and second.target == phrase.first:  # "not on": the same things
            second = replace(second, target=_each(second.target, keep))
        return Except(_each(phrase.first, keep), second)
    return phrase


def _singular(words: str) -> str:
    """The last word in the singular, by the rules of English spelling; irregular plurals stay."""
    for ending, instead in _PLURALS:
        if (shorter := ending.sub(instead, words)) != words:
            return shorter
    return words


def _parse(words: str, quoted: list[str], whole: str, depth: int = 0) -> Phrase:
    if depth >= MAX_PARTS:
        subject = f"phrase {whole[:40]!r}..."
        raise QueryError(
            subject, expected=f"at most {MAX_PARTS} parts", found="more", remedy="ask for less at once"
        )
    words, depth = words.strip(), depth + 1
    if (parts := _EXCEPT.split(f" {words} ", maxsplit=1)) and len(parts) == 2:
        return Except(*(_parse(part, quoted, whole, depth) for part in parts))
    if (parts := _BOTH.split(f" {words} ", maxsplit=1)) and len(parts) == 2:
        return Both(*(_parse(part, quoted, whole, depth) for part in parts))
    bare = _ARTICLE.sub("", words)
    if found := _NEAREST.match(bare):
        return Related("nearest to", *(_parse(part, quoted, whole, depth) for part in found.groups()))
    if found := _PICK.match(bare):
        which: Literal["largest", "smallest"] = "smallest" if found[1].lower() == "smallest" else "largest"
        return Pick(which, _parse(bare[found.end() :], quoted, whole, depth))
    if found := _RELATION.search(f" {bare} "):
        number = next(i for i in range(len(_WORDS)) if found.group(f"r{i}") is not None)
        target, reference = f" {bare} "[: found.start()], f" {bare} "[found.end() :]
        # "something to sit on" ends in such a word but has no reference.
        if reference.strip() or " to " not in target:
            things = _parse(target, quoted, whole, depth)
            related = Related(_WORDS[number][1], things, _parse(reference, quoted, whole, depth))
            return Except(things, related) if found.group("not") else related
    text = re.sub("\x00(\\d+)\x00", lambda match: quoted[int(match[1])], bare).strip()
    if not text:
        raise QueryError(
            f"phrase {whole!r}",
            expected="a thing on either side",
            found="an empty part",
            remedy='such as: mug left of the lamp; words in "quotation marks" stay together',
        )
    return Thing(text)
