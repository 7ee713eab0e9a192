"""How selections stand to each other: left of, on, inside, nearest, ..., and the answer to a parsed phrase.

"Left", "right", "before" and "behind" are the viewer's, with feet on the ground: his axes are laid level by
gravity. "On", "above", "under" are gravity's alone. Relations hold between instances, by their upright boxes and
their points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.geometry.boxes import upright_frame
from lexsplat.geometry.cameras import Camera
from lexsplat.queries.phrases import Both, Except, Phrase, Pick, RelationName, Thing
from lexsplat.queries.selection import PRESENCES, Presence, Selection

_CONE = 0.5
"""Sideways means: at least this share of the level offset goes that way (within 60 degrees)."""
_NEAR = 0.5
"""Next to means: the gap is at most this many times the diagonal of the smaller footprint (tall things are no nearer
to each other for being tall)."""
_SUPPORT = 0.5
"""On means: the gap below is at most this many times the thing's height. Feet of things are often left out of
selections: they stand in their own shadow."""
_OVER = 0.3
"""Over means: at least this share of the smaller of the two is over, or under, the other's footprint."""
_INSIDE = 0.6
"""Inside means: at least this share of it lies in the other's box."""
_SAME_SIZE = 0.1
"""Two names of one thing have boxes whose volumes differ by less than this factor."""
_SAMPLE = 4000


@dataclass(frozen=True)
class Frame:
    """The axes that words of direction refer to, each ``[3]``, of unit length.

    Args:
        right: To the viewer's right, level.
        ahead: Away from the viewer, level.
        up: Away from the ground.
    """

    right: NDArray[np.float64]
    ahead: NDArray[np.float64]
    up: NDArray[np.float64]


def frame_of(camera: Camera | None, up: NDArray[np.float64]) -> Frame:
    """The frame of somebody who stands at a camera; any level directions where there is none.

    A camera that looks straight down has no level view direction: the top of its picture is then ahead.
    """
    upwards = np.asarray(up, float) / np.linalg.norm(up)
    if camera is None:
        right, ahead, upwards = upright_frame(upwards)
        return Frame(right, ahead, upwards)
    ahead = camera.forward - (camera.forward @ upwards) * upwards
    if np.linalg.norm(ahead) < 0.2:
        top = -camera.viewmat[1, :3]
        ahead = top - (top @ upwards) * upwards
    ahead = ahead / np.linalg.norm(ahead)
    return Frame(np.cross(ahead, upwards), ahead, upwards)


def holds(relation: RelationName, target: Selection, reference: Selection, frame: Frame) -> bool:
    """Whether one thing stands in a relation to another; both are single things (instances).

    "nearest to" compares several and is `nearest`.

    Raises:
        ValueError: If the relation is unknown or is "nearest to".
    """
    if not target or not reference:
        return False
    if relation in ("left of", "right of", "in front of", "behind"):
        return _sideways(relation, target, reference, frame)
    if relation == "on":
        return _rests_on(target, reference, frame) or _stands_over(target, reference, frame)
    if relation == "under":
        return _rests_on(reference, target, frame) or _over(reference, target, frame)
    if relation in ("above", "below"):
        upper, lower = (target, reference) if relation == "above" else (reference, target)
        return _over(upper, lower, frame)
    if relation == "inside":
        share = float(reference.box.contains(_points(target)).mean())
        return bool(share >= _INSIDE and target.box.volume < reference.box.volume)
    if relation == "next to":
        smaller = min(np.linalg.norm(target.size[:2]), np.linalg.norm(reference.size[:2]))
        return bool(distance(target, reference) <= _NEAR * smaller) and not _over(target, reference, frame)
    raise ValueError(f"no such relation between two things: {relation!r}")


def related(relation: RelationName, targets: Selection, references: Selection, frame: Frame) -> Selection:
    """Those instances of ``targets`` that stand in a relation to an instance of ``references``."""
    pairs = [
        target
        for target in targets.instances
        if any(
            holds(relation, target, reference - target, frame)  # what both words mean supports nothing
            for reference in references.instances
            if not _same(target, reference)
        )
    ]
    return _union(targets, pairs)


def nearest(targets: Selection, references: Selection) -> Selection:
    """The instance of ``targets`` with the smallest gap to any instance of ``references``."""
    pairs = [
        (distance(target, reference), number)
        for number, target in enumerate(targets.instances)
        for reference in references.instances
        if not _same(target, reference)
    ]
    return _union(targets, [targets.instances[min(pairs)[1]]] if pairs else [])


def distance(first: Selection, second: Selection) -> float:
    """The gap between two selections: the least distance between their points, world units.

    Raises:
        ValueError: If one is empty.
    """
    if not first or not second:
        raise ValueError("an empty selection is nowhere")
    apart, _ = cKDTree(_points(first)).query(_points(second))
    return float(np.quantile(apart, 0.002))  # one stray Gaussian does not close a gap


