"""Lengths between two things of a scene, in world units and in meters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lexsplat.geometry.world import World
from lexsplat.queries.places import UNITS
from lexsplat.scenes.answers import find_best_views
from lexsplat.scenes.asked import both, joined, things_of
from lexsplat.scenes.pairs import different, measured, view_of
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import qualified, shortened


def measure(scene: Scene, first: str, second: str) -> dict[str, Any]:
    """The document of ``lexsplat measure --json``: lengths between two different things, found by phrases.

    If a phrase fits several things, the pair with the smallest gap is measured, and "note" names it.

    Args:
        scene: The scene to ask.
        first: A free-text phrase.
        second: Another one; it may fit the things of the first as well.

    Returns:
        Up and scale of the scene, "understood", "note", "present", "threshold", "best_view"; the two things as
        "first" and "second" (`Selection.geometry`); "centers" (between the centers of their boxes), "gap" (between
        their surfaces) and "height" (of the second center above the first), each as of `length_of`.

    Raises:
        QueryError: If the scene does not hold one of them, or both are the same thing.
    """
    (ones, first_asked), (ends, also) = things_of(scene, first), things_of(scene, second)
    gap, one, other = different(ones, ends, f"{first[:60]} and {second[:60]}")
    find_best_views(scene, [one, other])
    asked = both(first_asked, also, "and", view_of(one, other))
    asked["note"] = joined(asked["note"], measured((one, ones, first_asked), (other, ends, also)))
    offset = other.center - one.center
    rise = float(offset @ np.asarray(one.up.direction))
    lengths = {"centers": float(np.linalg.norm(offset)), "gap": gap, "height": rise}
    return {
        **scene.world.to_json(),
        **asked,
        "first": one.geometry(),
        "second": other.geometry(),
        **{name: length_of(scene.world, value) for name, value in lengths.items()},
    }


def measured_sentence(document: Mapping[str, Any]) -> str:
    """A document of `measure` in one plain sentence."""
    rise = document["height"]
    amount = {name: value and abs(value) for name, value in rise.items()}
    text = (
        f"{shortened(document['understood'])}: {in_words(document['centers'])} between their centers, "
        f"{in_words(document['gap'])} between their surfaces; the second is {in_words(amount)} "
        f"{'higher' if rise['units'] >= 0 else 'lower'}."
    )
    return qualified(text, document)


def length_of(world: World, value: float) -> dict[str, float | None]:
    """A length in world units as plain data: "units", and "meters", which is None where the scale is unknown."""
    meters = world.meters(value)
    return {"units": round(value, 5), "meters": None if meters is None else round(meters, 5)}


def in_words(length: Mapping[str, float | None]) -> str:
    """A length (`length_of`) for a sentence: in meters where they are known, else in scene units."""
    meters = length["meters"]
    return f"{length['units']:.3g} {UNITS}" if meters is None else f"{meters:.3g} m"
