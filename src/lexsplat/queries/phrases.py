"""What a phrase asks for: things, and the relations between them. `lexsplat.queries.grammar` parses text into it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Union

RelationName = Literal[
    "left of", "right of", "in front of", "behind", "on", "under", "above", "below", "inside", "next to",
    "nearest to", "farthest from",
]  # fmt: skip
PickName = Literal["largest", "smallest", "tallest", "shortest", "leftmost", "rightmost"]
CornerName = Literal[
    "", "left", "right", "back", "front", "back left", "back right", "front left", "front right"
]


@dataclass(frozen=True)
class Thing:
    """A thing to look for, in words for the text encoder; ``exact`` words were in quotation marks."""

    text: str
    exact: bool = field(default=False, compare=False)

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
    """The instances of ``target`` that stand in a relation to an instance of ``reference``."""

    relation: RelationName
    target: Phrase
    reference: Phrase

    def __str__(self) -> str:
        return f"({self.target} {self.relation} {self.reference})"


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
    """One instance of several, or the first ``count`` of them if there are as many."""

    which: PickName
    target: Phrase
    count: int = 1

    def __str__(self) -> str:
        return (
            f"({self.count} {self.which} {self.target})"
            if self.count > 1
            else f"({self.which} {self.target})"
        )


@dataclass(frozen=True)
class AtLeast:
    """All instances of ``target`` if there are as many as asked for, else nothing."""

    count: int
    target: Phrase

    def __str__(self) -> str:
        return f"(at least {self.count} {self.target})"


Phrase = Union[  # noqa: UP007  (forward references)
    Thing, Anything, Colored, Viewer, Related, Between, InCorner, Both, Except, Pick, AtLeast
]
_PARTS = ("target", "reference", "first", "second")


@dataclass(frozen=True)
class Understood:
    """A parsed phrase.

    Args:
        phrase: What it asks for.
        note: What was not understood; "" if everything was.
        unknown: Whether nothing is certainly here: it holds words that the encoder does not know, or has no grammar.
    """

    phrase: Phrase
    note: str = ""
    unknown: bool = False


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


def with_things(phrase: Phrase, change: Callable[[Thing], Phrase]) -> Phrase:
    """The same phrase with each thing replaced."""
    if isinstance(phrase, Thing):
        return change(phrase)
    changed: dict[str, Any] = {name: with_things(part, change) for name, part in parts_of(phrase).items()}
    return replace(phrase, **changed)
