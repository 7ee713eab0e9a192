"""The nearest two different things among those that two phrases name, and a note on the choice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lexsplat.queries.places import lengths_of, position
from lexsplat.queries.relations import distance, same
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.serving import shortened


def different(
    firsts: Sequence[Selection], seconds: Sequence[Selection], asked: str
) -> tuple[float, Selection, Selection]:
    """The two different things with the smallest gap; of equal gaps, with the nearest centers.

    Args:
        firsts: Candidates for the first thing.
        seconds: Candidates for the second thing; some may be among ``firsts``.
        asked: The subject of the error.

    Returns:
        The distance between their surfaces, world units, and the two.

    Raises:
        QueryError: If there is only one thing.
    """
    centers = [np.array([one.center for one in things]).reshape(-1, 3) for things in (firsts, seconds)]
    reaches = [np.array([_reach(one) for one in things]) for things in (firsts, seconds)]
    apart = np.linalg.norm(centers[0][:, None] - centers[1][None], axis=2)
    least = np.maximum(apart - reaches[0][:, None] - reaches[1][None], 0)
    best: tuple[float, float, Selection, Selection] | None = None
    for number in np.lexsort((apart.ravel(), least.ravel())):  # none after a larger bound can be nearer
        row, column = divmod(int(number), len(seconds))
        if best is not None and least[row, column] > best[0]:
            break
        first, second = firsts[row], seconds[column]
        if not same(first, second):
            pair = (distance(first, second), float(apart[row, column]), first, second)
            best = pair if best is None or pair[:2] < best[:2] else best
    if best is None:
        raise QueryError(
            asked,
            expected="two different things",
            found=f"one thing alone, {called(firsts[0], firsts)}",
            remedy='name another target, such as "thing" for any object',
        )
    return best[0], best[2], best[3]


def measured(*ends: tuple[Selection, Sequence[Selection], dict[str, Any]]) -> str:
    """A note on the pair that was taken; "" where each phrase fits one thing.

    Args:
        ends: Thing that was taken, its candidates, and how its phrase was understood.
    """
    fits = [(shortened(asked["understood"]), len(things)) for _, things, asked in ends if len(things) > 1]
    if not fits:
        return ""
    counts = " and ".join(f"{text} fits {count}" for text, count in dict.fromkeys(fits))
    names = " and ".join(called(one, things) for one, things, _ in ends)
    return f"{counts} things; measured is the nearest pair, {names}"


def others(things: Sequence[Selection], than: Sequence[Selection]) -> list[Selection]:
    """The things that are not among some others."""
    return [one for one in things if not any(same(one, each) for each in than)]


def called(one: Selection, among: Sequence[Selection]) -> str:
    """Name of a thing, with its place if another thing has the same name."""
    if sum(each.phrase == one.phrase for each in among) < 2:
        return one.phrase
    return f"{one.phrase} at {position(lengths_of(one))}"


def view_of(first: Selection, second: Selection) -> str:
    """The view that shows two things best: the larger the less visible one is, the better."""
    shares = dict(first.view_shares), dict(second.view_shares)
    both = {name: min(share, shares[1][name]) for name, share in shares[0].items() if name in shares[1]}
    name = max(both, key=lambda each: both[each], default="")
    return name if both.get(name) else (first | second).best_view


def _reach(one: Selection) -> float:
    """The distance of its farthest point from its center."""
    return float(np.linalg.norm(one.sample - one.center, axis=1).max())
