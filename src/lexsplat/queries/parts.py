"""Parts of things, such as "mug handle": cut within their thing, where colors change.

A part may be smaller than the segment that holds it. What is around it may score nearly as high, because image crops
that show a part show its surroundings. So segments do not say where a part ends.

1. The thing is what its name selects, with the segments beside it that are taken for the part (`with_parts`).
2. The relevancies of the thing's Gaussians are smoothed along links between neighbors. A link is weak where colors or
   relevancies differ: a black nose shares nothing with the fur around it.
3. The part reaches from the best score down to the border: the score that few Gaussians have, near `USUAL` of the way
   from the thing's median to its best score. If the part is most of the thing, as the shade is of a lamp, its lowest
   scores take the place of the median.
4. The best scores alone may be the middle of a handle. Random walks along the links (Grady 2006) tell how near what
   scores less is to the part. The part grows in this order to where the fewest links cross its border: where a handle
   meets its mug. That border must be at most half as long, or an ear would grow to its head, whose neck is narrow.

The constants were chosen on the second bundled scene and on the scene ``parts`` of tools/demo_scene
(docs/lab-notes/2026-11-objects.md). Dimension letters: N Gaussians, M of the thing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.queries.clusters import LINK, spacing
from lexsplat.queries.segments import SEGMENT_THRESHOLD
from lexsplat.runtime.device import kernel_threads

HELD = 0.2
"""A part without a thing, such as "handle", is a part of each object that has this share of what its name selects."""
FEWEST = 50
"""Gaussians of a thing that can be cut."""
NEIGHBORS = 10
COLOR, SCORE = 0.2, 0.3
"""Differences of colors, 0..1 in each channel, and of relevancies at which a link has 1/e of its weight."""
ROUNDS, SHARED = 10, 0.9
"""Rounds of smoothing, and the share that comes from the neighbors in each."""
BEST = 20
"""The best score is the mean of so many Gaussians."""
LOWEST, MOSTLY = 0.05, 0.7
"""A median beyond this share of the way from the 5 % quantile to the best score lies in the part."""
ALL = 0.5
"""Where the 5 % quantile of a thing reaches this, all of it is described as the part."""
USUAL, SPREAD = 0.875, 0.25
PLACES = np.linspace(0.5, 0.95, 46)
"""Places of the border that are tried, between what the thing scores and the best score."""
NEAR, FEW = 0.05, 0.1
"""Reach of what counts as near a border, on the same scale, and the share of the part that is few in any case."""
WALKED, NEAREST = 50, 0.2
"""Steps of the random walks, and the least share of them that end in the part where it may grow."""
SHORT = 1.0
"""A border that links of this total weight cross is short enough: a nose in black does not grow to the muzzle."""
SHORTER = 0.5
"""The longest border to grow to, relative to that of the best scores: heads have .49 to .66, handles less."""
FIRM = 0.5
"""Scores in a part start at this share of the way from the border to 1. Pixels blend them with those beside it: with
scores at the border, a pixel would have to show the part alone."""
OUTSIDE = 0.5
"""Factor on scores outside the thing."""

FloatArray = NDArray[np.float64]


@torch.no_grad()
def with_parts(thing: Tensor, taken: Tensor, gaussians: Gaussians, labels: Tensor) -> Tensor:
    """A thing with the adjacent segments that are taken for a part of it ``[N]`` bool.

    The name of a bottle may describe it without its cork.

    Args:
        thing: The Gaussians that the thing's name selects ``[N]`` bool, at least two.
        taken: The Gaussians of segments that are taken for the part ``[N]`` bool.
        gaussians: The scene.
        labels: Lowest segment of each Gaussian ``[N]``.
    """
    means, inside = gaussians.means.detach().cpu().double().numpy(), thing.cpu().numpy()
    others = np.flatnonzero(taken.cpu().numpy() & ~inside)
    if not len(others):
        return thing
    apart = cKDTree(means[inside]).query(means[others])[0]
    segments = labels.cpu().numpy()[others]
    near = np.unique(segments[apart <= LINK * spacing(means[inside])])
    joined = thing.clone()
    joined[torch.from_numpy(others[np.isin(segments, near)]).to(thing.device)] = True
    return joined


@dataclass(frozen=True)
class ThingGraph:
    """A thing as its parts are cut: what does not depend on the part.

    Args:
        places: Its Gaussians ``[M]``.
        weights: Their visible weights in the training views ``[M]`` float64.
        starts: First link of each, in the order of `places` ``[M + 1]``.
        ends: The neighbor at the other end of each link ``[E]``.
        apart: Squared difference of the colors at both ends ``[E]`` float64, in units of `COLOR`.
    """

    places: Tensor
    weights: FloatArray
    starts: NDArray[np.int64]
    ends: NDArray[np.int32]
    apart: FloatArray

    @classmethod
    @torch.no_grad()
    def of(cls, thing: Tensor, gaussians: Gaussians, masses: Tensor) -> ThingGraph:
        """The graph of a thing.

        Args:
            thing: The Gaussians of the thing ``[N]`` bool, at least `FEWEST`.
            gaussians: The scene.
            masses: Visible weight of each Gaussian in the training views ``[N]``.
        """
        places = thing.nonzero()[:, 0].cpu()
        means = gaussians.means.detach().cpu()[places].double().numpy()
        colors = (0.5 + SH_C0 * gaussians.sh0.detach()[:, 0].cpu()[places]).clamp(
            0, 1
        ).double().numpy() / COLOR
        count, neighbors = len(means), min(NEIGHBORS + 1, len(means))
        found = cKDTree(means).query(means, k=neighbors, workers=kernel_threads())[1][:, 1:]
        first = np.arange(0, found.size + 1, neighbors - 1)
        links = csr_array((np.ones(found.size), found.ravel(), first), shape=(count, count))
        links = links.maximum(links.T)  # a neighbor of either
        owners = np.repeat(np.arange(count), np.diff(links.indptr))
        apart = np.square(colors[owners] - colors[links.indices]).sum(-1)
        weights = masses.cpu()[places].double().numpy()
        return cls(places, weights, links.indptr.astype(np.int64), links.indices.astype(np.int32), apart)

    def links(self, values: FloatArray) -> csr_array:
        """Links ``[M, M]`` by how alike the colors and ``values [M]`` of their ends are; each row adds up to 1."""
        count, lengths = len(values), np.diff(self.starts)
        differences = (np.repeat(values, lengths) - values[self.ends]) / SCORE
        weighted = np.exp(-self.apart - differences * differences) * self.weights[self.ends]
        weighted /= np.repeat(np.maximum(np.add.reduceat(weighted, self.starts[:-1]), 1e-9), lengths)
        return csr_array((weighted, self.ends, self.starts), shape=(count, count))


@torch.no_grad()
def part_scores(relevancy: Tensor, thing: ThingGraph) -> Tensor | None:
    """Scores of a part; None if nearly all of its thing is described as the part and nothing is to be cut.

    Args:
        relevancy: Relevancy of each Gaussian by itself ``[N]`` in 0..1.
        thing: Its thing.

    Returns:
        ``[N]`` in 0..1, on the device of ``relevancy``; at least `SEGMENT_THRESHOLD` exactly in the part.
    """
    places, weights = thing.places, thing.weights
    own = relevancy.cpu().double().numpy()
    inside = own[places.numpy()]
    links, smooth = thing.links(inside), inside
    for _ in range(ROUNDS):
        smooth = (1 - SHARED) * inside + SHARED * (links @ smooth)
    if _quantile(smooth, weights, LOWEST) >= ALL:
        return None
    base, border, best = _border(smooth, weights)
    part = _grown(smooth, base, border, links)
    scores = OUTSIDE * np.minimum(own / border, 1)
    firm = FIRM + (1 - FIRM) * np.clip((smooth - border) / max(best - border, 1e-6), 0, 1)
    scores[places.numpy()] = np.where(part, 1 + firm, np.minimum(smooth / border, 1 - 1e-4))
    return torch.from_numpy(SEGMENT_THRESHOLD * scores).to(relevancy)


def _grown(smooth: FloatArray, base: float, border: float, links: csr_array) -> NDArray[np.bool_]:
    """The part ``[M]``: from the border on, and what random walks add where that makes its border much shorter."""
    part = smooth >= border
    between = np.flatnonzero(~part & (smooth > base))
    reached = part.astype(float)
    reached[between] = (smooth[between] - base) / max(border - base, 1e-9) / 2
    walk = links[between]
    for _ in range(WALKED):
        reached[between] = walk @ reached
    order = np.argsort(-reached, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    # A link crosses the border of those of the first Gaussians that have one of its ends.
    first, last = rank[links.indices], np.repeat(rank, np.diff(links.indptr))
    crosses, count = first < last, len(order) + 1
    starts, ends = (np.bincount(end[crosses], links.data[crosses], count) for end in (first, last))
    crossing = np.maximum(np.cumsum(starts - ends), SHORT)  # [n]: of the first n + 1
    fewest, most = int(part.sum()), int((reached >= NEAREST).sum())
    if not fewest:
        return part
    choices = crossing[fewest - 1 : most]
    shortest = int(choices.argmin())
    return part | (rank < fewest + shortest) if choices[shortest] <= SHORTER * choices[0] else part


def _quantile(scores: FloatArray, weights: FloatArray, share: float) -> float:
    order = np.argsort(scores, kind="stable")
    reached = np.cumsum(weights[order])
    return float(scores[order[min(np.searchsorted(reached, share * reached[-1]), len(order) - 1)]])


def _border(scores: FloatArray, weights: FloatArray) -> tuple[float, float, float]:
    """What is no part, the lowest score of a part, and its best one, from the scores ``[M]`` of the thing."""
    order = np.argsort(scores, kind="stable")
    ranked, reached = scores[order], np.concatenate([[0.0], np.cumsum(weights[order])])
    best = float(ranked[-BEST:].mean())

    def above(limits: FloatArray) -> FloatArray:
        return np.asarray(reached[-1] - reached[np.searchsorted(ranked, limits)])

    lowest, base = _quantile(scores, weights, LOWEST), _quantile(scores, weights, 0.5)
    if base - lowest > MOSTLY * (best - lowest):
        base = lowest
    limits, reach = base + PLACES * (best - base), NEAR * (best - base)
    near = (above(limits - reach) - above(limits + reach)) / np.maximum(above(limits), 1e-9)
    unusual = (PLACES - USUAL) ** 2 / (2 * SPREAD**2)
    return base, max(float(limits[(np.log(near + FEW) + unusual).argmin()]), 1e-6), best
