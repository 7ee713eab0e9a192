"""The training views that method "averaged" reads: as few as show each Gaussian often enough.

Features are often the longest stage of a build, and the mean of a Gaussian hardly changes after its first views
(docs/lab-notes/2026-11-language.md). The weight of a Gaussian in a view, relative to its largest in any training
view, is the sighting that this view gives: 1 from near by, less from afar or where something hides it in part. Views
are taken one after the other, always the one that adds most to the sightings that are still wanted: a greedy cover
(Wolsey 1982). First one sighting of every Gaussian is wanted, so that no place is left out for the sake of others,
then as many as are asked for.
Dimension letters: N Gaussians, V views, n sampled Gaussians.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.methods.method import FitRun
from lexsplat.rendering import prepare, weigh_cells
from lexsplat.runtime.device import threads_for_kernels
from lexsplat.runtime.progress import Event, FirstUnits
from lexsplat.runtime.workers import Needs, results

if TYPE_CHECKING:
    from lexsplat.captures import View

STAGE, SHARES_STAGE = "views to read", "sightings"
ENOUGH_ONCE, ENOUGH = 0.999, 0.95
"""Shares of the wanted sightings at which no further view is taken: of one for every Gaussian, and of all."""
_LONG_SIDE = 120
_SAMPLE, _MOST_NUMBERS = 16_384, 1 << 26
"""Gaussians that decide; fewer where there are thousands of views, whose weights take 128 MB."""
_LEAST = 0.01
"""Least weight of a Gaussian in some view, in pixels of 120 along the longer side; others are too small to tell."""
_VIEWS_OF_A_TASK = 16


def views_that_show(
    gaussians: Gaussians, views: Mapping[str, View], sightings: int, run: FitRun
) -> tuple[list[str], Tensor]:
    """Names of views that show the Gaussians `sightings` times, or as often as all views do; sorted.

    Args:
        gaussians: The geometry.
        views: Views to choose from; masked pixels show nothing.
        sightings: Wanted sightings of each Gaussian, at least 1.
        run: Its listener receives events of stage "views to read", and for the shares of stage "sightings". The
            result does not depend on its workers.

    Returns:
        The names, and the share of each Gaussian's weight over all views that these have ``[N]``: at least half of
        their share of the views, and at most 1.
    """
    names, count = sorted(views), len(gaussians)
    everything = names, torch.ones(count, device=gaussians.device)
    if len(names) <= sightings or not count:
        return everything
    taken = min(count, _SAMPLE, max(1, _MOST_NUMBERS // len(names)))
    sample = np.unique(np.linspace(0, count - 1, taken).astype(np.int64))
    # The mip filter makes Gaussians fainter that a small image makes too large.
    shared = _Weighed(replace(gaussians.detach(), antialiased=True), views, sample)
    weights, done = np.zeros((len(names), len(sample)), np.float16), 0
    possible, found = np.zeros((2, count), np.float32)
    for part, total in _weigh(shared, names, run, STAGE):
        weights[done : done + len(part)] = part
        possible += total
        done += len(part)
    chosen = [names[row] for row in covering(weights, sightings)]
    if not chosen:
        return everything
    for _, total in _weigh(shared, chosen, run, SHARES_STAGE):
        found += total
    usual = len(chosen) / len(names)
    shares = np.where(possible > 0, found / np.maximum(possible, 1e-12), usual)
    # What the chosen views hardly show is not trusted as if all views had been read.
    rounded = shares.clip(usual / 2, 1).astype(np.float16).astype(np.float32)  # as they are kept
    return chosen, torch.from_numpy(rounded).to(gaussians.device)


@dataclass(frozen=True)
class _Weighed:
    """Inputs of the tasks: what is looked at."""

    gaussians: Gaussians
    views: Mapping[str, View]
    sample: NDArray[np.int64]


def _weigh(
    shared: _Weighed, names: Sequence[str], run: FitRun, stage: str
) -> Iterator[tuple[NDArray[np.float16], NDArray[np.float32]]]:
    """The results of `_weights_of` for all names, in order, with events of a stage."""
    size = _VIEWS_OF_A_TASK  # also without workers: the order of a sum decides its last bit
    tasks = {names[start]: tuple(names[start : start + size]) for start in range(0, len(names), size)}
    gaussians = shared.gaussians
    nbytes = 2 * size * len(shared.sample) + 4 * len(gaussians)
    needs = Needs(gpu=gaussians.device.type == "cuda", result=nbytes)
    told, done = FirstUnits(stage, "photos"), 0
    told(0, len(names))
    run.listener(Event(stage, 0, len(names)))
    for part, total in results(run.workers.map(_weights_of, shared, tasks, needs)):
        yield part, total
        done += len(part)
        if not run.workers.distributed:  # of whose tasks many begin at once
            told(done, len(names))
        run.listener(Event(stage, done, len(names), run.workers.metrics))


@threads_for_kernels()
def _weights_of(shared: _Weighed, names: tuple[str, ...]) -> tuple[NDArray[np.float16], NDArray[np.float32]]:
    """Weight of each Gaussian of the sample in some views ``[v, n]``, and of each Gaussian in all of them ``[N]``."""
    rows, total = [], np.zeros(len(shared.gaussians), np.float32)
    for name in names:
        weights = _weights(shared.gaussians, shared.views[name])
        rows.append(weights[shared.sample].clip(max=np.finfo(np.float16).max).astype(np.float16))
        total += weights
    return np.stack(rows), total


def _weights(gaussians: Gaussians, view: View) -> NDArray[np.float32]:
    """Weight of each Gaussian in a view ``[N]``, in pixels of a small image of it."""
    camera: Camera = view.camera.within(_LONG_SIDE)
    valid = view.valid_share((camera.width, camera.height))
    counts = torch.ones(camera.height, camera.width) if valid is None else torch.from_numpy(valid)
    with torch.no_grad():
        prepared = prepare(gaussians, camera)
        found = weigh_cells(gaussians, camera, (1, 1), counts.to(gaussians.device), prepared)
        return np.asarray(found.totals().cpu().numpy())


def covering(weights: NDArray[np.floating], sightings: float) -> list[int]:
    """Rows that show nearly every column often enough, in ascending order; none if nothing is shown.

    Args:
        weights: Weight of each Gaussian in each view ``[V, n]``; they are changed.
        sightings: Wanted sum of the weights of a Gaussian, in multiples of its largest.
    """
    best = weights.max(axis=0)
    shown = best >= _LEAST
    weights[:, ~shown] = 0
    weights /= np.where(shown, best, 1)
    possible = weights.sum(axis=0, dtype=np.float64)
    have, chosen = np.zeros_like(possible), set[int]()
    for wish, enough in ((min(1, sightings), ENOUGH_ONCE), (sightings, ENOUGH)):
        wanted = np.minimum(possible, wish)
        # What a view adds only falls as others are taken: what it once added bounds what it adds now.
        bounds = [(-np.inf, row) for row in range(len(weights)) if row not in chosen]
        while np.minimum(have, wanted).sum() < enough * wanted.sum():
            _, row = heapq.heappop(bounds)
            added = np.minimum(have + weights[row], wanted) - np.minimum(have, wanted)
            entry = (-float(added.sum()), row)
            if bounds and entry > bounds[0]:
                heapq.heappush(bounds, entry)
                continue
            have = have + weights[row]
            chosen.add(row)
    return sorted(chosen)
