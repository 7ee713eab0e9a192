"""Things that edits have taken from a scene: their names find nothing, however alike something else is.

Language alone takes a banana for an apple where no apple is left to tell it from. The objects of the scene before and
after the edits know better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lexsplat.queries.selection import Selection
from lexsplat.queries.spelling import singular
from lexsplat.queries.vocabulary import thing_of_part

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


def gone_nouns(scene: Scene) -> frozenset[str]:
    """Nouns of the objects that edits have taken away, where no object of that noun is left.

    A saved edit has them in its ``scene.json`` under "gone". A scene without segments has no objects that would tell.
    """
    if scene.field.segments is None:
        return frozenset()
    known: dict[str, frozenset[str]] = scene.__dict__
    if "_gone" not in known:
        if scene.original is None:
            recorded = scene.folder.record.get("gone") if scene.folder else None
            known["_gone"] = frozenset(filter(_is_text, recorded if isinstance(recorded, list) else ()))
        else:
            before = gone_nouns(scene.original) | _nouns(scene.original.objects)
            known["_gone"] = before - _nouns(scene.objects)
    return known["_gone"]


def noun_of(phrase: str) -> str:
    """The noun of the thing that a phrase names, or names a part of: "apple" of "red apples" and of "apple stem"."""
    return singular((thing_of_part(phrase) or phrase).lower().strip().split(" of ")[0].split()[-1])


def nouns_of(name: str) -> set[str]:
    """The nouns of a name; of "stack of books" both."""
    return {noun_of(name), noun_of(name.split()[-1])}


def _nouns(objects: Sequence[Selection]) -> frozenset[str]:
    return frozenset(noun for each in objects for noun in nouns_of(each.phrase))


def _is_text(value: object) -> bool:
    return isinstance(value, str)
