"""An upper bound of presence from the codes of a scene alone: which scenes may hold a phrase.

`lexsplat.queries.presence` decides at the best place of a phrase, a distribution p over the codes that Gaussians
carry. With the height h_k of the text at code k, the best height b_k of an everyday word there and the peak of the
scene, its strength is at most

    sqrt(max(0, p.h / p.b) max(0, p.h / peak)) <= max over k of h_k / sqrt(b_k peak)

because p.h <= M sqrt(peak) p.sqrt(b) <= M sqrt(peak) sqrt(p.b) for the maximum M (Jensen). A scene whose bound is
below `NO_SEGMENT` does not hold the phrase, wherever its best place is: it need not be opened. Scenes are opened in
the order of their bounds. Dimension letters: S scenes, K codes, D dimensions, P texts.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.queries.everyday import OFFSET
from lexsplat.queries.meaning import compounds, known_words
from lexsplat.queries.phrases import Anything, AtLeast, Both, Except, Phrase, Thing, Viewer, parts_of
from lexsplat.queries.presence import NO_PART, NO_SEGMENT
from lexsplat.queries.vocabulary import thing_of_part
from lexsplat.runtime.device import one_thread
from lexsplat.scenes.library.entries import Codes

SURELY_NOT = NO_SEGMENT - 0.01
"""Scenes with a smaller bound do not hold the phrase. Codes are kept in float16, which moves a bound by less than
the difference to `NO_SEGMENT`."""
CERTAIN = 2.0
"""The bound of a phrase without words to compare, such as "everything"."""

FloatArray = NDArray[np.float64]


def presence_bounds(codes: Sequence[Codes], texts: Tensor) -> FloatArray:
    """Upper bounds of the strength of presence.

    Args:
        codes: The codes of scenes with the same encoder, S of them.
        texts: Embeddings ``[P, D]``, of any length.

    Returns:
        ``[S, P]``, at least 0. One thread adds in a fixed order: equal arguments give equal bits.
    """
    found = np.zeros((len(codes), len(texts)))
    unit = torch.nn.functional.normalize(texts.cpu().float(), dim=-1).T
    sizes: dict[int, list[int]] = {}
    for place, each in enumerate(codes):
        sizes.setdefault(len(each.units), []).append(place)
    with one_thread(), torch.no_grad():
        for count, places in sizes.items():
            heights = np.empty((len(places), count, len(texts)), np.float32)
            # One buffer: a new one for each scene costs page faults.
            wide = torch.empty(codes[places[0]].units.shape)
            for row, place in zip(heights, places):
                wide.copy_(codes[place].units)
                row[:] = (wide @ unit - codes[place].shared[:, None]).numpy()
            limits = np.stack([codes[p].full for p in places])
            found[places] = _best((heights - _offset(heights)) / limits[:, :, None])
    return found


def _offset(heights: NDArray[np.float32]) -> NDArray[np.float32]:
    """The quantile `OFFSET` over the codes, interpolated as by torch: ``[S, K, P]`` to ``[S, 1, P]``."""
    place = OFFSET * (heights.shape[1] - 1)
    low, high = math.floor(place), math.ceil(place)
    ranked = np.partition(heights, sorted({low, high}), axis=1)
    below, above = ranked[:, low], ranked[:, high]
    return (below + np.float32(place - low) * (above - below))[:, None]


def _best(strengths: NDArray[np.float32]) -> FloatArray:
    return np.maximum(strengths.max(1), 0).astype(np.float64)


def phrase_bound(phrase: Phrase, of_thing: Mapping[str, FloatArray]) -> FloatArray | float:
    """The bound of a phrase with relations from those of its things, each ``[S]``.

    A relation holds where all of its parts are present, a union where one is.
    """
    if isinstance(phrase, Thing):
        # A part may be held from `NO_PART`, a lampshade as a lamp shade.
        words = (phrase.text, *(split for split, _ in compounds(phrase.text, known_words(""))))
        return (NO_SEGMENT / NO_PART if any(map(thing_of_part, words)) else 1.0) * of_thing[phrase.text]
    if isinstance(phrase, (Anything, Viewer)) or (isinstance(phrase, AtLeast) and phrase.count == 0):
        return CERTAIN
    parts = [phrase_bound(part, of_thing) for part in parts_of(phrase).values()]
    if isinstance(phrase, Except):
        return parts[0]
    return functools.reduce(np.maximum if isinstance(phrase, Both) else np.minimum, parts)
