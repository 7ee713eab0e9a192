"""What a scene lists at a place: whether a thing that a phrase may name is listed as something else.

An encoder that is not sure of a metal duck takes the apple for it. The list of objects says what stands there, and
what color the duck has.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from torch import Tensor

from lexsplat.queries.colors import colors_expected, unqualified, without_color
from lexsplat.queries.parts import HELD
from lexsplat.queries.phrases import Except, Phrase, Thing, parts_of
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import COLORS, is_part, is_part_alone
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.gone import noun_of, nouns_of
from lexsplat.scenes.pixels import object_colors

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene

_MOST = 0.5
"""Share of its Gaussians from which an object is what is taken, or of what is taken from which that is the object."""


def holding(scene: Scene, taken: Tensor) -> list[Selection]:
    """The objects of a scene that have at least `HELD` of some Gaussians ``[N]`` bool."""
    least = HELD * max(int(taken.sum()), 1)
    return [each for each in scene.objects if int(taken[each.indices].sum()) >= least]


def mainly(scene: Scene, taken: Tensor) -> list[Selection]:
    """The objects of a scene that some Gaussians ``[N]`` bool are, or are a part of, for the most part."""
    count = int(taken.sum())
    shared = [(each, int(taken[each.indices].sum())) for each in scene.objects] if count else []
    return [each for each, shares in shared if shares >= _MOST * min(len(each), count)]


def listed_under(scene: Scene, noun: str) -> list[Selection]:
    """The objects of a scene whose names have a noun."""
    return [each for each in scene.objects if noun in nouns_of(each.phrase)]


def listed_as(scene: Scene, phrase: str) -> list[Selection]:
    """The objects that a phrase names without its qualities: those of its noun, or else those that it selects.

    "Cloth" selects what is listed as a tablecloth, and so "white cloth" is that one.
    """
    if named := listed_under(scene, noun_of(phrase)):
        return named
    for plain in dict.fromkeys((without_color(phrase), unqualified(phrase))):
        if plain and plain != phrase and not is_part(plain):
            answers = scene.ask(plain, checked=True)
            if answers.presences[0] == "yes":
                taken = answers.selection(0).mask
                return [
                    each
                    for each in mainly(scene, taken)
                    if int(taken[each.indices].sum()) >= _MOST * len(each)
                ]
    return []


def doubt(scene: Scene, phrase: str, taken: Tensor) -> str:
    """A note on what the scene lists where it may hold what a phrase names; "" if that does not contradict it."""
    if is_part(phrase) or is_part_alone(phrase):
        return ""
    named, places = listed_as(scene, phrase), mainly(scene, taken)
    others = [each for each in places if each not in named]
    expected = colors_expected(phrase)
    notes = []
    if others:
        names = _and(described(scene, each) for each in others)
        notes.append(f'what best fits "{phrase[:60]}" is listed as {names}')
    for each in named if expected else ():
        if not expected & set(object_colors(scene, each)[:1]):
            notes.append(f"the {each.phrase} is mainly {object_colors(scene, each)[0]}")
    return "; ".join(dict.fromkeys(notes))


def described(scene: Scene, thing: Selection) -> str:
    """An object by its main color and its name: "the red apple"."""
    return f"the {name_in_color(scene, thing)}"


def name_in_color(scene: Scene, thing: Selection) -> str:
    """The name of an object, with its main color unless the name tells one."""
    if COLORS & set(thing.phrase.split()):
        return thing.phrase
    return f"{object_colors(scene, thing)[0]} {thing.phrase}"


def refuse_doubtful(scene: Scene, phrase: str, chosen: Selection) -> None:
    """Refuse to change what a scene may not hold, unless the scene lists it by the noun of the phrase.

    Args:
        scene: The scene.
        phrase: The phrase that was asked for.
        chosen: What `Scene.find` selects by it.

    Raises:
        QueryError: If the selection is "unsure", and mainly something else than what the phrase names.
    """
    if chosen.present != "unsure" or not chosen:
        return
    named = [each for text in _targets(scene.understand(phrase).phrase) for each in listed_as(scene, text)]
    inside = sum(int(chosen.mask[each.indices].sum()) for each in {id(each): each for each in named}.values())
    if inside >= _MOST * len(chosen):
        return
    things = mainly(scene, chosen.mask)
    place = ", ".join(f"{value:.2f}" for value in chosen.center)
    found = (
        _and(described(scene, each) for each in things) if things else f"a place at ({place}) without a name"
    )
    names = " or ".join(f'"{name_in_color(scene, each)}"' for each in things)
    raise QueryError(
        phrase[:60],
        expected="something that the scene holds for certain",
        found=f"perhaps {found}",
        remedy=f"select {names} if you mean that, or give --yes" if things else "give --yes to change that",
    )


def _targets(phrase: Phrase) -> list[str]:
    """The texts of the things that a phrase selects, without those that it relates them to."""
    if isinstance(phrase, Thing):
        return [phrase.text]
    parts = parts_of(phrase)
    if "target" in parts:
        return _targets(parts["target"])
    kept = [parts["first"]] if isinstance(phrase, Except) else list(parts.values())
    return [text for part in kept for text in _targets(part)]


def _and(names: Iterable[str]) -> str:
    return " and ".join(dict.fromkeys(names))
