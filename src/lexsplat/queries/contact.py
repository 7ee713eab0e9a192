"""Support between two selections, decided by their Gaussians near the place where they meet.

Bounding boxes of flat things overlap, and Gaussians stray: everything here is a median or a quantile of the parts
near the meeting place. The side that a thing is on follows from the medians alone, so two things never carry each
other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.boxes import upright_frame
from lexsplat.queries.selection import FAINT, Selection

_SUPPORT = 0.5
"""The gap below a thing is at most this many of its heights. Selections often miss the foot of a thing, which lies in
its own shadow."""
_COLUMN = 2.0
"""A gap up to this many heights counts as well if Gaussians fill it from top to bottom: a stem of no selection."""
_STEPS = 5
"""Number of layers of a gap that must each have Gaussians."""
_FOOT = 0.3
"""Share of a thing's height that is its foot, or its top."""
_AROUND = 2.5
"""Distance from the foot, in radii, up to which points are near it."""
_FEW = 30
"""With fewer points near the foot, the surface is hidden there (by a cloth), and all of it counts."""
_BEYOND = 0.04
"""On each side of the middle of the foot lies at least this share of the surface: the foot is not beside it."""
_TAIL = 0.004
"""The same where the whole surface counts: fewer points than these are strays."""
_DEEP = 0.7
"""Where a surface lies this many heights of a thing below its foot for the most part, its few points at the foot are
of something else, such as a table's edge in the floor. Tables and cloths have up to .42, floors below tables 1.1."""
_BEHIND = 1.0
"""A thing hides the surface behind it: it may stand this many of its radii beyond what is seen of a level one."""
_LEVEL = 0.25
"""A level surface: most of it is at most this high, relative to the median distance from its middle."""
_OVER = 0.3
"""Over: at least this share of the smaller object lies over, or under, the footprint of the other."""
_EDGE = 0.36
"""On the edge of a surface: at least this share of the thing lies over its footprint. A crate with a corner of a
cloth under it has .30 to .32, and things at the edge of what they lie on from .39."""
_SINK = 0.1
"""Over: the two may sink into each other by this share of their heights."""
_SHEET = 0.25
"""An upright sheet, such as a wall: its middle half is at most this thick, relative to its width and height."""
_ATTACHED = 0.15
"""On a wall: the gap is at most this share of the thing's largest extent."""
_POINTS, _ALL_POINTS = 1000, 1 << 14
"""About as many points of a thing are compared, and where few points decide."""
_ANGLES = np.radians(np.arange(0.0, 180.0, 10.0))
_SIDES = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Horizontal directions ``[2, A]``."""


@dataclass(frozen=True, eq=False)
class Body:
    """Points of a thing seen from above ``[M, 2]`` and their heights ``[M]``."""

    plan: NDArray[np.float64]
    heights: NDArray[np.float64]

    def only(self, kept: NDArray[np.bool_]) -> Body:
        """Some of its points."""
        return Body(self.plan[kept], self.heights[kept])

    @cached_property
    def middle(self) -> float:
        """Its median height."""
        return float(np.median(self.heights))

    @cached_property
    def center(self) -> NDArray[np.float64]:
        """Its median place, seen from above ``[2]``."""
        return np.asarray(np.median(self.plan, 0))

    @cached_property
    def radii(self) -> NDArray[np.float64]:
        """The distances of its points from its center, seen from above ``[M]``."""
        return np.asarray(np.linalg.norm(self.plan - self.center, axis=1))

    @cached_property
    def width(self) -> float:
        """Its median radius."""
        return float(np.median(self.radii))

    @cached_property
    def disc(self) -> tuple[NDArray[np.float64], float]:
        """Its center, and the radius around what is near it."""
        return self.center, _AROUND * float(np.quantile(self.radii, 0.8))

    @cached_property
    def normal(self) -> NDArray[np.float64] | None:
        """The horizontal direction through an upright sheet, such as a wall; None for another shape."""
        bottom, top = self.span(0.25)
        if top - bottom < _SHEET * self.width:
            return None
        places = len(self.heights) // 4, 3 * len(self.heights) // 4
        low, high = np.partition((self.plan @ _SIDES).T, places, axis=1)[:, places].T
        thick = high - low
        thinnest = int(thick.argmin())
        across = thick[(thinnest + len(_ANGLES) // 2) % len(_ANGLES)]
        if thick[thinnest] > _SHEET * min(float(across), top - bottom):
            return None
        return np.asarray(_SIDES[:, thinnest])

    def span(self, tail: float = 0.02) -> tuple[float, float]:
        """The heights of its bottom and top without the outermost points."""
        low, high = np.quantile(self.heights, [tail, 1 - tail])
        return float(low), float(high)


def body_of(selection: Selection, up: NDArray[np.float64], points: int = _POINTS) -> Body:
    """Up to about so many points of a selection by their place and height; kept with the selection."""
    kept: dict[tuple[bytes, int], Body] = selection.__dict__.setdefault("_bodies", {})
    key = np.asarray(up, np.float64).tobytes(), points
    if key not in kept:
        sample = selection.sample
        local = sample[:: max(1, len(sample) // points)] @ np.stack(upright_frame(up)).T
        kept[key] = Body(local[:, :2], local[:, 2])
    return kept[key]


def rests_on(target: Selection, support: Selection, up: NDArray[np.float64]) -> bool:
    """Whether a thing stands or lies on another, or is attached to it if that is a wall."""
    upper, lower = body_of(target, up), body_of(support, up)
    normal = lower.normal
    if normal is not None and upper.span()[0] < lower.span(0.1)[1]:
        return _attached(upper, lower, normal) and not _supported(target, support, up)
    if not _is_higher(upper, lower):
        return False
    whole = body_of(support, up, _ALL_POINTS)
    gap, height = _gap(upper, lower, whole, overlap(target, support, _EDGE))
    if gap == np.inf and _stands_behind(upper, whole):
        below = upper.span()[0] - whole.middle
        filled = below > 0 and _filled(target, upper, below, up)
        gap = below if filled or not _supported(target, support, up) else gap
    if gap <= _SUPPORT * height:
        return True
    if gap == np.inf:
        return False
    return gap <= 2 * target._spacing() or (gap <= _COLUMN * height and _filled(target, upper, gap, up))


def is_over(upper: Selection, lower: Selection, up: NDArray[np.float64]) -> bool:
    """Whether one object is higher than the other, and over it."""
    above, below = body_of(upper, up), body_of(lower, up)
    if not _is_higher(above, below):
        return False
    small, large = sorted((above, below), key=lambda each: each.width)
    near = _near(large, *small.disc)
    above, below = (small, near) if small is above else (near, small)
    (bottom, ceiling), (floor, top) = above.span(0.1), below.span(0.1)
    return bottom >= top - _SINK * (ceiling - bottom + top - floor) and overlap(upper, lower)


def overlap(first: Selection, second: Selection, least: float = _OVER) -> bool:
    """Whether a share of the smaller of two objects lies in the footprint of the other, seen from above."""
    small, large = sorted((first, second), key=lambda s: float(np.prod(s.box.half_sizes[:2])))
    local = (small.sample - large.center) @ large.box.axes[:2].T
    return bool((np.abs(local) <= large.box.half_sizes[:2]).all(1).mean() >= least)


# The place where two bodies meet


def _near(body: Body, middle: NDArray[np.float64], radius: float) -> Body:
    near = body.only(np.linalg.norm(body.plan - middle, axis=1) <= radius)
    return near if len(near.heights) >= _FEW else body


def _is_higher(upper: Body, lower: Body) -> bool:
    """Whether the narrower body is above, or below, the parts of the wider one that are near it."""
    if upper.width <= lower.width:
        return upper.middle > _near(lower, *upper.disc).middle
    return _near(upper, *lower.disc).middle > lower.middle


def _gap(upper: Body, lower: Body, whole: Body, overlapping: bool) -> tuple[float, float]:
    """The gap between a body and one below it, of which ``whole`` has more points, and the upper one's height there.

    The gap is infinite where the narrower one is beside the wider one. A cloth, a shadow or the thing itself may hide
    the surface near the foot. Then all of a level surface counts: a table does, a wall or a chair does not.
    """
    if upper.width <= lower.width:
        (bottom, top), middle = upper.span(), upper.middle
        foot = upper.only(upper.heights <= bottom + _FOOT * (top - bottom))
        near = _near(lower.only(lower.heights <= middle), *foot.disc)
        level = _is_level(lower) and float(np.quantile(lower.heights, 0.9)) <= middle
        if not _surrounds(near, foot) and not (level and (overlapping or _surrounds(whole, foot, _TAIL))):
            return np.inf, top - bottom
        surfaces = np.quantile(near.heights, [0.5, 0.9, 0.98])
        if lower.normal is None and bottom - surfaces[0] > _DEEP * (top - bottom):
            surfaces = surfaces[:1]
    else:
        bottom, top = lower.span()
        head = lower.only(lower.heights >= top - _FOOT * (top - bottom))
        near = _near(upper, *head.disc)
        if float(np.quantile(near.heights, 0.25)) < lower.middle or not _surrounds(near, head):
            return np.inf, 0.0
        surfaces = np.array([lower.middle, top])
        bottom, top = near.span()
    gaps = bottom - surfaces
    return float(gaps[np.abs(gaps).argmin()]), top - bottom


def _stands_behind(upper: Body, surface: Body) -> bool:
    """Whether a thing is just beyond what is seen of a level surface, such as at the far edge of a table."""
    bottom, top = upper.span()
    if not _is_level(surface) or bottom < surface.span(0.1)[0] - _SINK * (top - bottom):
        return False
    away = surface.center - upper.center
    moved = upper.plan + away / max(float(np.linalg.norm(away)), 1e-9) * _BEHIND * upper.width
    return _surrounds(surface, Body(moved, upper.heights), _TAIL)


def _is_level(body: Body) -> bool:
    low, high = body.span(0.1)
    return high - low <= _LEVEL * body.width


def _surrounds(surface: Body, part: Body, beyond: float = _BEYOND) -> bool:
    """Whether the middle of a part lies within a surface, seen from above."""
    if len(surface.heights) < 5 or len(part.heights) == 0:
        return False
    sides = (surface.plan - part.center) @ _SIDES > 0
    share = sides.mean(0)
    return bool(np.minimum(share, 1 - share).min() >= beyond)


def _filled(target: Selection, upper: Body, gap: float, up: NDArray[np.float64]) -> bool:
    """Whether Gaussians fill the gap below a thing: its stem, which no selection has."""
    bottom = upper.span()[0]
    foot = upper.only(upper.heights <= bottom + _FOOT * (upper.span()[1] - bottom))
    heights = _column(target, foot, bottom - gap, bottom, up)
    layers = np.floor((heights - bottom + gap) / gap * _STEPS).astype(int)
    return len(np.unique(layers.clip(0, _STEPS - 1))) == _STEPS


def _column(
    target: Selection, foot: Body, low: float, high: float, up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The heights of the Gaussians between two heights below the middle of a foot."""
    gaussians, axes = target.gaussians, np.stack(upright_frame(up))
    means = gaussians.means.detach().cpu().numpy()
    heights = means @ axes[2]
    inside = np.flatnonzero((heights >= low) & (heights <= high))
    inside = inside[np.linalg.norm(means[inside] @ axes[:2].T - foot.center, axis=1) <= foot.width]
    opaque = gaussians.opacity_logits.detach()[inside].sigmoid().cpu().numpy() >= FAINT
    return np.asarray(heights[inside[opaque]], float)


