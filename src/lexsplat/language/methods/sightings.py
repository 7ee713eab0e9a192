"""The training views that method "averaged" reads: as few as show each Gaussian often enough.

Features are often the longest stage of a build, and the mean of a Gaussian hardly changes after its first views
(docs/lab-notes/2026-11-language.md). The weight of a Gaussian in a view, relative to its largest in any view, is the
sighting that this view gives: 1 from near by, less from afar or where something hides it in part. Views are taken one
after the other, always the one that adds most to the sightings that are still wanted. First one sighting of every
Gaussian is wanted, so that no place is left out, then as many as are asked for. These sums are submodular, so that no
other choice of as many views has more than e / (e - 1) times as much (Nemhauser, Wolsey and Fisher 1978).
Dimension letters: V views, n sampled Gaussians.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.methods.method import FitRun
from lexsplat.rendering import prepare, weigh_cells
from lexsplat.runtime.device import threads_for_kernels
from lexsplat.runtime.progress import Event
from lexsplat.runtime.workers import Needs, results

if TYPE_CHECKING:
    from lexsplat.captures import View

ENOUGH_ONCE, ENOUGH = 0.999, 0.95
"""Shares of the wanted sightings at which no further view is taken: of one for every Gaussian, and of all."""
_LONG_SIDE = 120
_SAMPLE, _FEWER, _MOST_NUMBERS = 16_384, 2_048, 1 << 26
"""Gaussians that are looked at; at least so many where the views are many, whose weights are 128 MB then."""
_LEAST = 0.01
"""Least weight of a Gaussian in some view, in pixels of 120 along the longer side; others are too small to tell."""
_VIEWS_OF_A_TASK = 16


def views_that_show(
    gaussians: Gaussians, views: Mapping[str, View], sightings: int, run: FitRun
) -> list[str]:
    """Names of views that show nearly every Gaussian `sightings` times, or as often as all views do; sorted.

    Args:
        gaussians: The geometry.
        views: Views to choose from; masked pixels show nothing.
        sightings: Wanted sightings of each Gaussian, at least 1.
        run: Its listener receives events of stage "views to read". The result does not depend on its workers.
    """
    names, count = sorted(views), len(gaussians)
    if len(names) <= sightings or not count:
        return names
    taken = min(count, max(_FEWER, min(_SAMPLE, _MOST_NUMBERS // len(names))))
    sample = np.unique(np.linspace(0, count - 1, taken).astype(np.int64))
    size = _VIEWS_OF_A_TASK if run.workers.distributed else 1
    tasks = {names[start]: tuple(names[start : start + size]) for start in range(0, len(names), size)}
    shared = _Weighed(gaussians.detach(), views, sample)
    needs = Needs(gpu=gaussians.device.type == "cuda", result=2 * size * len(sample))
    rows: list[NDArray[np.float16]] = []
    run.listener(Event("views to read", 0, len(names)))
    for found in results(run.workers.map(_weights_of, shared, tasks, needs)):
        rows.append(found)
        run.listener(Event("views to read", sum(map(len, rows)), len(names), run.workers.metrics))
    return [names[row] for row in covering(np.concatenate(rows), sightings)] or names


@dataclass(frozen=True)
class _Weighed:
    """Inputs of the tasks: what is looked at."""

    gaussians: Gaussians
    views: Mapping[str, View]
    sample: NDArray[np.int64]


@threads_for_kernels()
def _weights_of(shared: _Weighed, names: tuple[str, ...]) -> NDArray[np.float16]:
    """Weight of each Gaussian of the sample in some views ``[v, n]``, in pixels of small images of them."""
    rows = [_weights(shared.gaussians, shared.views[name])[shared.sample] for name in names]
    return np.stack(rows).clip(max=np.finfo(np.float16).max).astype(np.float16)


def _weights(gaussians: Gaussians, view: View) -> NDArray[np.float32]:
    """Weight of each Gaussian in a view ``[N]``, in pixels of a small image of it."""
    camera: Camera = view.camera.within(_LONG_SIDE)
    valid = view.load_valid((camera.width, camera.height))
    counts = torch.ones(camera.height, camera.width) if valid is None else torch.from_numpy(valid).float()
    with torch.no_grad():
        prepared = prepare(gaussians, camera)
        found = weigh_cells(gaussians, camera, (1, 1), counts.to(gaussians.device), prepared)
        return np.asarray(found.totals().cpu().numpy())


def covering(weights: NDArray[np.floating], sightings: float) -> list[int]:
    """Rows that show nearly every column often enough, in ascending order; none if nothing is shown.

    Args:
        weights: Weight of each Gaussian in each view ``[V, n]``.
        sightings: Wanted sum of the weights of a Gaussian, in multiples of its largest.
    """
    best = weights.max(axis=0)
    shown = best >= _LEAST
    parts = weights[:, shown] / best[shown]
    possible = parts.sum(axis=0, dtype=np.float64)
    have, chosen = np.zeros_like(possible), set[int]()
    for wish, enough in ((min(1, sightings), ENOUGH_ONCE), (sightings, ENOUGH)):
        wanted = np.minimum(possible, wish)
        # What a view adds only falls as others are taken: what it once added bounds what it adds now.
        bounds = [(-np.inf, row) for row in range(len(parts)) if row not in chosen]
        while np.minimum(have, wanted).sum() < enough * wanted.sum():
            _, row = heapq.heappop(bounds)
            added = np.minimum(have + parts[row], wanted) - np.minimum(have, wanted)
            entry = (-float(added.sum()), row)
            if bounds and entry > bounds[0]:
                heapq.heappush(bounds, entry)
                continue
            have = have + parts[row]
            chosen.add(row)
    return sorted(chosen)
