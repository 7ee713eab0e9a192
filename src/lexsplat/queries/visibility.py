"""Hidden Gaussians: those inside things, or under them, which the training views hardly show.

Nothing shows what they mean. A selection of what can be seen leaves them out, so that boxes and silhouettes end where
things end. An edit of a thing takes those inside it along (`whole_things`), and a deletion also those under it
(`with_remains`), so that less of a core stays behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.hulls import GROWN, inside_hull
from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.runtime.sampling import evenly

_HIDDEN = 0.05
"""Gaussians of which the views show a smaller share are hidden. Chosen on the second scene among 0.005 to 0.1."""
_MOSTLY = 0.5
_NEIGHBORS, _BESIDE = 6, 2
_VIEWS = 64
_ROWS = 1 << 14
"""Gaussians that are projected at a time: their arrays stay in the cache of a core."""
_OPEN = 0.9
"""Quantile of the shares at which nothing hides a Gaussian; the unit of the masses drops out."""


def hidden_gaussians(gaussians: Gaussians, cameras: Sequence[Camera], masses: Tensor) -> Tensor:
    """Which Gaussians are hidden ``[N]`` bool; the arguments are those of `shown_shares`."""
    if not cameras or not len(gaussians):
        return torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    return torch.from_numpy(shown_shares(gaussians, cameras, masses) < _HIDDEN).to(gaussians.device)


@torch.no_grad()
def shown_shares(gaussians: Gaussians, cameras: Sequence[Camera], masses: Tensor) -> NDArray[np.float64]:
    """Visible weight of each Gaussian as a share of its weight without the others ``[N]``.

    Args:
        gaussians: The scene.
        cameras: Its training views; at most 64 of them are looked at.
        masses: Visible weights over all training views ``[N]``, in any unit.
    """
    alone = torch.cat(
        [_alone(part, evenly(cameras, _VIEWS)) for part in gaussians.means.split(_ROWS)]
    ).numpy()
    # Seen from the side of its two longer axes.
    areas = gaussians.scales.double().cpu().sort(1).values[:, 1:].prod(1)
    alone *= (areas * gaussians.opacities.double().cpu()).numpy()
    shares = masses.double().cpu().numpy() / np.maximum(alone, 1e-12)
    seen = alone > 0
    level = float(np.quantile(shares[seen], _OPEN)) if seen.any() else 0.0
    return np.where(seen, np.minimum(shares / max(level, 1e-12), 1.0), 0.0)


def _alone(means: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Sum of the inverse squares of the depths of points ``[n, 3]`` in the views that hold them ``[n]``."""
    means = means.double().cpu()
    total = torch.zeros(len(means), dtype=torch.float64)
    for camera in cameras:
        matrix = torch.from_numpy(camera.K @ camera.viewmat[:3])
        x, y, depth = (means @ matrix[:, :3].T + matrix[:, 3]).T
        front = depth.clamp_min(1e-6)
        inside = (x >= 0) & (y >= 0) & (x < camera.width * front) & (y < camera.height * front) & (depth > 0)
        total += inside / front.square()
    return total


def without_hidden(chosen: Selection, hidden: Tensor) -> Selection:
    """The visible part of a selection. Hidden Gaussians still link what they connect, such as a lamp and its foot."""
    if not bool(hidden[chosen.indices].any()):
        return chosen
    return replace(chosen, mask=chosen.mask & ~hidden, parts=tuple(chosen.instances))


@torch.no_grad()
def whole_things(chosen: Selection, hidden: Tensor, segments: Segments | None) -> Selection:
    """A selection extended by the borders of its things and the hidden Gaussians in them.

    A segment belongs to it if half of what the views show of the segment does. A hidden Gaussian belongs to it if two
    of its six nearest neighbors that can be seen do, and it lies within the convex hull of a thing. A Gaussian of a
    fill belongs to what the fill continues, wherever it lies.

    Args:
        chosen: The selection.
        hidden: Which Gaussians of the scene are hidden ``[N]`` bool.
        segments: The segments of the scene; None takes the selection as it is.
    """
    if segments is None or not chosen:
        return chosen
    shown, hidden = _with_borders(chosen, segments), _without_fills(hidden, segments)
    whole = replace(shown, mask=shown.mask | inside_hulls(shown, _beside(shown, hidden)))
    return _with_borders(whole, segments)


@torch.no_grad()
def with_remains(chosen: Selection, hidden: Tensor, segments: Segments | None) -> Selection:
    """A selection extended by all that would stay behind if its things were taken away.

    Beyond `whole_things`, it has every hidden Gaussian within their hulls, such as what is in a mug, and those beside
    them outside their hulls, such as below a foot.
    """
    if segments is None or not chosen:
        return replace(chosen, mask=chosen.mask | inside_hulls(chosen, hidden))
    shown, hidden = _with_borders(chosen, segments), _without_fills(hidden, segments)
    whole = replace(shown, mask=shown.mask | _beside(shown, hidden))
    return _with_borders(replace(whole, mask=whole.mask | inside_hulls(whole, hidden)), segments)


def _without_fills(hidden: Tensor, segments: Segments) -> Tensor:
    """The hidden Gaussians ``[N]`` bool without those of fills, whose segments tell what they belong to."""
    return hidden if segments.added is None else hidden & ~segments.added.to(hidden.device)


def _with_borders(chosen: Selection, segments: Segments) -> Selection:
    """A selection with the segments that are selected for the most part."""
    count, mask = segments.levels.shape[1], chosen.mask.cpu().numpy()
    labels, masses = segments.labels.cpu().numpy(), segments.masses.cpu().double().numpy()
    taken = np.bincount(labels, masses * mask, count) >= _MOSTLY * np.bincount(labels, masses, count)
    taken &= np.bincount(labels, mask, count) > 0
    return replace(chosen, mask=torch.from_numpy(mask | taken[labels]).to(chosen.mask.device), parts=())


def _beside(chosen: Selection, hidden: Tensor) -> Tensor:
    """The hidden Gaussians beside selected ones ``[N]`` bool, which are not selected themselves."""
    mask, unseen = chosen.mask.cpu().numpy(), hidden.cpu().numpy()
    unsure, firm = np.flatnonzero(unseen & ~mask), np.flatnonzero(~unseen)
    found = np.zeros(len(mask), bool)
    if len(unsure) and len(firm) >= _NEIGHBORS:
        means = chosen.gaussians.means.detach().cpu().double().numpy()
        _, nearest = cKDTree(means[firm]).query(means[unsure], k=_NEIGHBORS)
        found[unsure] = mask[firm[nearest]].sum(1) >= _BESIDE
    return torch.from_numpy(found).to(chosen.mask.device)


def inside_hulls(chosen: Selection, among: Tensor) -> Tensor:
    """Which of some Gaussians lie inside the instances of a selection ``[N]`` bool."""
    means, found = chosen.gaussians.means.detach().cpu().double().numpy(), among.cpu().numpy().copy()
    places, inside = means[found], np.zeros(int(found.sum()), bool)
    for each in chosen.instances:
        inside |= inside_hull(means[each.mask.cpu().numpy()], places, GROWN)
    found[found] = inside
    return torch.from_numpy(found).to(among.device)
