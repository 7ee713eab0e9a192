"""Method "averaged", the default: the features of views on each Gaussian first, codes afterwards.

The paper quantizes the features of every view and then puts the codes on the Gaussians. Small parts such as a mug's
handle cover too few cells to receive one of the codewords and are lost before the views are combined. This method
reverses the order. The weight alpha T with which Gaussian n is blended into a pixel is its share of that pixel's
feature, so its own feature is the weighted mean over all pixels of the training views that are read (as few as show
everything often enough, `lexsplat.language.methods.sightings`),

    F_n = sum alpha T F(p) / sum alpha T,

the transpose of rendering (as in LUDVIG and Occam's LGS). Averaging cancels what is wrong in single views. The
codebook is then fitted to the Gaussians (Eq. 2 to 4; with the DINO half for class tokens only), and each Gaussian
carries a softmax over its nearest codes. The length of the mean of unit vectors measures how far the views agree,
which gives u_G: 0 for a mean of length 1, and 1 for a mean no longer than that of all features of the scene.

Where photos have several levels of 2D segments (`lexsplat.features.segments2d`), each Gaussian has a mean and codes
at each level, from one codebook. u_G is the mean over the levels.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lexsplat.codebook import Codebook, CodebookConfig
from lexsplat.codebook.fitting import spherical_kmeans
from lexsplat.features import FeatureMap, FeatureMaps
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField
from lexsplat.language.methods.averaging import ROWS, MeanFeatures, average_features
from lexsplat.language.methods.method import FitRun, TrainingViews, Variant
from lexsplat.language.methods.sightings import views_that_show
from lexsplat.language.segments import make_segments
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.progress import Event, Listener, silent, tell
from lexsplat.runtime.sampling import evenly

log = logging.getLogger("lexsplat")

AGREEING = 0.4
"""Agreement of the views, 1 - u_G, below which the features are doubted.

