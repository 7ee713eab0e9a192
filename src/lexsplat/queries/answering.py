"""The evaluation of parsed phrases: which instances a phrase describes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.having import part_of_any
from lexsplat.queries.kinds import is_kind, is_of_kind
from lexsplat.queries.phrases import (
    ORDERED,
    TO_VIEWER,
    Anything,
    AtLeast,
    Between,
    Both,
    Colored,
    Every,
    Except,
    Having,
    InCorner,
    InPart,
    Phrase,
    Pick,
    Related,
    RelationName,
    Thing,
    Together,
    Viewer,
    parts_of,
    things_of,
)
from lexsplat.queries.relations import (
    Frame,
    beside_viewer,
    between,
    frame_of,
    in_corner,
    in_order,
    in_part,
    nearest,
    related,
    same,
)
from lexsplat.queries.selection import PRESENCES, Presence, Selection, union
from lexsplat.queries.viewers import DIRECTED, Viewers, view_name
from lexsplat.queries.vocabulary import COLORS, NAMES, SURFACES
from lexsplat.runtime.errors import QueryError

_LARGE = 0.05
"""A selection of this share of a scene may be several objects; smaller ones are taken as they are."""
_HELD_BY: tuple[RelationName, ...] = ("on", "inside")
"""Relations of a thing to the thing that holds it."""
_WHOLE = 0.5
"""An object belongs to a selection that has this share of its Gaussians."""


@dataclass(frozen=True)
class Searched:
    """The scene as the evaluation of a phrase sees it.

    Args:
        select: The selection of a thing, by its text.
        viewer: The camera of whoever asks, given the reference of a direction; None asks for that of "me". No camera
            leaves a direction to the views (`lexsplat.queries.viewers`).
        objects: The objects of the scene with their names in ``phrase``: what "thing" can be.
        colors: The color words of an instance, the most frequent first (`lexsplat.queries.colors`).
    """

    select: Callable[[str], Selection]
    viewer: Callable[[Selection | None], Camera | None]
    objects: Callable[[], Sequence[Selection]] = tuple
    colors: Callable[[Selection], Sequence[str]] = lambda _: ()


def answer(phrase: Phrase, searched: Searched) -> Selection:
    """The selection that a phrase describes; an empty one, with presence "no", if the scene has nothing that fits.

    Args:
        phrase: From `lexsplat.queries.grammar.parse`.
        searched: The scene to ask.

    Raises:
        QueryError: If the phrase relates something to the viewer in a way that has no meaning, such as "on me".
    """
    if isinstance(phrase, Thing):
        members = () if phrase.exact else _members(phrase.text, searched)
        selected = searched.select(phrase.text)
        if selected.present == "no" and not phrase.exact and (part := part_of_any(phrase.text)):
            return _with_part(selected, searched.select(part), searched)
        return _joined(selected, members, present="yes") if members else apart(selected, searched)
    found = _ANSWERS[type(phrase)](phrase, searched)
    # An empty result is a "no", whatever the presence of the parts, unless none is asked for.
    may_be_none = isinstance(phrase, AtLeast) and phrase.count == 0
    if (not found and not may_be_none) or found.present == "no":
        found = replace(found, mask=torch.zeros_like(found.mask), parts=(), present="no")
    return replace(found, phrase=str(phrase))


def _asks_what_fills(phrase: Phrase) -> bool:
    """Whether a phrase asks what is in something, which may be what no list of objects has: coffee."""
    return isinstance(phrase, Related) and phrase.relation == "inside" and phrase.target == Anything()


def _members(text: str, searched: Searched) -> tuple[Selection, ...]:
    """The objects of the kind that a text names (`lexsplat.queries.kinds`)."""
    if not is_kind(text):
        return ()
    return tuple(each for each in searched.objects() if is_of_kind(each.phrase, text))


def apart(selection: Selection, searched: Searched) -> Selection:
    """A selection whose instances are single objects.

    "Toy" scores high all over a table, so that several objects and the table are one cluster. Where a cluster has
    several known objects, the objects are scored as wholes (by their median) and those close to the best are taken,
    by the rule of `Selection.convincing`. Phrases with an everyday name, such as "red mug", stay as they are.
    """
    large = len(selection) >= _LARGE * len(selection.mask)
    if selection.present == "no" or not large or NAMES & set(selection.phrase.lower().split()):
        return selection
    objects = _things(searched)
    inside = [each for each in objects if selection.mask[each.indices].sum() >= _WHOLE * len(each)]
    if len(inside) < 2 or len(inside) <= selection.count:
        return selection
    scores = [float(selection.scores[each.indices].median()) for each in objects]
    limit = selection.convincing_limit(max(scores))
    kept = tuple(
        each.described(scores=selection.scores) for each, score in zip(objects, scores) if score >= limit
    )
    return _joined(selection, kept)


def _anything(phrase: Anything, searched: Searched) -> Selection:
    things = _things(searched)
    return _joined(things[0] if things else searched.select("object"), things, present="yes")


def _things(searched: Searched) -> tuple[Selection, ...]:
    return tuple(each for each in searched.objects() if each.phrase not in SURFACES)


def _colored(phrase: Colored, searched: Searched) -> Selection:
    """The instances with this main color; if there are none, those that also have it, which are "unsure"."""
    targets = answer(phrase.target, searched)
    colors = [(searched.colors(each), each) for each in _certain(targets)]
    main = tuple(each for words, each in colors if phrase.color in words[:1])
    also = () if main else tuple(each for words, each in colors if phrase.color in words)
    if not also:
        return _joined(targets, main)
    kind = phrase.target.text if isinstance(phrase.target, Thing) else "thing"
    notes = (targets.note, f"no {kind} is mainly {phrase.color}")
    present = min(targets.present, "unsure", key=PRESENCES.index)
    return replace(_joined(targets, also, present), note="; ".join(filter(None, notes)))


def _related(phrase: Related, searched: Searched) -> Selection:
    targets = answer(phrase.target, searched)
    if isinstance(phrase.target, Anything) and phrase.relation in ("under", "below"):
        targets = _joined(targets, tuple(searched.objects()), present="yes")
    if isinstance(phrase.reference, Viewer):
        camera = searched.viewer(None)
        if camera is None or phrase.relation not in TO_VIEWER:
            raise QueryError(
                str(phrase),
                expected="a place as seen by a viewer, in a scene with views",
                found=f"{phrase.relation} {phrase.reference}",
                remedy='such as "closest to me" or "in front of me"',
            )
        frame = frame_of(camera, targets.up.direction)
        found = beside_viewer(phrase.relation, targets, camera, frame, count=phrase.count, rank=phrase.rank)
        return _seen(found, view_name(camera, targets.cameras))
    references = answer(phrase.reference, searched)
    if phrase.relation in ORDERED:
        farthest = phrase.relation == "farthest from"
        found = nearest(targets, references, farthest=farthest, count=phrase.count, rank=phrase.rank)
    else:
        directed = phrase.relation in DIRECTED and bool(references)
        viewers = Viewers(phrase.relation, references, searched.viewer(references) if directed else None)
        found = related(phrase.relation, targets, references, viewers.frame)
        if directed:
            found = _seen(replace(found, note=""), viewers.seen_from)
        if not found and references.present != "no" and _asks_what_fills(phrase):
            note = f"no object is listed inside {phrase.reference}; what else may fill it is not told"
            return replace(_joined(found, ()), note=note)
    return replace(found, present=min(found.present, references.present, key=PRESENCES.index))


def _between(phrase: Between, searched: Searched) -> Selection:
    targets, first, second = (answer(part, searched) for part in (phrase.target, phrase.first, phrase.second))
    found = between(targets, first, second)
    return replace(found, present=min(found.present, first.present, second.present, key=PRESENCES.index))


def _corner(phrase: InCorner, searched: Searched) -> Selection:
    targets = answer(phrase.target, searched)
    found = in_corner(targets, _anything(Anything(), searched), phrase.corner, _frame(searched, targets))
    return _seen(found, _view(searched, targets)) if phrase.corner else found


def _part(phrase: InPart, searched: Searched) -> Selection:
    targets = answer(phrase.target, searched)
    frame = _frame(searched, targets)
    reference = answer(phrase.reference, searched)
    if phrase.reference != Anything():
        held = [related(relation, targets, reference, frame).parts for relation in _HELD_BY]
        targets = _joined(targets, (*held[0], *(each for each in held[1] if each not in held[0])))
    found = in_part(targets, reference, phrase.part, frame)
    found = replace(found, present=min(found.present, reference.present, key=PRESENCES.index))
    return found if phrase.part in ("middle", "edge") else _seen(found, _view(searched, targets))


def _both(phrase: Both | Together, searched: Searched) -> Selection:
    first, second = answer(phrase.first, searched), answer(phrase.second, searched)
    lacking = [
        each.note or f"nothing fits {part}"
        for part, each in ((phrase.first, first), (phrase.second, second))
        if each.note or each.present == "no"
    ]
    one_noun = _is_one_noun(phrase)
    if one_noun and isinstance(phrase, Both) and {first.present, second.present} == {"yes", "unsure"}:
        # "Red or green apple": what is only perhaps a green one does not count beside a red one.
        first, second = (each if each.present == "yes" else _joined(each, ()) for each in (first, second))
    found = _united(first, second, colors_of_one=one_noun)
    if isinstance(phrase, Together):
        present = min(first.present, second.present, key=PRESENCES.index)
        found = replace(_joined(found, ()) if present == "no" else found, present=present)
    return replace(found, note="; ".join(lacking))


def _is_one_noun(phrase: Both | Together) -> bool:
    """Whether a union is of one thing in several colors: "red apple or green apple"."""
    if not all(isinstance(part, (Thing, Both, Together)) for part in (phrase.first, phrase.second)):
        return False
    return len({frozenset(text.lower().split()) - COLORS for text in things_of(phrase)}) == 1


def _united(first: Selection, second: Selection, colors_of_one: bool = False) -> Selection:
    """The union; with ``colors_of_one`` thing, an instance inside another is not counted."""
    instances = [*_certain(first), *_certain(second)]
    if colors_of_one:
        instances.sort(key=len, reverse=True)

    def is_again(each: Selection, other: Selection) -> bool:
        inside = colors_of_one and int(other.mask[each.indices].sum()) > _WHOLE * len(each)
        return inside or same(each, other)

    kept = [
        each
        for number, each in enumerate(instances)
        if not any(is_again(each, other) for other in instances[:number])
    ]
    return _joined(first | second, tuple(kept))


def _except(phrase: Except, searched: Searched) -> Selection:
    first, second = answer(phrase.first, searched), answer(phrase.second, searched)
    others = _certain(second)
    if isinstance(phrase.second, Colored) and second.present == "unsure":
        others = []  # a thing that is only partly red is not red
    if phrase.lacks:
        return _joined(first, tuple(_without_any(_certain(first), others)))
    kept = []
    for each in _certain(first):
        shared = sum(int(other.mask[each.indices].sum()) for other in others)
        if shared <= _WHOLE * len(each) and not any(same(each, other) for other in others):
            kept.append(each - second if shared else each)
    return _joined(first, tuple(kept))


def _having(phrase: Having, searched: Searched) -> Selection:
    """The things that have a part; where no part is found, those that the whole phrase selects."""
    targets, parts = answer(phrase.target, searched), answer(phrase.reference, searched)
    things, found = _certain(targets), _certain(parts)
    if found:
        having = _owners(things, found)
        present = min(targets.present, parts.present, key=PRESENCES.index)
    else:
        whole = searched.select(phrase.text)
        taken = whole.mask if whole.present != "no" else torch.zeros_like(whole.mask)
        having = {n for n, each in enumerate(things) if int(taken[each.indices].sum()) > _WHOLE * len(each)}
        present = min(targets.present, whole.present, key=PRESENCES.index)
    kept = tuple(each for number, each in enumerate(things) if number in having)
    notes = "; ".join(dict.fromkeys(filter(None, (targets.note, parts.note if kept else ""))))
    return replace(_joined(targets, kept, present), note=notes)


def _with_part(selected: Selection, parts: Selection, searched: Searched) -> Selection:
    """The objects that have a part, whatever their names, as sure as the part is; else what is selected."""
    things, found = _things(searched), _certain(parts)
    if not things or not found:
        return selected
    kept = tuple(things[number] for number in sorted(_owners(list(things), found)))
    return replace(_joined(selected, kept, parts.present), note=parts.note)


def _without_any(things: list[Selection], parts: list[Selection]) -> list[Selection]:
    """The things that have none of some parts."""
    having = _owners(things, parts)
    return [each for number, each in enumerate(things) if number not in having]


def _owners(things: list[Selection], parts: list[Selection]) -> set[int]:
    """The numbers of the things that have parts; a part is that of the thing it is in, or else of the nearest one."""

    def owner(part: Selection) -> int:
        inside = [int(each.mask[part.indices].sum()) for each in things]
        apart = [float(np.linalg.norm(each.center - part.center)) for each in things]
        return int(np.argmax(inside) if max(inside) else np.argmin(apart))

    return {owner(part) for part in parts} if things else set()


def _pick(phrase: Pick, searched: Searched) -> Selection:
    targets = answer(phrase.target, searched)
    if not targets:
        return targets
    right = _frame(searched, targets).right
    measure: Callable[[Selection], float] = {
        "largest": lambda each: each.box.volume,
        "smallest": lambda each: -each.box.volume,
        "tallest": lambda each: each.box.half_sizes[2],
        "shortest": lambda each: -each.box.half_sizes[2],
        "widest": lambda each: max(each.box.half_sizes[:2]),
        "longest": lambda each: max(each.box.half_sizes),
        "leftmost": lambda each: -float(each.center @ right),
        "rightmost": lambda each: float(each.center @ right),
    }[phrase.which]
    ranked = sorted(targets.instances, key=measure, reverse=True)
    found = _joined(targets, tuple(in_order(ranked, phrase.count, phrase.rank)))
    return _seen(found, _view(searched, targets)) if phrase.which in ("leftmost", "rightmost") else found


def _at_least(phrase: AtLeast, searched: Searched) -> Selection:
    found = answer(phrase.target, searched)
    if phrase.count == 0:
        return _at_most(phrase, found)
    if phrase.count <= found.count <= (found.count if phrase.most is None else phrase.most):
        told = (
            f"{found.count} found, not {phrase.count}"
            if phrase.definite and found.count > phrase.count
            else ""
        )
        return replace(found, note="; ".join(filter(None, (found.note, told))))
    return replace(_joined(found, ()), note=f"{found.count} found of {phrase.target}")


def _at_most(phrase: AtLeast, found: Selection) -> Selection:
    """What is found, if it is little enough: if it is nothing, the answer is "yes" without instances."""
    count = len(_certain(found))
    fits, note = count <= (phrase.most or 0), f"{count} found of {phrase.target}"
    if found.present == "unsure":
        return found if fits else replace(_joined(found, ()), note=note)
    if count == 0:
        return replace(_joined(found, ()), present="yes", note=note)
    return found if fits else replace(_joined(found, ()), present="no", note=note)


def _every(phrase: Every, searched: Searched) -> Selection:
    found = answer(phrase.target, searched)
    among = answer(parts_of(phrase.target)["target"], searched)
    if found.count >= among.count:
        return found
    return replace(_joined(found, ()), note=f"{found.count} of {among.count} are {phrase.target}")


def _viewer(phrase: Viewer, searched: Searched) -> Selection:
    raise QueryError(
        "the viewer", expected="a thing", found="a person", remedy='such as "mug in front of me"'
    )


_ANSWERS: dict[type, Callable[..., Selection]] = {
    Anything: _anything, Colored: _colored, Related: _related, Between: _between, InCorner: _corner, InPart: _part,
    Both: _both, Together: _both, Except: _except, Having: _having, Pick: _pick, AtLeast: _at_least, Every: _every,
    Viewer: _viewer,
}  # fmt: skip


def _certain(selection: Selection) -> list[Selection]:
    """The instances of an answer; none if it is a "no"."""
    return [] if selection.present == "no" else selection.instances


def _joined(like: Selection, parts: tuple[Selection, ...], present: Presence | None = None) -> Selection:
    """The union of instances, which stay apart."""
    scores = like.scores.clone() if parts else like.scores
    for part in parts:
        scores[part.indices] = torch.maximum(scores[part.indices], part.scores[part.indices])
    return replace(
        like, mask=union(like.mask, parts), scores=scores, parts=parts, present=present or like.present
    )


def _seen(found: Selection, view: str) -> Selection:
    """An answer that depends on a viewpoint, with a note that names the view."""
    notes = (found.note, view and f"as seen from {view}")
    return replace(found, note="; ".join(dict.fromkeys(filter(None, notes))), seen_from=view)


def _view(searched: Searched, targets: Selection) -> str:
    return view_name(searched.viewer(None), targets.cameras)


def _frame(searched: Searched, targets: Selection) -> Frame:
    return frame_of(searched.viewer(None), np.asarray(targets.up.direction))
