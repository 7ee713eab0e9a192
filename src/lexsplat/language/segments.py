"""A hierarchy of segments in 3D: parts, objects and groups, from the results of a build, without classes or training.

1. Each Gaussian is linked to its nearest neighbors. A link is short where language and color agree.
2. Felzenszwalb and Huttenlocher 2004 join linked Gaussians to small segments of at least `_SMALLEST` Gaussians: two
   sets are joined if the link between them is short compared with the links inside both.
3. Neighboring segments are merged in pairs, the closest in mean language and color first (Ward's criterion with the
   square root of the masses, which favors small segments less). Cuts through the tree of merges are the levels: each
   has half as many segments as the one below.

All distances are relative to their mean in the scene, so nothing depends on how narrow an encoder's features are.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.runtime.progress import Event, Listener, silent

_NEIGHBORS = 10
_COLOR = 0.2
"""Weight of the squared difference of colors in the length of a link; that of language is 1."""
_MERGE_COLOR = 0.25
"""Weight of the difference of colors between segments; that of language is 1."""
_TOLERANCE = 4.0
"""Felzenszwalb and Huttenlocher's k, in median lengths of links."""
_SMALLEST = 8
_MOST = 20_000
"""Number of segments of the lowest level, about, at most; more Gaussians make larger segments."""
_COARSEST = 20
"""No level has fewer segments, unless the lowest has."""
_LINKS_AT_ONCE = 1 << 16
"""Links between two reports."""
_LINKS_IN_CACHE = 1 << 10
"""Links whose features are read at once, so that they stay in the processor's cache."""
STAGE = "segments"
_MERGE_UNITS = 10
"""Units of progress of the merging of segments."""
_REPORTED = 256
"""Merges between two reports."""
_PREFIX = "segments."
_MOSTLY = 0.5
"""Share of a segment's visible weight, of which a copy is one of the segment."""
_ADDED = 2
"""In the tensor "hidden" of earlier versions, the Gaussians of fills."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, repr=False)
class Segments:
    """The segments of N Gaussians at L levels; S segments at the lowest one.

    Args:
        labels: Segment of each Gaussian at the lowest level ``[N]`` int64, in 0..S-1.
        masses: Visible weight of each Gaussian over the training views ``[N]`` float32, in cells; not negative.
        levels: Segment at each level of each lowest segment ``[L, S]`` int64, the lowest level first.
        hidden: Gaussians that the training views hardly show ``[N]`` bool, where they are not as geometry and masses
            say, as after an edit; None leaves that to `lexsplat.queries.visibility`.
        added: Those of fills (`lexsplat.scenes.filling`) ``[N]`` bool, which are hidden; None for none. They are
            denser than what photos show, so that their spacing does not count.
    """

    labels: Tensor
    masses: Tensor
    levels: Tensor
    hidden: Tensor | None = None
    added: Tensor | None = None

    def __post_init__(self) -> None:
        if self.labels.ndim != 1 or self.masses.shape != self.labels.shape or self.levels.ndim != 2:
            raise ValueError(
                f"labels [N], masses [N] and levels [L, S] expected, got {list(self.labels.shape)}, "
                f"{list(self.masses.shape)}, {list(self.levels.shape)}"
            )
        if self.labels.numel() and not self.levels.numel():
            raise ValueError("segments of Gaussians need a level")
        for name, values in (("labels", self.labels), ("levels", self.levels)):
            _check_range(name, values, self.levels.shape[1])
        if self.masses.numel() and float(self.masses.min()) < 0:
            raise ValueError("masses must not be negative")
        for name, mask in (("hidden", self.hidden), ("added", self.added)):
            if mask is not None and mask.shape != self.labels.shape:
                raise ValueError(f"{name} [N] expected, got {list(mask.shape)}")

    def __repr__(self) -> str:
        levels, lowest = self.levels.shape
        return f"Segments({len(self.labels):,} Gaussians, {lowest:,} segments, {levels} levels)"

    def select(self, index: Tensor) -> Segments:
        """The segments of some Gaussians, with the same numbers."""
        hidden, added = (None if mask is None else mask[index] for mask in (self.hidden, self.added))
        return Segments(self.labels[index], self.masses[index], self.levels, hidden, added)

    def with_fill(self, first: int) -> Segments:
        """The segments where the Gaussians from a number on are those of a fill: no photo shows them."""
        fill = torch.arange(len(self.labels), device=self.labels.device) >= first
        hidden, added = (fill if mask is None else mask | fill for mask in (self.hidden, self.added))
        return Segments(self.labels, self.masses * ~fill, self.levels, hidden, added)

    def with_copy(self, mask: Tensor) -> Segments:
        """The segments after a copy of some Gaussians ``[N]`` bool is appended.

        What is copied for the most part gets segments of its own. A group of which a part is copied holds the copy,
        too: a group that is the copy alone would make groups better answers than things.
        """
        index = torch.cat([torch.arange(len(self.labels), device=mask.device), mask.nonzero()[:, 0]])
        both, first = self.select(index), self.levels.shape[1]
        total, copied = (
            torch.zeros(first, device=mask.device).index_add_(0, self.labels[some], self.masses[some] + 1e-6)
            for some in (slice(None), mask)
        )
        sources, copies = self.labels[mask].unique(return_inverse=True)
        whole, levels = torch.ones_like(sources, dtype=torch.bool), []
        for level in self.levels:
            sums = [torch.zeros_like(total).index_add_(0, level, part) for part in (copied, total)]
            whole &= (sums[0] >= _MOSTLY * sums[1])[level[sources]]
            own = first + level[sources].unique(return_inverse=True)[1]
            levels.append(torch.cat([level, torch.where(whole, own, level[sources])]))
        labels = torch.cat([self.labels, first + copies])
        return Segments(labels, both.masses, torch.stack(levels), both.hidden, both.added)

    def tensors(self) -> dict[str, Tensor]:
        """For safetensors, without loss but for masses, which are rounded to 16 bits.

        A Gaussian has a bit for each binary digit of the largest label, and 16 for its mass; after an edit also one
        for "hidden", and one for "added". Of the levels, each segment has its segment at the next one in 2 bytes.
        """
        lowest, parts = self.levels.shape[1], [self.levels.new_zeros(0)]
        below, counts = torch.arange(lowest, device=self.levels.device), [lowest]
        for level in self.levels:
            parts.append(level.new_zeros(counts[-1]).scatter_(0, below, level))
            below, counts = level, [*counts, int(level.max()) + 1 if lowest else 0]
        digits = max(1, int(self.labels.max() if len(self.labels) else 0).bit_length())
        found = {
            "label_bits": torch.stack([_packed(self.labels >> digit & 1) for digit in range(digits)]),
            "masses": self.masses.clamp(max=6e4).half(),
            "parents": torch.cat(parts).to(torch.uint16 if lowest <= 1 << 16 else torch.int32),
            "counts": torch.tensor(counts),
        }
        masks = {"hidden_bits": self.hidden, "added_bits": self.added if self.hidden is not None else None}
        found |= {name: _packed(mask) for name, mask in masks.items() if mask is not None}
        return {_PREFIX + name: value for name, value in found.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Segments | None:
        """The inverse of `tensors`, also of those of earlier versions; None if there are no segments among them.

        Raises:
            ValueError: If one of the tensors is missing, is of the wrong kind, or they do not fit each other.
        """
        found = {name.removeprefix(_PREFIX): tensors[name] for name in tensors if name.startswith(_PREFIX)}
        if not found:
            return None
        earlier = not found.keys() & {"label_bits", "parents", "counts"}
        names = ("labels", "masses", "levels") if earlier else ("label_bits", "masses", "parents", "counts")
        if missing := [name for name in names if name not in found]:
            raise ValueError(f"segments lack {', '.join(missing)}")
        for name, tensor in found.items():
            if (tensor.is_floating_point() or tensor.is_complex()) != (name == "masses"):
                kind = "floats" if name == "masses" else "integers"
                raise ValueError(f"{_PREFIX}{name} must be {kind}, got {tensor.dtype}")
        masses = found["masses"].float()
        if masses.numel() and not 0 < float(masses.double().sum()) < math.inf:
            raise ValueError("masses must be finite, and some of them positive")
        if masses.ndim != 1 or (not earlier and found["label_bits"].ndim != 2):
            raise ValueError("masses [N] and label_bits [B, N / 8] expected")
        if earlier:
            read = _of_earlier_version(found)
        else:
            labels = torch.zeros_like(masses, dtype=torch.int64)
            for digit, bits in enumerate(found["label_bits"]):
                labels |= _unpacked(bits, masses).long() << digit
            masks = (found.get(name) for name in ("hidden_bits", "added_bits"))
            hidden, added = (None if bits is None else _unpacked(bits, masses) for bits in masks)
            read = (labels, _levels(found["parents"].long(), found["counts"].long()), hidden, added)
        return cls(read[0], masses, *read[1:])


_Read = tuple[Tensor, Tensor, Tensor | None, Tensor | None]
"""Labels, levels, and the masks "hidden" and "added"."""


def _of_earlier_version(found: Mapping[str, Tensor]) -> _Read:
    """What earlier versions stored as ``labels [N]``, ``levels [L, S]`` and ``hidden [N]``, where 2 means added."""
    levels, hidden = found["levels"].long(), found.get("hidden")
    if levels.ndim == 2:
        for below, level in pairwise(levels):
            _check_range("levels", below, levels.shape[1])
            parents = torch.zeros_like(below).scatter_(0, below, level)
            if not torch.equal(parents[below], level):
                raise ValueError("levels must be nested: a segment lies in one segment of the next level")
    if hidden is None:
        return found["labels"].long(), levels, None, None
    added = hidden == _ADDED
    return found["labels"].long(), levels, hidden.bool(), added if bool(added.any()) else None


def _levels(parents: Tensor, counts: Tensor) -> Tensor:
    """The levels ``[L, S]`` from the segment of each segment at the next level, and the numbers of segments."""
    sizes = counts.tolist() if counts.ndim == 1 else []
    if not sizes or min(sizes) < 0 or parents.ndim != 1 or sum(sizes[:-1]) != len(parents):
        raise ValueError(f"parents of {sizes[:-1]} segments expected, got {list(parents.shape)}")
    levels: list[Tensor] = []
    for part, count in zip(parents.split(sizes[:-1]), sizes[1:]):
        _check_range("parents", part, count)
        levels.append(part[levels[-1]] if levels else part)
    return torch.stack(levels) if levels else parents.new_zeros(0, sizes[0])


def _check_range(name: str, values: Tensor, count: int) -> None:
    if values.numel() and not 0 <= int(values.min()) <= int(values.max()) < count:
        raise ValueError(f"{name} must be in 0..{count - 1}")


def _packed(mask: Tensor) -> Tensor:
    """Bits ``[N]``, eight in a byte, the first one the highest."""
    return torch.from_numpy(np.packbits(mask.cpu().numpy().astype(np.uint8))).to(mask.device)


def _unpacked(packed: Tensor, like: Tensor) -> Tensor:
    """The inverse of `_packed` as bool, as many as another tensor ``[N]`` has and on its device."""
    count = len(like)
    if packed.dtype != torch.uint8 or packed.shape != ((count + 7) // 8,):
        raise ValueError(f"bits of {count} Gaussians expected, got {packed.dtype} {list(packed.shape)}")
    return torch.from_numpy(np.unpackbits(packed.cpu().numpy(), count=count).astype(bool)).to(like.device)


Rows = Callable[[slice | Tensor], Tensor]
"""Language features of some Gaussians ``[n, D]``, of any length."""


def make_segments(
    gaussians: Gaussians, features: Rows, masses: Tensor, listener: Listener = silent
) -> Segments:
    """The segments of a scene. Runs on the CPU; the result does not depend on the number of threads.

    Args:
        gaussians: The geometry and colors.
        features: Their mean language features, 0 where no view shows them.
        masses: Their visible weights over the training views ``[N]``.
        listener: Receives events of stage "segments": one unit per block of links, then those of merging.
    """
    from lexsplat.language.segment_kernels import join_linked

    count = len(gaussians)
    weights = masses.detach().cpu().double().numpy()
    if count < 2:
        return Segments(torch.zeros(count, dtype=torch.int64), masses.cpu(), torch.zeros(1, 1).long())
    colors = (0.5 + SH_C0 * gaussians.sh0[:, 0].detach()).clamp(0, 1).cpu().double().numpy()
    means = gaussians.means.detach().cpu().double().numpy()
    listener(Event(STAGE, 0, 1))
    first, second = _links(means, min(_NEIGHBORS, count - 1))
    parts, blocks = [], range(0, len(first), _LINKS_AT_ONCE)
    total = len(blocks) + _MERGE_UNITS
    for done, start in enumerate(blocks):
        listener(Event(STAGE, done, total))
        block = slice(start, start + _LINKS_AT_ONCE)
        parts.append(_language_distances(features, first[block], second[block]))
    language = np.concatenate(parts)
    color = ((colors[first] - colors[second]) ** 2).sum(1)
    lengths = language / max(language.mean(), 1e-12) + _COLOR * color / max(color.mean(), 1e-12)
    order = np.argsort(lengths, kind="stable")
    smallest = max(_SMALLEST, count // _MOST)
    tolerance = _TOLERANCE * float(np.median(lengths))
    labels = np.unique(
        join_linked(first, second, lengths, order, tolerance, smallest, count), return_inverse=True
    )[1]
    described = _describe(labels, features, colors, weights)
    segments = int(labels.max()) + 1
    listener(Event(STAGE, len(blocks), total))

    def merged(share: float) -> None:
        listener(Event(STAGE, min(len(blocks) + int(share * _MERGE_UNITS), total - 1), total))

    merges = _merge(*described, labels[first], labels[second], merged)
    counts = [segments >> level for level in range(32) if level == 0 or segments >> level >= _COARSEST]
    levels = np.stack([_cut(segments, merges, number) for number in counts])
    listener(Event(STAGE, total, total))
    return Segments(torch.from_numpy(labels), masses.detach().cpu().float(), torch.from_numpy(levels))


def _links(means: FloatArray, neighbors: int) -> tuple[IntArray, IntArray]:
    """Pairs of neighboring Gaussians ``[E]``, each once, the smaller index first."""
    from scipy.spatial import cKDTree

    count = len(means)
    _, found = cKDTree(means).query(means, k=neighbors + 1)
    own = np.arange(count)[:, None]
    keys = np.sort((np.minimum(own, found) * count + np.maximum(own, found))[own != found])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return keys // count, keys % count


def _language_distances(features: Rows, first: IntArray, second: IntArray) -> FloatArray:
    """One minus the cosine of the features of linked Gaussians ``[E]``."""
    cosines = np.empty(len(first))
    for start in range(0, len(first), _LINKS_IN_CACHE):
        part = slice(start, start + _LINKS_IN_CACHE)
        rows = [features(torch.from_numpy(index[part])).cpu().double().numpy() for index in (first, second)]
        lengths = [np.sqrt(np.einsum("ij,ij->i", one, one)) for one in rows]
        cosines[part] = np.einsum("ij,ij->i", *rows) / np.maximum(lengths[0] * lengths[1], 1e-12)
    return np.maximum(1 - cosines, 0.0)


def _describe(
    labels: IntArray, features: Rows, colors: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean language and color ``[S, D + 3]`` of segments, each scaled by its spread, and their masses ``[S]``."""
    from scipy.sparse import csr_array

    segments, total = int(labels.max()) + 1, max(float(weights.sum()), 1e-12)
    masses = np.bincount(labels, weights, segments).astype(np.float64)
    described = []
    step = 1 << 14

    def sums(rows: Callable[[slice], FloatArray]) -> tuple[FloatArray, float]:
        summed, squares = 0.0, 0.0
        for start in range(0, len(labels), step):
            part = slice(start, start + step)
            values, shares = rows(part), weights[part]
            places = labels[part], np.arange(len(shares))
            summed = summed + csr_array((shares, places), shape=(segments, len(shares))) @ values
            squares += float(shares @ np.einsum("ij,ij->i", values, values))
        return np.asarray(summed), squares

    def unit(part: slice) -> FloatArray:
        values = features(part).cpu().double().numpy()
        return values / np.maximum(np.sqrt(np.einsum("ij,ij->i", values, values)), 1e-12)[:, None]

    for rows, weight in ((unit, 1.0), (lambda part: colors[part], _MERGE_COLOR)):
        summed, squares = sums(rows)
        spread = squares / total - float(((summed.sum(0) / total) ** 2).sum())
        means = summed / np.maximum(masses, 1e-12)[:, None]
        described.append(weight * means / np.sqrt(max(spread, 1e-12)))
    return np.concatenate(described, 1), masses