# Walls


def _attached(upper: Body, wall: Body, normal: NDArray[np.float64]) -> bool:
    """Whether a thing touches a wall, within the area of the wall."""
    along = np.array([-normal[1], normal[0]])
    sideways, depth = upper.plan @ along, upper.plan @ normal
    left, right = np.quantile(wall.plan @ along, [0.02, 0.98])
    low, high = wall.span()
    if not (left <= np.median(sideways) <= right and low <= upper.middle <= high):
        return False
    near, far = np.quantile(depth, [0.05, 0.95])
    ends = np.quantile(sideways, [0.05, 0.95])
    size = max(far - near, ends[1] - ends[0], upper.span()[1] - upper.span()[0])
    if size >= max(right - left, high - low):
        return False
    surface = np.quantile(wall.plan @ normal, [0.25, 0.5, 0.75])
    gap = max(near - surface[1], surface[1] - far, 0.0)
    return bool(gap <= max(_ATTACHED * size, surface[2] - surface[0]))


def _supported(target: Selection, wall: Selection, up: NDArray[np.float64]) -> bool:
    """Whether a thing at a wall, or behind a surface, stands on something else."""
    body = body_of(target, up)
    bottom, top = body.span()
    others = target.gaussians.means.detach().cpu().numpy()[~(target.mask | wall.mask).cpu().numpy()]
    local = others @ np.stack(upright_frame(up)).T
    local = local[np.abs(local[:, 2] - bottom + _ATTACHED * (top - bottom) / 2) <= _ATTACHED * (top - bottom)]
    low, high = np.quantile(body.plan, [0.05, 0.95], axis=0)
    below = Body(local[:, :2], local[:, 2]).only(((local[:, :2] >= low) & (local[:, :2] <= high)).all(1))
    return len(below.heights) >= 5
