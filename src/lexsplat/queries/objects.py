"""The objects of a scene: the segments that one name describes as a whole.

Each segment of the hierarchy (`lexsplat.language.segments`) has a best name in a vocabulary. From the coarsest level
down, a segment is an object if its best name describes it well, and nearly all of its parts too; else its parts are
tried. Segments of one name that touch are one object: a stack of books has parts of many colors.

Dimension letters: W words of the vocabulary, V segments of all levels, S lowest segments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lexsplat.language.segment_codes import SegmentCodes

FITS = 0.6
"""Smallest strength of the name of an object, and of what a scene holds (`lexsplat.queries.presence`)."""
_PART = 0.5
"""Smallest strength of that name at its parts."""
_CLEARLY = 0.25
"""A name describes a piece in a surface, or a surface under a thing, clearly better if it is stronger by this."""
_WHOLE = 0.75
"""A name describes a segment as a whole if it describes this share of what the views show of it."""
_SLOPE = 12.0
"""Slope of the log-odds of a name over its strength."""
_NEARLY = 0.5
"""A name is nearly the likeliest if it has this share of that one's probability."""
_WORDS = 256

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Strengths = Callable[[slice], FloatArray]
"""How well some words of the vocabulary describe each segment ``[V, w]`` (`lexsplat.queries.presence`)."""


class WholeSegments(NamedTuple):
    """The segments that are objects, or parts of one object that has several.

    Args:
        places: The one that holds each lowest segment ``[S]``, in 0..V-1; -1 where no word describes any.
        words: The word that describes each segment best ``[V]``.
        strengths: How well it does ``[V]``.
    """

    places: IntArray
    words: IntArray
    strengths: FloatArray


def whole_segments(
    codes: SegmentCodes, strengths: Strengths, materials: Sequence[bool] | NDArray[np.bool_]
) -> WholeSegments:
    """The segments that one word describes as a whole, from the coarsest level down.

    Args:
        codes: The segments of all levels.
        strengths: Function from a slice of the words to their strengths at each segment.
        materials: Which of the words name materials, patterns or parts ``[W]``: a ring of metal is a ring if that
            word fits, too.
    """
    shape, is_material = (2, len(codes.masses)), np.asarray(materials, bool)
    ranked, heights = np.zeros(shape, np.int64), np.full(shape, -np.inf)
    for start in range(0, len(is_material), _WORDS):
        part = slice(start, min(start + _WORDS, len(is_material)))
        strong = strengths(part)
        for kind in (0, 1):
            found = np.where(is_material[part] == kind, strong, -np.inf)
            better = found.max(1) > heights[kind]
            ranked[kind, better], heights[kind, better] = (
                start + found.argmax(1)[better],
                found.max(1)[better],
            )
    of_material = (heights[1] > heights[0]) & (heights[0] < FITS)
    best, most = (
        np.where(of_material, ranked[::-1], ranked)[0],
        np.where(of_material, heights[::-1], heights)[0],
    )
    places, lowest = np.full(codes.numbers.shape[1], -1), codes.numbers[0]
    fitting = {int(word): strengths(slice(int(word), int(word) + 1))[:, 0] for word in np.unique(best)}
    for level in codes.numbers[::-1]:
        at_parts = np.array([fitting[word][part] for word, part in zip(best[level].tolist(), lowest)])
        described = np.bincount(level, codes.masses[lowest] * (at_parts >= _PART), len(codes.masses))
        whole = (most[level] >= FITS) & (described[level] >= _WHOLE * codes.masses[level])
        places = np.where((places < 0) & whole, level, places)
    return WholeSegments(places, best, most)


