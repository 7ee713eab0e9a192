"""Relations between selections: left of, on, inside, between, nearest, larger than and the like.

"Left", "right", "in front of" and "behind" refer to a viewer whose axes are made horizontal by gravity. "On", "above"
and "under" depend on gravity alone. Relations hold between instances, by their upright boxes and their points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.boxes import upright_frame
from lexsplat.geometry.cameras import Camera
from lexsplat.queries.contact import is_over, rests_on
from lexsplat.queries.phrases import ORDERED, CornerName, PartName, RelationName
from lexsplat.queries.selection import Selection, union

_Ranked = TypeVar("_Ranked")

CONE = 0.5
"""Sideways: at least this share of the horizontal offset lies along the axis (within 60 degrees)."""
REACH = 0.5
"""Sideways: the centers are farther apart along the axis than this many times the half size of the other."""
_NEAR = 0.5
"""Next to: the gap is at most this many diagonals of the smaller footprint (height does not count)."""
_CORNER = 0.5
"""In a corner: at least this far out along both sides, from 0 (the middle) to 1."""
_MIDDLE = 0.5
"""In the middle: at most this far out along both sides; at the back, front, left or right: at least this far out."""
_EDGE = 0.75
"""At the edge: at least this far out along one side."""
_BESIDE = 0.1
"""Left or right of the viewer: at least this share of the offset lies sideways (6 degrees)."""
_INSIDE = 0.6
"""Inside: at least this share of the object lies in the box of the other."""
_SAME_SIZE = 0.1
"""Two phrases name one object only if the smaller box has at least this share of the larger one's volume."""


@dataclass(frozen=True)
class Frame:
    """The axes of a viewer that direction words refer to, unit vectors ``[3]``.

    Args:
        right: To the viewer's right, horizontal.
        ahead: Away from the viewer, horizontal.
        up: Away from the ground.
    """

    right: NDArray[np.float64]
    ahead: NDArray[np.float64]
    up: NDArray[np.float64]


def frame_of(camera: Camera | None, up: NDArray[np.float64]) -> Frame:
    """The frame of a viewer at a camera; arbitrary horizontal directions without one."""
    upwards = np.asarray(up, float) / np.linalg.norm(up)
    if camera is None:
        return Frame(*upright_frame(upwards))
    (right,), (ahead,) = level_axes([camera], upwards)
    return Frame(right, ahead, upwards)