Scenes of encoders that know their things have .66 to .86, and .42 after a hundred steps at a quarter of the size.
Features of the wrong views, or mirrored ones, have .27 to .41, and noise 0 (docs/lab-notes/2026-11-encoders.md).
"""
_TOLD_FROM = 12
"""Fewest views with a forecast: the calibration takes as long as about four of them."""
_VIEWS = 3
"""Views that are timed."""
_SAMPLE = 4096
"""Gaussians that are timed."""


@dataclass(frozen=True)
class AveragedConfig:
    """Settings of method "averaged".

    Args:
        top: Codes kept for each Gaussian.
        temperature: Temperature of the softmax over their cosines, without the direction that all features share, in
            multiples of the spread: one minus the mean cosine of a Gaussian with its nearest code. Towards 0 only the
            nearest code counts.
        min_visibility: Gaussians with less weight than this over all training views, in cells of the feature maps,
            count as never seen; where not all views are read, it is estimated from those that are.
        prior_visibility: Weight in cells at which a Gaussian's mean is half trusted; below it u tends to 1.
        shortest_side: Views are rendered at the size of their feature maps, but not below this many pixels on the
            short side, and reduced by at most 4.
        dino: Average DINO features, too, and compare Gaussians with codes by both halves (Eq. 4). By default a build
            does so where CLIP is read at class tokens only (`FeatureConfig.crop_tokens`), which gain by it.
        segments: Find segments (`lexsplat.language.segments`), by which questions are answered; without them,
            Gaussians answer one by one.
        gate: Share of a view's summed weight whose Gaussians take its features, the heaviest first (a Gaussian that
            never is among them keeps its mean over all views). 1 takes all.
        least_weight: Gaussians whose weight in a single cell of a feature map stays below this in all views count as
            never seen, in 0..1.
        squared: Square the weights of the mean.
        agreement: Weigh each feature by exp(agreement (cos - 1)), where cos compares it with the Gaussian's mean over
            the views, in a second pass over them; in 0..30. 0 takes the mean of the first.
        sightings: Views are read until every Gaussian is shown once and 95 % of so many sightings of all are there,
            or of those that all views give (`lexsplat.language.methods.sightings`). 0 reads all views. By default a
            build takes 8, and 4 with the bundled encoders.
        reliability: Derive u from the length of the mean. Without, u is 0 for all that the views show, and views that
            disagree are not reported.
    """

    top: int = 4
    temperature: float = 1.9
    min_visibility: float = 0.01
    prior_visibility: float = 0.25
    shortest_side: int = 120
    dino: bool | None = None
    segments: bool = True
    gate: float = 1.0
    least_weight: float = 0.0
    squared: bool = False
    agreement: float = 0.0
    sightings: int | None = None
    reliability: bool = True

    def __post_init__(self) -> None:
        if self.top < 1 or self.shortest_side < 1:
            raise ValueError("top and shortest_side must be positive")
        if not self.temperature > 0:
            raise ValueError(f"temperature must be positive, got {self.temperature:g}")
        if self.min_visibility < 0 or self.prior_visibility < 0:
            raise ValueError("min_visibility and prior_visibility must not be negative")
        if not 0 < self.gate <= 1 or not 0 <= self.least_weight <= 1:
            raise ValueError("gate and least_weight are shares: above 0 and from 0, at most 1")
        if self.sightings is not None and self.sightings < 0:
            raise ValueError(f"sightings must not be negative, got {self.sightings}")
        if not 0 <= self.agreement <= 30:  # beyond, weights vanish in float32
            raise ValueError(f"agreement must be in 0..30, got {self.agreement:g}")

    @property
    def weighs_entries(self) -> bool:
        """Whether `lexsplat.language.methods.lifting` changes the weights alpha T, or needs each of them."""
        return self.gate < 1 or self.least_weight > 0 or self.squared or self.agreement > 0


class Averaged:
    """The method as an object (`lexsplat.language.methods.LanguageMethod`)."""

    name = "averaged"
    settings = ("codebook", "averaged")
    needs = ("features",)
    stages = ("reconstruct", *needs, "language")
    variants: Mapping[str, Variant] = {
        "one code": {"averaged": {"top": 1}},
        "w/o DINO": {"averaged": {"dino": False}},
        "with DINO": {"averaged": {"dino": True}},
        "gate": {"averaged": {"gate": 0.5}},
        "least weight": {"averaged": {"least_weight": 0.02}},
        "squared weights": {"averaged": {"squared": True}},
        "agreement": {"averaged": {"agreement": 5.0}},
        "w/o reliability": {"averaged": {"reliability": False}},
        "all views": {"averaged": {"sightings": 0}},
        "all liftings": {"averaged": {"gate": 0.5, "least_weight": 0.02, "squared": True, "agreement": 5.0}},
        "full": {},
    }

    def uses_dino(self, config: Any) -> bool:
        """Whether it is requested, or resolved to be used with class tokens."""
        return bool(config.averaged.dino)

    def feature_inputs(self, config: Any) -> list[Any]:
        """The Gaussians, if they decide which views are read."""
        return ["reconstruct", config.averaged.sightings] if config.averaged.sightings else []

    def views_to_read(
        self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun
    ) -> TrainingViews:
        """As few as show each Gaussian often enough."""
        if views.shares is not None or not config.averaged.sightings:
            return views
        names, shares = views_that_show(gaussians, views.views, config.averaged.sightings, run)
        return replace(views, views={name: views.views[name] for name in names}, shares=shares)

    def fit(self, gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> CodeField:
        """The features of the views to read on each Gaussian, then codes for them."""
        views = self.views_to_read(gaussians, views, config, run)
        if len(views.views) >= _TOLD_FROM and not run.workers.distributed:
            amount = f"{len(views.views):,} views and {len(gaussians):,} Gaussians"
            tell("language", _forecast(gaussians, views, config, run), amount)
        found = _means(gaussians, views, views.cameras, config, run)
        if views.shares is not None:
            # Visibility is measured over all training views, so their weights are estimated from those that are read.
            found = replace(found, totals=found.totals / views.shares.to(found.totals.device))
        field = _with_language(gaussians, found, config.codebook, config.averaged, run)
        if config.averaged.reliability:
            _doubt_features(field, found.totals * found.visible(config.averaged))
        return field


def _means(
    gaussians: Gaussians, views: TrainingViews, cameras: Mapping[str, Camera], config: Any, run: FitRun
) -> MeanFeatures:
    """The features of some of the training views on each Gaussian."""

    def valid(name: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        return views.views[name].load_valid(size)

    return average_features(
        gaussians,
        cameras,
        views.require_features(),
        config.averaged,
        valid=valid,
        memory=run.memory,
        scratch=run.scratch,
        workers=run.workers,
        listener=run.listener,
    )


def _with_language(
    gaussians: Gaussians, found: MeanFeatures, codebook: CodebookConfig, config: AveragedConfig, run: FitRun
) -> CodeField:
    """The field of Gaussians whose features are known."""
    field = field_from_means(found, codebook, config, seed=run.seed, memory=run.memory, listener=run.listener)
    if config.segments:
        shown = found.totals * found.visible(config)  # selections ignore Gaussians without mass
        with one_thread():
            field.segments = make_segments(gaussians, found.rows, shown, run.listener)
    return field


def _doubt_features(field: CodeField, shown: Tensor) -> None:
    """Warn if the views disagree about what they show; ``shown [N]`` is the weight of each Gaussian in them."""
    agreement = float(((1 - field.uncertainties) * shown).sum() / shown.sum().clamp_min(1e-12))
    if agreement < AGREEING:
        log.warning(
            "the photos disagree about the language of what they show (agreement %.2f, usually over %.2f): "
            "answers may be wrong; the encoder may not know such things, the steps may be too few, or cameras or "
            "features may be those of other photos",
            agreement,
            AGREEING,
        )


def _forecast(gaussians: Gaussians, views: TrainingViews, config: Any, run: FitRun) -> float:
    """Seconds that the method will take, measured on a few views and on a sample of the Gaussians that they show.

    The first of two runs of each part is not timed: it loads kernels.
    """
    count, listener = len(gaussians), run.listener
    run = replace(run, listener=silent)
    listener(Event("calibrate", 0, 4))
    first, *others = evenly(sorted(views.cameras.items()), 1 + _VIEWS)
    _means(gaussians, views, dict([first]), config, run)
    listener(Event("calibrate", 1, 4))
    start = time.perf_counter()
    found = _means(gaussians, views, dict(others), config, run)
    averaging = (time.perf_counter() - start) / len(others) * len(views.views)
    shown = found.visible(config.averaged).nonzero()[:, 0].cpu()
    chosen = torch.tensor(evenly(shown.tolist(), _SAMPLE), dtype=torch.int64)
    if not len(chosen):
        listener(Event("calibrate", 4, 4))
        return averaging
    totals = found.totals[chosen.to(found.totals.device)]
    part = replace(found, means=found.means[chosen.numpy()], totals=totals)
    share = len(chosen) / count
    codebook = replace(config.codebook, sample_size=max(1, round(config.codebook.sample_size * share)))
    sample = gaussians.select(chosen.to(gaussians.device))
    seconds = 0.0
    for done in (2, 3):
        listener(Event("calibrate", done, 4))
        start = time.perf_counter()
        _with_language(sample, part, codebook, config.averaged, run)
        seconds = time.perf_counter() - start
    listener(Event("calibrate", 4, 4))
    return averaging + seconds / share


def features_of_codes(code_maps: Mapping[str, NDArray[np.integer]], codebook: Codebook) -> FeatureMaps:
    """Index maps as feature maps: the CLIP half of each cell's code.

    Args:
        code_maps: Index maps ``[h, w]`` by view name; an index outside the codebook gives a zero feature.
        codebook: The discrete feature space S.
    """
    codewords = functional.pad(codebook.clip.cpu(), (0, 0, 0, 1))

    def load(name: str) -> FeatureMap:
        codes = torch.as_tensor(np.asarray(code_maps[name])).long()
        known = (codes >= 0) & (codes < codebook.num_codes)
        return FeatureMap(codewords[torch.where(known, codes, codebook.num_codes)])

    return FeatureMaps(list(code_maps), load, cache_bytes=0)


def field_from_means(
    found: MeanFeatures,
    codebook_config: CodebookConfig,
    config: AveragedConfig,
    *,
    seed: int = 0,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> CodeField:
    """Fit a codebook to the Gaussians and give each a distribution over its nearest codes.

    Args:
        found: Means of all Gaussians.
        codebook_config: K, k-means iterations, sample size, and the weight of the DINO half if there is one; the
            settings of gradient steps are not used.
        config: Settings.
        seed: Seed of the sample and of the start of k-means.
        memory: Host memory in bytes, half of which the sample and k-means may take; the rest is for means and maps.
        listener: Receives events of stage "clusters".

    Raises:
        MemoryBudgetError: If the sample does not fit.
    """
    levels, found = found.levels, found.apart()
    device, (count, dimensions) = found.totals.device, found.means.shape
    looked_at = min(codebook_config.sample_size, count)
    what, number = f"a sample of {looked_at:,} Gaussians", codebook_config.num_codes
    budget.require_sample("language", what, looked_at, dimensions, number, 0, memory, share=0.5)
    visible, lambda_dino = found.visible(config), codebook_config.lambda_dino
    with one_thread():  # the order of a sum decides its last bit, which can decide between two codes
        codewords, centers, common, spread = _fit(found, visible, codebook_config, seed, listener)
        shared = float(common[0].square().sum().clamp(max=1 - 1e-6))
        kept = min(config.top, len(codewords))
        codes = torch.zeros(count, kept, dtype=torch.uint8, device=device)
        weights = torch.zeros(count, kept, device=device)
        agreement = torch.zeros(count, device=device)
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            halves = found.halves(rows)
            cosines, nearest = (_joined(_own(halves, common), lambda_dino) @ centers.T).topk(kept, dim=1)
            codes[rows] = nearest.to(torch.uint8)
            weights[rows] = torch.softmax(cosines / (config.temperature * spread), 1) * visible[rows, None]
            agreement[rows] = ((halves[0].square().sum(-1) - shared) / (1 - shared)).clamp(0, 1)
    trusted = found.totals / (found.totals + config.prior_visibility).clamp_min(1e-12)
    certain = agreement * trusted if config.reliability else torch.ones_like(trusted)
    uncertainties = torch.where(visible, 1 - certain, torch.ones_like(trusted))
    return CodeField(
        Codebook(codewords),
        codes.reshape(-1, levels * kept),
        weights.reshape(-1, levels * kept) / levels,
        uncertainties.reshape(-1, levels).mean(1),
        num_levels=levels,
    )


def _fit(
    found: MeanFeatures, visible: Tensor, config: CodebookConfig, seed: int, listener: Listener
) -> tuple[Tensor, Tensor, list[Tensor], float]:
    """Spherical k-means over the visible Gaussians, without the direction that all features share.

    Features of an encoder lie in a cone. Cosines inside it depend on its width, those of what is left without its
    axis do not. How far features lie from their codes then still depends on the encoder, the scene and K: the spread.

    Returns:
        Unit CLIP codewords ``[K, Dc]``, at most one a Gaussian; their centers without the shared directions
        ``[K, Dc + Dd]``, each half of unit length; those directions, the means of the Gaussians' unit features, one
        for each half; the spread, the mean distance of a feature from its code in similarity, above 0.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = visible.nonzero()[:, 0].cpu()
    if len(seen) == 0:
        halves = [torch.ones_like(half) / half.shape[1] ** 0.5 for half in found.halves(slice(0, 1))]
        return halves[0], torch.cat(halves, 1), [torch.zeros_like(half[0]) for half in halves], 1.0
    if len(seen) > config.sample_size:
        seen = seen[torch.randperm(len(seen), generator=generator)[: config.sample_size].sort().values]
    sample = [functional.normalize(half, dim=-1) for half in found.halves(seen)]
    common = [half.mean(0) for half in sample]
    own = _own(sample, common)
    number = min(config.num_codes, len(seen))
    clip, dino = spherical_kmeans(
        own[0],
        own[1] if found.dino else None,
        number,
        config.lambda_dino,
        iterations=config.kmeans_iterations,
        generator=generator,
        listener=listener,
    )
    centers = clip if dino is None else torch.cat([clip, dino], 1)
    similarities, nearest = (_joined(own, config.lambda_dino) @ centers.T).max(1)
    spread = max(1.0 + (config.lambda_dino if found.dino else 0.0) - float(similarities.mean()), 1e-6)
    sums = torch.zeros_like(clip).index_add_(0, nearest, sample[0])
    empty = ~sums.any(-1, keepdim=True)
    return functional.normalize(torch.where(empty, common[0] + clip, sums), dim=-1), centers, common, spread


def _own(halves: Sequence[Tensor], common: Sequence[Tensor]) -> list[Tensor]:
    """Unit features without the direction that all share, of CLIP and of DINO."""
    units = (functional.normalize(half, dim=-1) for half in halves)
    return [functional.normalize(unit - shared, dim=-1) for unit, shared in zip(units, common)]


def _joined(halves: Sequence[Tensor], lambda_dino: float) -> Tensor:
    """Both halves in a row, so that the product with a code is the similarity of Eq. 4."""
    return halves[0] if len(halves) == 1 else torch.cat([halves[0], lambda_dino * halves[1]], dim=-1)
