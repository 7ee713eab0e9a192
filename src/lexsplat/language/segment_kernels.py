"""Felzenszwalb and Huttenlocher's segments of a graph, compiled; in its own file because Numba is rarely needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lexsplat.rendering.kernels.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel
def find_root(parents: IntArray, place: int) -> int:
    """The root of an element, with path halving."""
    while parents[place] != place:
        parents[place] = parents[parents[place]]
        place = parents[place]
    return place


@kernel
def join_linked(
    first: IntArray,
    second: IntArray,
    lengths: FloatArray,
    order: IntArray,
    tolerance: float,
    smallest: int,
    count: int,
) -> IntArray:
    """Felzenszwalb and Huttenlocher's segments of a graph: the root of each element ``[N]``.

    Args:
        first: One end of each link ``[E]``.
        second: The other end ``[E]``.
        lengths: Lengths of the links ``[E]``.
        order: Links by length ``[E]``.
        tolerance: k: a set of n elements accepts links that are longer than its longest by k / n.
        smallest: Smaller segments are joined with the nearest one afterwards.
        count: Number of elements N.
    """
    parents, sizes, longest = np.arange(count), np.ones(count, np.int64), np.zeros(count)
    for late in (False, True):
        for link in order:
            a, b = find_root(parents, first[link]), find_root(parents, second[link])
            if a == b:
                continue
            accepted = min(longest[a] + tolerance / sizes[a], longest[b] + tolerance / sizes[b])
            small = sizes[a] < smallest or sizes[b] < smallest
            if small if late else lengths[link] <= accepted:
                if sizes[a] < sizes[b]:
                    a, b = b, a
                parents[b] = a
                sizes[a] += sizes[b]
                longest[a] = lengths[link]
    return np.array([find_root(parents, place) for place in range(count)])