def _merge(
    means: FloatArray,
    masses: FloatArray,
    first: IntArray,
    second: IntArray,
    report: Callable[[float], None],
) -> list[tuple[int, int]]:
    """Merges of neighboring segments, the closest first: merge t joins two nodes to node S + t.

    Reports the share of the merges that are done.
    """
    count = len(means)
    means = np.concatenate([means, np.zeros_like(means)])
    masses = np.concatenate([masses, np.zeros_like(masses)])
    neighbors: list[set[int]] = [set() for _ in range(2 * count)]
    for a, b in np.unique(np.stack([first, second]), axis=1).T.tolist():
        if a != b:
            neighbors[a].add(b)
            neighbors[b].add(a)

    def cost(a: int, b: int) -> float:
        apart = means[a] - means[b]
        return float(apart @ apart) * float(masses[a] * masses[b] / max(masses[a] + masses[b], 1e-12)) ** 0.5

    waiting = [(cost(a, b), a, b) for a in range(count) for b in neighbors[a] if a < b]
    heapq.heapify(waiting)
    alive, merges = set(range(count)), list[tuple[int, int]]()
    while waiting:
        _, a, b = heapq.heappop(waiting)
        if a not in alive or b not in alive:
            continue
        node = count + len(merges)
        merges.append((a, b))
        if len(merges) % _REPORTED == 0:
            report(len(merges) / count)
        alive.difference_update((a, b))
        alive.add(node)
        masses[node] = masses[a] + masses[b]
        means[node] = (masses[a] * means[a] + masses[b] * means[b]) / max(masses[node], 1e-12)
        neighbors[node] = (neighbors[a] | neighbors[b]) - {a, b}
        for other in neighbors[node]:
            neighbors[other] -= {a, b}
            neighbors[other].add(node)
            heapq.heappush(waiting, (cost(other, node), other, node))
    return merges


def _cut(count: int, merges: list[tuple[int, int]], number: int) -> IntArray:
    """The segment of each of ``count`` lowest segments ``[S]`` after merging down to ``number``, numbered from 0."""
    parents = np.arange(2 * count)
    for place, pair in enumerate(merges[: count - number]):
        parents[list(pair)] = count + place
    while not np.array_equal(parents, parents[parents]):
        parents = parents[parents]
    return np.unique(parents[:count], return_inverse=True)[1]
