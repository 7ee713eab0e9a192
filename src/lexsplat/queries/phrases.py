"""Parsed phrases: things, and the relations between them. `lexsplat.queries.grammar` parses text into them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, Union

if TYPE_CHECKING:
    from lexsplat.queries.selection import Presence

RelationName = Literal[
    "left of", "right of", "in front of", "behind", "on", "under", "above", "below", "inside", "next to",
    "nearest to", "farthest from", "larger than", "smaller than", "taller than", "shorter than", "longer than",
    "wider than",
]  # fmt: skip
PickName = Literal[
    "largest", "smallest", "tallest", "shortest", "widest", "longest", "leftmost", "rightmost"
]  # fmt: skip
CornerName = Literal[
    "", "left", "right", "back", "front", "back left", "back right", "front left", "front right"
]
PartName = Literal["middle", "back", "front", "left", "right", "edge"]
ORDERED = ("nearest to", "farthest from")
"""Relations that compare several instances."""
TO_VIEWER = ("left of", "right of", "in front of", "behind", "next to", *ORDERED)
"""Relations that a thing can have to a viewer."""


@dataclass(frozen=True)
class Thing:
    """A thing to look for, in words for the text encoder.

    Args:
        text: The words, the last one in the singular.
        exact: Whether they were in quotation marks.
        own: The words as they were typed, if they are others: a plural.
    """

    text: str
    exact: bool = field(default=False, compare=False)
    own: str = field(default="", compare=False)

    def __str__(self) -> str:
        return f'"{self.text}"'


@dataclass(frozen=True)
class Anything:
    """Any object, whatever its name: "thing", "object", "everything"."""

    def __str__(self) -> str:
        return "any object"


@dataclass(frozen=True)
class Colored:
    """The instances of ``target`` in a color (`lexsplat.queries.colors`): "red thing", "red toy"."""

    color: str
    target: Phrase

    def __str__(self) -> str:
        return f"({self.color} {self.target})"


@dataclass(frozen=True)
class Viewer:
    """Whoever asks: "closest to me". Stands where the view was taken."""

    def __str__(self) -> str:
        return "the viewer"


@dataclass(frozen=True)
class Related:
    """The instances of ``target`` that stand in a relation to an instance of ``reference``.

    Of the nearest and the farthest it is one, or ``count`` of them from the one with the number ``rank`` on.
    """

    relation: RelationName
    target: Phrase
    reference: Phrase
    count: int = 1
    rank: int = 1

    def __str__(self) -> str:
        return f"({self.target} {_numbered(self)}{self.relation} {self.reference})"


@dataclass(frozen=True)
class Between:
    """The instances of ``target`` between an instance of ``first`` and one of ``second``."""

    target: Phrase
    first: Phrase
    second: Phrase

    def __str__(self) -> str:
        return f"({self.target} between {self.first} and {self.second})"


@dataclass(frozen=True)
class InCorner:
    """The instances of ``target`` in a corner, as the viewer sees it; "" is any corner."""

    target: Phrase
    corner: CornerName = ""

    def __str__(self) -> str:
        return f"({self.target} in {'the ' + self.corner if self.corner else 'a'} corner)"


@dataclass(frozen=True)
class InPart:
    """The instances of ``target`` in a part of the area of ``reference``, as the viewer sees it."""

    target: Phrase
    part: PartName
    reference: Phrase = field(default_factory=Anything)

    def __str__(self) -> str:
        of = "" if self.reference == Anything() else f" of {self.reference}"
        return f"({self.target} {'in' if self.part == 'middle' else 'at'} the {self.part}{of})"


@dataclass(frozen=True)
class Both:
    """The union of two phrases."""

    first: Phrase
    second: Phrase

    def __str__(self) -> str:
        return f"({self.first} or {self.second})"


@dataclass(frozen=True)
class Together:
    """The union of two phrases if the scene has both, else nothing: "is there an apple and a cat?"."""

    first: Phrase
    second: Phrase

    def __str__(self) -> str:
        return f"({self.first} and {self.second})"


@dataclass(frozen=True)
class Except:
    """The first phrase without the second, or (``lacks``) what of the first has nothing of the second in it."""

    first: Phrase
    second: Phrase
    lacks: bool = False

    def __str__(self) -> str:
        return f"({self.first} {'without' if self.lacks else 'minus'} {self.second})"


@dataclass(frozen=True)
class Having:
    """The instances of ``target`` that have an instance of ``reference``, a part: "mug with a handle".

    Args:
        target: The things.
        reference: The part: "mug handle".
        text: The whole phrase, which is asked for where no part is found.
    """

    target: Phrase
    reference: Phrase
    text: str = field(default="", compare=False)

    def __str__(self) -> str:
        return f"({self.target} with {self.reference})"


@dataclass(frozen=True)
class Pick:
    """One instance of several, or ``count`` of them from the one with the number ``rank`` on."""

    which: PickName
    target: Phrase
    count: int = 1
    rank: int = 1

    def __str__(self) -> str:
        return f"({_numbered(self)}{self.which} {self.target})"


@dataclass(frozen=True)
class AtLeast:
    """All instances of ``target`` if there are at least ``count``, and at most ``most`` if given; otherwise none.

    A ``count`` of 0 holds without any: "no mugs", "at most two mugs". A ``definite`` count, "the two mugs", should be
    all that there are.
    """

    count: int
    target: Phrase
    most: int | None = None
    definite: bool = field(default=False, compare=False)

    def __str__(self) -> str:
        if self.count == 0:
            return f"(at most {self.most} {self.target})" if self.most else f"(no {self.target})"
        if self.definite:
            return f"(the {self.count} {self.target})"
        return f"({'at least' if self.most is None else 'exactly'} {self.count} {self.target})"


@dataclass(frozen=True)
class Every:
    """The instances of ``target`` if its own target has no other ones, else nothing: "are all toys on the table?"."""

    target: Phrase

    def __str__(self) -> str:
        return f"(all {parts_of(self.target).get('target', self.target)} are {self.target})"


Phrase = Union[  # noqa: UP007  (forward references)
    Thing,
    Anything,
    Colored,
    Viewer,
    Related,
    Between,
    InCorner,
    InPart,
    Both,
    Together,
    Except,
    Having,
    Pick,
    AtLeast,
    Every,
]
_PARTS = ("target", "reference", "first", "second")


@dataclass(frozen=True)
class Understood:
    """A parsed phrase.

    Args:
        phrase: Things and relations that it names.
        note: Remark on parts not understood; "" if there are none.
        unknown: Whether nothing is certainly here: it holds words that the encoder does not know, or has no grammar.
        unread: Whether it has no grammar: then nothing is certainly absent either.
        may_hide: Whether it asks for what photos may not show, such as the legs of a table: then nothing is absent.
    """

    phrase: Phrase
    note: str = ""
    unknown: bool = False
    unread: bool = False
    may_hide: bool = field(default=False, compare=False)

    def limit(self, present: Presence) -> Presence:
        """The presence of its answer: "unsure" at most where nothing is certainly here, and at least where unread."""
        if self.unread or (self.may_hide and present == "no"):
            return "unsure"
        return "unsure" if self.unknown and present == "yes" else present


def numbered(phrase: Phrase, count: int, rank: int) -> Phrase | None:
    """The phrase with ``count`` instances from number ``rank`` on; None if nothing in it is in an order."""
    if isinstance(phrase, Pick) or (isinstance(phrase, Related) and phrase.relation in ORDERED):
        return replace(phrase, count=count, rank=rank)
    if isinstance(phrase, (Related, Between, InCorner, InPart)):
        target = numbered(phrase.target, count, rank)
        return None if target is None else replace(phrase, target=target)
    return None


def without(phrase: Phrase, other: Phrase) -> Phrase | None:
    """The phrase without ``other`` among the things that it picks or counts; None if it does neither."""
    if isinstance(phrase, (Pick, AtLeast)):
        return replace(phrase, target=without(phrase.target, other) or Except(phrase.target, other))
    if isinstance(phrase, (Related, Between, InCorner, InPart)):
        inner = without(phrase.target, other)
        if inner is None and isinstance(phrase, Related) and phrase.relation in ORDERED:
            inner = Except(phrase.target, other)
        return None if inner is None else replace(phrase, target=inner)
    return None


def among(phrase: Phrase, other: Phrase, inside: bool) -> Phrase:
    """What a phrase names, of that only what another one names, too (``inside``), or all but that."""
    if phrase == Anything() and inside:
        return other
    return Except(phrase, Except(phrase, other) if inside else other)


def placed(place: Phrase, target: Phrase) -> Phrase:
    """A place of any object as the place of ``target``: "left of the mug" as "duck left of the mug"."""
    if isinstance(place, Anything):
        return target
    if isinstance(place, (Related, Between, InCorner, InPart, Pick)):
        return replace(place, target=placed(place.target, target))
    if isinstance(place, (Both, Together)):
        return replace(place, first=placed(place.first, target), second=placed(place.second, target))
    if isinstance(place, Except) and place.first == Anything():
        return Except(target, placed(place.second, target))
    return place


def has_stray_viewer(phrase: Phrase) -> bool:
    """Whether the viewer takes the place of a thing, as in "me" or "mug on me"."""
    relates = isinstance(phrase, Related) and phrase.relation in TO_VIEWER
    return isinstance(phrase, Viewer) or any(
        has_stray_viewer(part)
        for name, part in parts_of(phrase).items()
        if not (relates and name == "reference" and isinstance(part, Viewer))
    )


def _numbered(phrase: Pick | Related) -> str:
    """The rank or number of a pick, as text before it: "2nd ", "3 "."""
    last = {1: "st", 2: "nd", 3: "rd"}.get(phrase.rank if phrase.rank < 20 else phrase.rank % 10, "th")
    rank = f"{phrase.rank}{last} " if phrase.rank > 1 else ""
    return rank + (f"{phrase.count} " if phrase.count > 1 else "")


def mended_note(meant: Mapping[str, str]) -> str:
    """A note on typing errors; "" if there are none."""
    return "; ".join(
        f'"{typed}" may be a typing error: asked for "{right}"' for typed, right in meant.items()
    )


def parts_of(phrase: Phrase) -> dict[str, Phrase]:
    """The phrases that a phrase is made of, by the names of its fields."""
    return {name: getattr(phrase, name) for name in _PARTS if hasattr(phrase, name)}


def things_of(phrase: Phrase) -> list[str]:
    """The texts of all things in a phrase, each once, in order."""
    if isinstance(phrase, Thing):
        return [phrase.text]
    return list(dict.fromkeys(text for part in parts_of(phrase).values() for text in things_of(part)))


def own_words_of(phrase: Phrase) -> dict[str, str]:
    """The words of the things of a phrase as they were typed, by their texts, where they are others."""
    if isinstance(phrase, Thing):
        return {phrase.text: phrase.own} if phrase.own else {}
    return {text: own for part in parts_of(phrase).values() for text, own in own_words_of(part).items()}


def with_things(phrase: Phrase, change: Callable[[Thing], Phrase]) -> Phrase:
    """The same phrase with each thing replaced."""
    if isinstance(phrase, Thing):
        return change(phrase)
    changed: dict[str, Any] = {name: with_things(part, change) for name, part in parts_of(phrase).items()}
    return replace(phrase, **changed)


def in_place_of(second: Phrase, first: Phrase) -> Phrase:
    """The first thing with the place of the second, if that has one."""
    return (
        replace(second, target=first) if isinstance(second, (Related, Between, InCorner, InPart)) else first
    )


def loosened(phrase: Phrase, together: bool) -> Phrase:
    """The phrase with the union in place of `Together`, except if a whole question asks for both."""
    parts = parts_of(phrase)
    keeps = together and isinstance(phrase, Together)
    changed: dict[str, Any] = {name: loosened(part, keeps) for name, part in parts.items()}
    if isinstance(phrase, Together) and not keeps:
        return Both(**changed)
    return replace(phrase, **changed) if changed else phrase


def of_the_picked(phrase: Phrase) -> Phrase:
    """ "Largest (toy on the cloth)" in a statement: whether the largest toy is on the cloth."""
    if not isinstance(phrase, Pick):
        return phrase
    places, among = (Related, Between, InCorner, InPart), phrase.target
    if isinstance(among, places):
        return replace(among, target=replace(phrase, target=among.target))
    if isinstance(among, Except) and isinstance(among.second, places) and among.second.target == among.first:
        one = replace(phrase, target=among.first)
        return Except(one, replace(among.second, target=one))
    return phrase
