"""The objects of a scene that have everyday names: what "thing" and "everything" can be."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lexsplat.queries.relations import same
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import default_vocabulary

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


def named_objects(scene: Scene) -> tuple[Selection, ...]:
    """The instances of all everyday words in a scene, each with its name in ``phrase``.

    Of several names for one place, the one that scores highest there is kept. The vocabulary is that of
    `lexsplat.queries.vocabulary`: what it has no word for is not found.
    """
    answers = scene.ask(default_vocabulary(scene.clip))
    found = [
        instance
        for number, presence in enumerate(answers.presences)
        if presence != "no"
        for instance in answers.selection(number).instances
    ]
    kept: list[Selection] = []
    for instance in sorted(found, key=lambda each: -each.score):
        if not any(same(instance, other) for other in kept):
            kept.append(instance)
    return tuple(kept)