def answer(
    phrase: Phrase, select: Callable[[str], Selection], viewer: Callable[[Selection], Camera | None]
) -> Selection:
    """The selection a phrase asks for.

    Args:
        phrase: From `lexsplat.queries.phrases.parse`.
        select: Finds a thing by its words.
        viewer: Who looks, given what directions refer to.
    """
    if isinstance(phrase, Thing):
        return select(phrase.text)
    present: Presence | None = None
    if isinstance(phrase, Both):
        found = answer(phrase.first, select, viewer) | answer(phrase.second, select, viewer)
    elif isinstance(phrase, Except):
        found = answer(phrase.first, select, viewer) - answer(phrase.second, select, viewer)
    elif isinstance(phrase, Pick):
        found = answer(phrase.target, select, viewer)
        if found:
            pick = min if phrase.which == "smallest" else max
            chosen = pick(found.instances, key=lambda instance: instance.box.volume)
            found = found.within(chosen.mask)
    else:
        targets = answer(phrase.target, select, viewer)
        references = answer(phrase.reference, select, viewer)
        if phrase.relation == "nearest to":
            found = nearest(targets, references)
        else:
            frame = frame_of(viewer(references), references.up.direction)
            found = related(phrase.relation, targets, references, frame)
        present = min(found.present, references.present, key=PRESENCES.index)
    # Nothing that fits is a "no", however sure the parts are.
    return replace(found, phrase=str(phrase), present=(present or found.present) if found else "no")


# One relation each


def _sideways(relation: str, target: Selection, reference: Selection, frame: Frame) -> bool:
    axis = {"left of": -frame.right, "right of": frame.right, "behind": frame.ahead}.get(
        relation, -frame.ahead
    )
    offset = target.center - reference.center
    level = offset - (offset @ frame.up) * frame.up
    along = float(level @ axis)
    reach = float((np.abs(reference.box.axes @ axis) * reference.box.half_sizes).sum())
    return along > 0.5 * reach and along >= _CONE * float(np.linalg.norm(level))


def _rests_on(target: Selection, support: Selection, frame: Frame) -> bool:
    """Whether the support has a surface below the target, about where the target ends.

    The ground below a thing was often never seen, so its surroundings are asked: what of the support lies in the
    target's footprint, widened by half. What stands beside a cloth has the cloth's edge in there as well, so the two
    must lie over each other first.
    """
    if not _overlap(target, support):
        return False
    box, height = target.box, float(2 * target.box.half_sizes[2])
    points = _points(support)
    local = (points - box.center) @ box.axes.T
    below = (np.abs(local[:, :2]) <= 1.5 * box.half_sizes[:2]).all(1) & (local[:, 2] < 0)
    if below.sum() < 5:
        return False
    gap = float(np.median(local[below, 2])) + float(
        box.half_sizes[2]
    )  # 0: the surface is where the thing ends
    spacing = target._spacing()
    higher = float((target.center - support.center) @ frame.up) > 0
    surface = float(np.quantile(local[below, 2], 0.9)) + float(box.half_sizes[2])
    return (higher or abs(surface) <= _SUPPORT * height) and min(abs(gap), abs(surface)) <= max(
        _SUPPORT * height, 2 * spacing
    )


def _stands_over(target: Selection, support: Selection, frame: Frame) -> bool:
    """Whether the target is over the support and ends about where it does: a thing on a table with a cloth."""
    bottom = float(target.center @ frame.up) - float(target.box.half_sizes[2])
    top = float(support.center @ frame.up) + float(support.box.half_sizes[2])
    return _over(target, support, frame) and abs(bottom - top) <= _SUPPORT * float(
        2 * target.box.half_sizes[2]
    )


def _over(upper: Selection, lower: Selection, frame: Frame) -> bool:
    """Whether one is higher than the other, and over it."""
    rise = float((upper.center - lower.center) @ frame.up)
    if rise < 0.8 * float(upper.box.half_sizes[2] + lower.box.half_sizes[2]):
        return False
    return _overlap(upper, lower)


def _overlap(first: Selection, second: Selection) -> bool:
    """Whether two things lie over each other, seen from above."""
    small, large = sorted((first, second), key=lambda s: float(np.prod(s.box.half_sizes[:2])))
    local = (_points(small) - large.center) @ large.box.axes[:2].T
    return bool((np.abs(local) <= large.box.half_sizes[:2]).all(1).mean() >= _OVER)


def _points(selection: Selection) -> NDArray[np.float64]:
    points = selection.gaussians.means[selection.mask].detach().cpu().double().numpy()
    return np.asarray(points[:: max(1, len(points) // _SAMPLE)], dtype=np.float64)


def _same(first: Selection, second: Selection) -> bool:
    """Whether two words mean one thing. A coin that its table's selection takes in is not the table."""
    small, large = sorted((first, second), key=lambda s: s.box.volume)
    shared = int((first.mask & second.mask).sum())
    return shared > 0.5 * min(len(first), len(second)) and small.box.volume > _SAME_SIZE * large.box.volume


def _union(whole: Selection, parts: list[Selection]) -> Selection:
    mask = torch.zeros_like(whole.mask)
    for part in parts:
        mask |= part.mask
    return replace(whole, mask=mask, present=whole.present if parts else "no")