def level_axes(
    cameras: Sequence[Camera], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The horizontal directions right and ahead of viewers at cameras ``[V, 3]`` each, for a unit vector ``up [3]``.

    A camera that looks straight down has no horizontal view direction: "ahead" is then the top of its image.
    """
    turns = np.array([camera.viewmat[:3, :3] for camera in cameras]).reshape(-1, 3, 3)
    forwards, tops = turns[:, 2] / np.linalg.norm(turns[:, 2], axis=1, keepdims=True), -turns[:, 1]
    level, level_tops = (each - np.outer(each @ up, up) for each in (forwards, tops))
    steep = np.linalg.norm(level, axis=1, keepdims=True) < 0.2
    ahead = np.where(steep, level_tops, level)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.cross(ahead, up), ahead


def holds(relation: RelationName, target: Selection, reference: Selection, frame: Frame) -> bool:
    """Whether one instance stands in a relation to another.

    "nearest to" and "farthest from" compare several instances: see `nearest`.

    Raises:
        ValueError: If the relation is unknown or compares several instances.
    """
    if not target or not reference:
        return False
    if relation in _LARGER:
        measure = _LARGER.index(relation)
        return _sizes(target)[measure] > _sizes(reference)[measure]
    if relation in ("smaller than", "shorter than"):
        return holds("larger than" if relation == "smaller than" else "taller than", reference, target, frame)
    if relation in ("left of", "right of", "in front of", "behind"):
        return _sideways(relation, target, reference, frame)
    if relation == "on":
        return rests_on(target, reference, frame.up)
    if relation == "under":
        carries = rests_on(reference, target, frame.up) or is_over(reference, target, frame.up)
        return carries and not rests_on(target, reference, frame.up)
    if relation in ("above", "below"):
        upper, lower = (target, reference) if relation == "above" else (reference, target)
        return is_over(upper, lower, frame.up)
    if relation == "inside":
        share = float(reference.box.contains(target.sample).mean())
        return bool(share >= _INSIDE and target.box.volume < reference.box.volume)
    if relation == "next to":
        smaller = min(np.linalg.norm(target.size[:2]), np.linalg.norm(reference.size[:2]))
        near = bool(distance(target, reference) <= _NEAR * smaller)
        return near and not any(
            is_over(*pair, frame.up) for pair in ((target, reference), (reference, target))
        )
    raise ValueError(f"not a relation between two instances: {relation!r}")


def related(
    relation: RelationName,
    targets: Selection,
    references: Selection,
    viewer: Frame | Callable[[Selection, Selection], Frame],
) -> Selection:
    """The instances of ``targets`` that stand in a relation to an instance of ``references``.

    A thing below the support of the reference is not "under" it: the table is under a mug, the floor is not. Nothing
    is related to a part of itself: the mug is not left of its handle.

    Args:
        relation: One that `holds` knows.
        targets: Instances to choose from.
        references: Instances that they are related to.
        viewer: Whose left it is, or whose for each pair (`lexsplat.queries.viewers`).
    """
    pairs = [
        (target, reference)
        for reference in references.instances
        for target in targets.instances
        if not same(target, reference)
    ]
    held, frame = [], None
    for target, reference in pairs:
        one, other = _disjoint(target, reference)
        frame = viewer(one, other) if callable(viewer) else viewer
        if holds(relation, one, other, frame) and not _has(target, reference):
            held.append((target, reference))
    if relation == "under" and frame is not None and len(held) > 1:
        held = _not_below_supports(held, frame)
    kept = {id(target) for target, _ in held}
    return _union(targets, [target for target in targets.instances if id(target) in kept])


def _has(target: Selection, reference: Selection) -> bool:
    """Whether most of the reference is a part of the target."""
    return 2 * int(target.mask[reference.indices].sum()) > len(reference)


def _not_below_supports(
    pairs: Sequence[tuple[Selection, Selection]], frame: Frame
) -> list[tuple[Selection, Selection]]:
    """Pairs of a thing and what is above it, without the things below one that carries the same."""
    carriers = [pair for pair in pairs if rests_on(*_disjoint(*pair)[::-1], frame.up)]
    return [
        (target, reference)
        for target, reference in pairs
        if (target, reference) in carriers
        or not any(
            other is reference and holds("under", *_disjoint(target, carrier), frame)
            for carrier, other in carriers
        )
    ]


def nearest(
    targets: Selection, references: Selection, *, farthest: bool = False, count: int = 1, rank: int = 1
) -> Selection:
    """The instance of ``targets`` with the smallest gap to any instance of ``references``, or with the largest.

    Args:
        targets: Instances to choose from.
        references: Instances to measure the gap to.
        farthest: Whether the largest gap counts.
        count: Number of instances to choose; none if there are fewer.
        rank: The number of the first one, from 1.
    """
    gaps = [
        min(distance(target, reference) for reference in references.instances)
        if references and not any(same(target, reference) for reference in references.instances)
        else None
        for target in targets.instances
    ]
    order = sorted(
        (number for number, gap in enumerate(gaps) if gap is not None),
        key=lambda number: gaps[number] or 0.0,
        reverse=farthest,
    )
    return _union(targets, [targets.instances[number] for number in in_order(order, count, rank)])


def in_order(ranked: Sequence[_Ranked], count: int, rank: int) -> Sequence[_Ranked]:
    """``count`` of some in an order, from the one with the number ``rank`` on; none if there are fewer."""
    end = rank - 1 + count
    return ranked[rank - 1 : end] if len(ranked) >= end else []


def between(targets: Selection, first: Selection, second: Selection) -> Selection:
    """The instances of ``targets`` between two others: from there, the two lie at least 120 degrees apart."""

    def is_between(target: Selection, one: Selection, other: Selection) -> bool:
        if same(target, one) or same(target, other) or same(one, other):
            return False
        to_one, to_other = one.center - target.center, other.center - target.center
        lengths = np.linalg.norm(to_one) * np.linalg.norm(to_other)
        return bool(lengths > 0 and to_one @ to_other <= -CONE * lengths)

    pairs = [(one, other) for one in first.instances for other in second.instances]
    return _union(
        targets, [each for each in targets.instances if any(is_between(each, *pair) for pair in pairs)]
    )


def beside_viewer(
    relation: RelationName,
    targets: Selection,
    camera: Camera,
    frame: Frame,
    *,
    count: int = 1,
    rank: int = 1,
) -> Selection:
    """The instances of ``targets`` in front of, left of or near whoever stands at a camera; see `nearest`.

    Raises:
        ValueError: If the relation is none to a viewer, such as "on".
    """
    offsets = [_level(each.center - camera.position, frame) for each in targets.instances]
    if relation in (*ORDERED, "next to"):
        order = sorted(range(len(offsets)), key=lambda number: float(np.linalg.norm(offsets[number])))
        found = list(in_order(order[::-1] if relation == "farthest from" else order, count, rank))
    else:
        axis, share = {
            "left of": (-frame.right, _BESIDE), "right of": (frame.right, _BESIDE),
            "in front of": (frame.ahead, CONE), "behind": (-frame.ahead, CONE),
        }.get(relation, (None, 0.0))  # fmt: skip
        if axis is None:
            raise ValueError(f"not a relation to a viewer: {relation!r}")
        found = [n for n, offset in enumerate(offsets) if offset @ axis >= share * np.linalg.norm(offset)]
    return _union(targets, [targets.instances[number] for number in found])


def in_corner(targets: Selection, everything: Selection, corner: CornerName, frame: Frame) -> Selection:
    """The instances of ``targets`` in the corners of the area that ``everything`` takes.

    The area is a rectangle along the viewer's axes. An instance is in a corner if it lies in the outer quarter of
    both sides. Of several in one corner, the one farthest out is taken.
    """
    axes = np.stack([frame.right, frame.ahead])
    places = np.array([axes @ each.center for each in everything.instances or targets.instances])
    if len(places) == 0:
        return targets
    low, high = places.min(0), places.max(0)
    best: dict[tuple[bool, bool], tuple[float, Selection]] = {}
    for each in targets.instances:
        right, ahead = 2 * (axes @ each.center - low) / np.maximum(high - low, 1e-9) - 1
        sides = ("left" if right < 0 else "right", "front" if ahead < 0 else "back")
        out = min(abs(right), abs(ahead))
        key = (right < 0, ahead < 0)
        if out >= _CORNER and set(corner.split()) <= set(sides) and (key not in best or out > best[key][0]):
            best[key] = (out, each)
    return _union(targets, [each for _, each in best.values()])


def in_part(targets: Selection, area: Selection, part: PartName, frame: Frame) -> Selection:
    """The instances of ``targets`` that are in a part of an area, seen from above.

    The parts are those of the rectangle around the boxes of ``area`` along the viewer's axes. "Back" and "front" are
    as the viewer sees them.
    """
    axes = np.stack([frame.right, frame.ahead])
    places = np.array([axes @ each.center for each in area.instances]).reshape(-1, 2)
    if len(places) == 0:
        return _union(targets, [])
    reach = np.array([np.abs(axes @ each.box.axes.T) @ each.box.half_sizes for each in area.instances])
    low, high = (places - reach).min(0), (places + reach).max(0)
    kept = []
    for each in targets.instances:
        right, ahead = 2 * (axes @ each.center - low) / np.maximum(high - low, 1e-9) - 1
        out = max(abs(right), abs(ahead))
        held = {
            "middle": out <= _MIDDLE, "back": ahead >= _MIDDLE, "front": ahead <= -_MIDDLE,
            "left": right <= -_MIDDLE, "right": right >= _MIDDLE, "edge": out >= _EDGE,
        }  # fmt: skip
        if held[part]:
            kept.append(each)
    return _union(targets, kept)


def distance(first: Selection, second: Selection) -> float:
    """The gap between two selections: the smallest distance between their points, world units.

    Raises:
        ValueError: If one is empty.
    """
    if not first or not second:
        raise ValueError("an empty selection has no place")
    pairs = (first, second), (second, first)
    # One stray Gaussian does not close a gap, whichever of the two has it.
    return max(float(np.quantile(one.tree.query(other.sample)[0], 0.002)) for one, other in pairs)


# One relation each


_LARGER = ("larger than", "taller than", "longer than", "wider than")
"""Relations by the `_sizes` that they compare."""


def _sizes(each: Selection) -> tuple[float, float, float, float]:
    """The volume of an object and half its height, its longest side and its longer horizontal side."""
    along, across, height = (float(half) for half in each.box.half_sizes)
    return each.box.volume, height, max(along, across, height), max(along, across)


def _sideways(relation: str, target: Selection, reference: Selection, frame: Frame) -> bool:
    axis = {"left of": -frame.right, "right of": frame.right, "behind": frame.ahead}.get(
        relation, -frame.ahead
    )
    offset = target.center - reference.center
    level = _level(offset, frame)
    along = float(level @ axis)
    reach = float((np.abs(reference.box.axes @ axis) * reference.box.half_sizes).sum())
    return along > REACH * reach and along >= CONE * float(np.linalg.norm(level))


def _level(offset: NDArray[np.float64], frame: Frame) -> NDArray[np.float64]:
    return np.asarray(offset - (offset @ frame.up) * frame.up)


def _disjoint(first: Selection, second: Selection) -> tuple[Selection, Selection]:
    """Two selections without the Gaussians of the smaller in the larger: shared Gaussians support nothing."""
    if not bool(first.mask[second.indices].any()):
        return first, second
    return (first, second - first) if len(first) <= len(second) else (first - second, second)


def same(first: Selection, second: Selection) -> bool:
    """Whether two phrases name one object. A coin within the selection of its table is not the table."""
    fewer, more = sorted((first, second), key=len)
    if not int(more.mask[fewer.indices].sum()) > 0.5 * len(fewer):
        return False
    small, large = sorted((first, second), key=lambda s: s.box.volume)
    return small.box.volume > _SAME_SIZE * large.box.volume


def _union(whole: Selection, parts: list[Selection]) -> Selection:
    mask = union(whole.mask, parts)
    return replace(whole, mask=mask, parts=tuple(parts), present=whole.present if parts else "no")
