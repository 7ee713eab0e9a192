"""What a surface from above consists of: cloth here, table there.

A cloth on a table ends somewhere under a thing, where no photo shows it. Its edges are straight for the most part, so
that those that the photos show tell the rest. The material of a pixel is the listed surface whose Gaussians are drawn
there. A material is continued as the largest convex shape whose edges are seen: each line along which it ends in the
image bounds it (`outline`). So the corner of a cloth is where two of its edges meet.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter
from scipy.stats import theilslopes

from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import is_divided

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
Mask = NDArray[np.bool_]

UNLISTED, THING = -1, -2
"""Kinds of what is no listed surface; surfaces are numbered from 0."""
_MOSTLY = 0.5
"""Share of a segment that is of one kind."""
_SMOOTH = 2.0
"""Pixels around one that tell its material: a photo from above has specks."""
_BLURRED = 2
"""Pixels around things in which their colors and those of the surface are mixed."""
_LEAST = 0.08
"""Share of the known pixels, below which a surface counts as none."""
_ANGLES, _APART = 40, 30.0
"""Directions in which edges are searched, and the least angle between two edges, degrees."""
_OUTSIDE = 0.02
"""Share of a material that may lie beyond one of its edges."""
_STRIP, _GAP = 6, 12
"""Pixels before and behind an edge in which its material, and another one, are searched."""
_LENGTH = 12
"""Shortest edge, in pixels that have the material on one side, and another one on the other."""
_STRAIGHT = 1.5
"""Distance from a line in pixels up to which an edge follows it."""
_SAMPLE, _ROUNDS = 32, 2
"""Pixels of an edge that determine its line, and how often it is searched along its line."""


def kinds_of_segments(objects: Iterable[Selection], segments: Segments) -> IntArray:
    """What the segments of the lowest level are ``[S]``: the number of a surface, `THING`, or `UNLISTED`.

    Args:
        objects: The listed objects of the scene.
        segments: Its segments.
    """
    labels, count = segments.labels.cpu().numpy(), segments.levels.shape[1]
    sizes = np.maximum(np.bincount(labels, minlength=count), 1)
    kinds, surfaces = np.full(count, UNLISTED), 0
    for each in objects:
        mostly = np.bincount(labels, each.mask.cpu().numpy(), count) > _MOSTLY * sizes
        kinds[mostly] = surfaces if is_divided(each.phrase) else THING
        surfaces += is_divided(each.phrase)
    return kinds


def materials(covered: FloatArray, known: Mask) -> tuple[IntArray, Mask]:
    """The material of each pixel ``[P, P]``, and the pixels in and around things ``[P, P]``.

    Args:
        covered: How much of each pixel the Gaussians of each surface cover, and those of things ``[P, P, G + 1]``.
        known: The pixels that count ``[P, P]``.
    """
    soft = np.stack([gaussian_filter(layer * known, _SMOOTH) for layer in np.moveaxis(covered, -1, 0)], -1)
    found = np.where(known & (soft.max(-1) > 0), soft.argmax(-1), -1)
    things = binary_dilation(found == covered.shape[-1] - 1, iterations=_BLURRED)
    found[things] = -1
    counts = np.bincount(found[found >= 0], minlength=covered.shape[-1])
    found[np.isin(found, np.flatnonzero(counts < _LEAST * known.sum()))] = -1
    return continued(found), things


def are_listed(labels: IntArray, covered: FloatArray, known: Mask) -> Mask:
    """The pixels ``[P, P]`` of materials that are listed surfaces for the most part.

    Args:
        labels: The material of each pixel ``[P, P]``.
        covered: How much of each pixel the Gaussians of each surface cover, and those of things ``[P, P, G + 1]``.
        known: The pixels that count ``[P, P]``.
    """
    found = np.zeros(labels.shape, bool)
    for label in np.unique(labels):
        part = known & (labels == label)
        found[labels == label] = (
            part.any() and label < covered.shape[-1] - 1 and covered[part][:, label].mean() > 0.5
        )
    return found


def continued(found: IntArray) -> IntArray:
    """Materials ``[P, P]`` where they are not known, too.

    The smallest shape that a pixel lies in is its material; outside of all it is the nearest one. So it is among
    several materials of which no edge is seen.

    Args:
        found: The materials, numbered from 0; -1 where they are not known ``[P, P]``.
    """
    known = found >= 0
    names = np.unique(found[known])
    if len(names) < 2:
        return np.full_like(found, names[0] if len(names) else 0)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = found[tuple(nearest)]
    shapes = [(outline(found == name, known & (found != name)), name) for name in names]
    endless = sum(bool(shape.all()) for shape, _ in shapes)
    for shape, name in sorted(shapes, key=lambda each: -each[0].sum()):
        if endless < 2 or not shape.all():
            filled[~known & shape] = name
    return filled


def outline(inside: Mask, outside: Mask) -> Mask:
    """The largest convex shape of a material whose edges are seen ``[P, P]``; everything if none is seen.

    Args:
        inside: Pixels of the material ``[P, P]``.
        outside: Pixels of other materials ``[P, P]``.
    """
    places = np.argwhere(np.ones_like(inside)).astype(float)
    own, other = places[inside.ravel()], places[outside.ravel()]
    angles = np.arange(_ANGLES) * 2 * np.pi / _ANGLES
    edges = [_straight_edge(own, other, np.array([np.cos(angle), np.sin(angle)])) for angle in angles]
    found = np.ones(len(places), bool)
    for normal, end, length in edges:
        rivals = [each for way, _, each in edges if way @ normal >= np.cos(np.radians(_APART))]
        if length >= max(_LENGTH, *rivals):
            found &= places @ normal <= end
    return found.reshape(inside.shape)


def _straight_edge(own: FloatArray, other: FloatArray, way: FloatArray) -> tuple[FloatArray, float, int]:
    """The line along which a material ends: its normal ``[2]``, its distance, and on how many pixels it is seen.

    Args:
        own: Pixels of the material ``[M, 2]``.
        other: Pixels of others ``[R, 2]``.
        way: About the direction of the normal, a unit vector ``[2]``.
    """
    end, length = np.inf, 0
    for _ in range(_ROUNDS):
        along, middles = _edge(own, other, way)
        if len(along) < _LENGTH:
            return way, end, 0
        step = -(-len(along) // _SAMPLE)
        slope, start, *_ = theilslopes(middles[::step], along[::step])
        length = int((np.abs(middles - start - slope * along) <= _STRAIGHT).sum())
        across, norm = np.array([-way[1], way[0]]), np.hypot(1, slope)
        way, end = (way - slope * across) / norm, start / norm
    return way, end, length


def _edge(own: FloatArray, other: FloatArray, way: FloatArray) -> tuple[IntArray, FloatArray]:
    """Where a material ends in a direction: places along the edge ``[E]``, and how far out it is there ``[E]``.

    Args:
        own: Pixels of the material ``[M, 2]``.
        other: Pixels of others ``[R, 2]``.
        way: The direction, a unit vector ``[2]``.
    """
    across = np.array([-way[1], way[0]])
    far, beyond = own @ way, other @ way
    end = float(np.quantile(far, 1 - _OUTSIDE))
    last = np.abs(far - end) <= _STRIP
    first = (beyond > end - _STRIP) & (beyond <= end + _GAP)
    here, there = (np.rint(each @ across).astype(int) for each in (own[last], other[first]))
    both = np.intersect1d(here, there)
    highest, lowest = np.full(len(both), -np.inf), np.full(len(both), np.inf)
    for values, at, ends, better in (
        (far[last], here, highest, np.maximum),
        (beyond[first], there, lowest, np.minimum),
    ):
        counted = np.isin(at, both)
        better.at(ends, np.searchsorted(both, at[counted]), values[counted])
    return both, (highest + lowest) / 2