def with_surfaces(
    whole: WholeSegments, masses: FloatArray, surfaces: IntArray, strengths: FloatArray
) -> WholeSegments:
    """The same segments, where surfaces have their names, and near-synonyms are one name.

    A floor that few views show resembles many words. So a segment has the name of a surface if that is nearly the
    likeliest, and describes it nearly as well as anything: "table" is a name for the table, not for the ring on it.
    Two names of surfaces are one, that of most of what the views show, if each is nearly the likeliest at three
    quarters of what has the other: a table in four pieces is no "table" and three "desks".

    Args:
        whole: The objects.
        masses: Visible weights of all segments ``[V]``.
        surfaces: The words that name surfaces ``[F]``.
        strengths: How well they describe each segment ``[V, F]``.
    """
    held = np.unique(whole.places[whole.places >= 0])
    if not len(held):
        return whole
    here, shown, words = strengths[held], masses[held], whole.words.copy()
    less = -np.log(_NEARLY) / _SLOPE
    nearly = here >= whole.strengths[held, None] - less
    fits = nearly & (here >= here.max(0) - less)
    named = fits.any(1) & ~np.isin(words[held], surfaces)
    words[held[named]] = surfaces[np.where(fits, here, -np.inf).argmax(1)[named]]
    own = words[held][:, None] == surfaces
    sums = shown @ own
    alike = (own * shown[:, None]).T @ nearly >= _WHOLE * sums[:, None]
    alike &= alike.T & (sums > 0) & (sums[:, None] > 0)
    for place in np.argsort(sums, kind="stable"):
        largest = max(np.flatnonzero(alike[place]), key=lambda other: sums[other], default=place)
        words[words == surfaces[place]] = surfaces[largest]
    return whole._replace(words=words)


def pieces_of_others(
    whole: WholeSegments,
    lowest: IntArray,
    known: IntArray,
    strengths: FloatArray,
    surfaces: NDArray[np.bool_],
) -> IntArray:
    """The thing of which a lowest segment in a surface may be a piece, such as a lamp's stand in the table behind it.

    Args:
        whole: The objects.
        lowest: Number in 0..V-1 of each lowest segment ``[S]``.
        known: Words of the objects ``[K]``, each once, sorted.
        strengths: How well they describe each segment ``[V, K]``.
        surfaces: Which of them are surfaces ``[K]``.

    Returns:
        The word that describes it best ``[S]``, where its object's word does not, or clearly worse; -1 elsewhere.
    """
    if surfaces.all():
        return np.full_like(lowest, -1)
    own = np.searchsorted(known, whole.words[np.maximum(whole.places, 0)]).clip(max=len(known) - 1)
    here, things = strengths[lowest], np.flatnonzero(~surfaces)
    best, most, least = here[:, things].argmax(1), here[:, things].max(1), here[np.arange(len(own)), own]
    better = (most >= FITS) & ((least < _PART) | (most - least >= _CLEARLY))
    moved = (whole.places >= 0) & surfaces[own] & better
    return np.where(moved, known[things][best], -1)


def likeliest_things(
    lowest: IntArray, known: IntArray, strengths: FloatArray, surfaces: NDArray[np.bool_]
) -> IntArray:
    """The thing that describes each lowest segment at least as well as parts ask for, whatever else describes it.

    Args:
        lowest: Number in 0..V-1 of each lowest segment ``[S]``.
        known: Words of the objects ``[K]``.
        strengths: How well they describe each segment ``[V, K]``.
        surfaces: Which of them are surfaces ``[K]``.

    Returns:
        A word that names no surface ``[S]``; -1 for none.
    """
    if surfaces.all():
        return np.full_like(lowest, -1)
    here = strengths[np.ix_(lowest, np.flatnonzero(~surfaces))]
    return np.where(here.max(1) >= _PART, known[~surfaces][here.argmax(1)], -1)


def surface_fits_better(
    lowest: IntArray, strengths: FloatArray, surfaces: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Whether the name of a surface describes lowest segments clearly better than the name of each object.

    Args:
        lowest: Number in 0..V-1 of each lowest segment ``[S]``.
        strengths: How well the words of the objects describe each segment ``[V, K]``.
        surfaces: Which of them are surfaces that may be meant ``[K]``.

    Returns:
        ``[S, K]``.
    """
    here = strengths[lowest]
    return here[:, surfaces].max(1, keepdims=True, initial=-np.inf) - here >= _CLEARLY


def name_probabilities(strengths: FloatArray) -> FloatArray:
    """Probabilities of words ``[W]`` from their strengths; the rest up to 1 is the probability of no word."""
    odds = np.exp(_SLOPE * (strengths - FITS))
    return np.asarray(odds / (1 + odds.sum()))
