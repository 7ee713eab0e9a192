"""Lifting: language on the Gaussians in one pass over the views, computed instead of trained.

Geometry is frozen for language, so what a pixel shows is linear in what the Gaussians carry. The weight alpha
T with which Gaussian n enters a pixel is therefore also its share in that pixel's code, and the sum of these
shares over all training views is a histogram over codes for each Gaussian. From it follow, in closed form,
the code distribution, the uncertainty (where views disagree, the histogram is flat) and what was never seen.

`tune` goes on to the paper's field: s_G and the decoder are fitted to the distributions without rendering,
then trained as in the paper for a few hundred steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import check_views, codes_at_pixels
from lexsplat.language.fields import SEMANTIC_CHANNELS, LiftedField, TrainedField
from lexsplat.language.methods.trained import train_field
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.rendering import accumulate_codes
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.runtime.training import Checkpoint

ROWS = 65_536
"""Gaussians handled at a time outside rendering."""


@dataclass(frozen=True)
class LiftedConfig:
    """Settings of the lifting.

    Args:
        top: Codes kept for each Gaussian; `CodeHistogram.dropped` tells what that costs.
        min_visibility: A Gaussian with less weight than this over all training views, in pixels, counts as
            never seen.
        prior_visibility: Weight in pixels at which the histogram is half believed; below it u tends to 1.
        use_smoothing: Mix the distributions of neighbors in, in the spirit of Eq. 14. Off by default: it changed
            nothing for the better where every surface is seen; it also fills in what no training view shows.
        neighbors: How many.
        min_smoothing_weight: w_s of Eq. 14.
        memory_bytes: Bound for the dense histogram; beyond it the views are passed over several times, for a
            range of codes each.
    """

    top: int = 4
    min_visibility: float = 0.01
    prior_visibility: float = 1.0
    use_smoothing: bool = False
    neighbors: int = 8
    min_smoothing_weight: float = 0.1
    memory_bytes: int = 1 << 30

    def __post_init__(self) -> None:
        if self.top < 1 or self.neighbors < 1 or self.memory_bytes < 1:
            raise ValueError("top, neighbors and memory_bytes must be positive")
        if self.min_visibility < 0 or self.prior_visibility < 0 or self.min_smoothing_weight < 0:
            raise ValueError("min_visibility, prior_visibility and min_smoothing_weight must not be negative")


@dataclass(frozen=True)
class CodeHistogram:
    """Which codes the training views show where a Gaussian is, weighted by how much of the pixel it is.

    Args:
        codes: The heaviest codes ``[N, T]`` uint8, heaviest first; code 0 with weight 0 fills up.
        weights: Their weights in pixels ``[N, T]``.
        totals: Weight over all codes ``[N]``, in pixels.
        entropies: Entropy of the whole distribution ``[N]`` in nats (0 where the total is 0).
        num_codes: K.
    """

    codes: Tensor
    weights: Tensor
    totals: Tensor
    entropies: Tensor
    num_codes: int

    @property
    def dropped(self) -> float:
        """Share of all weight that lies outside the kept codes: the error of the sparsity, 0 to 1."""
        return float(1 - self.weights.sum().double() / self.totals.sum().double().clamp_min(1e-12))

    def uncertainties(self, config: LiftedConfig) -> Tensor:
        """u ``[N]`` in 0..1: normalized entropy, believed as far as the Gaussian was seen.

        u = 1 - (1 - H / log K) v with v = W / (W + W_0); what was never seen has u = 1.
        """
        normalized = self.entropies / math.log(max(self.num_codes, 2))
        seen = self.totals / (self.totals + config.prior_visibility).clamp_min(1e-12)
        uncertainties = (1 - (1 - normalized) * seen).clamp(0, 1)
        return torch.where(self.visible(config), uncertainties, torch.ones_like(uncertainties))

    def visible(self, config: LiftedConfig) -> Tensor:
        """Which Gaussians the training views have seen ``[N]`` bool."""
        return (self.totals >= config.min_visibility) & (self.totals > 0)


def accumulate_histogram(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    code_maps: Mapping[str, NDArray[np.uint8]],
    num_codes: int,
    config: LiftedConfig,
    *,
    listener: Listener = silent,
) -> CodeHistogram:
    """Sum alpha T per Gaussian and code over the training views.

    Args:
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        code_maps: Index maps by view name, possibly coarser than the views; indices of K and above are
            ignored.
        num_codes: K.
        config: Settings.
        listener: Hears of stage "lift", and at its end of ``dropped``, what keeping few codes leaves out.

    Raises:
        ValueError: If there is no view, or a view has no index map.
    """
    names = sorted(cameras)
    check_views(names, code_maps)
    gaussians, count = gaussians.detach(), len(gaussians)
    ranges = list(_code_ranges(num_codes, count, config.memory_bytes))
    steps = len(ranges) * len(names)
    found: list[tuple[Tensor, Tensor]] = []
    totals = torch.zeros(count, device=gaussians.device)
    sum_wlogw = torch.zeros(count, device=gaussians.device, dtype=torch.float64)
    for part, codes in enumerate(ranges):
        dense = torch.zeros(count, len(codes), device=gaussians.device)
        for done, name in enumerate(names, start=1):
            camera = cameras[name]
            code_map = _full_size(code_maps[name], camera) - codes.start
            code_map[(code_map < 0) | (code_map >= len(codes))] = -1
            accumulate_codes(gaussians, camera, code_map, len(codes), out=dense)
            if part * len(names) + done < steps:
                listener(Event("lift", part * len(names) + done, steps))
        totals += dense.sum(1)
        for rows in _row_ranges(count):
            sum_wlogw[rows] += torch.special.xlogy(dense[rows], dense[rows]).double().sum(1)
        found.append(_top(dense, codes.start, config.top))
        found = [_merge(found, config.top)]
    kept_codes, kept_weights = found[0]
    entropies = (totals.clamp_min(1e-30).log() - sum_wlogw / totals.clamp_min(1e-30)).clamp_min(0).float()
    entropies = torch.where(totals > 0, entropies, torch.zeros_like(entropies))
    histogram = CodeHistogram(kept_codes.to(torch.uint8), kept_weights, totals, entropies, num_codes)
    listener(Event("lift", steps, steps, {"dropped": histogram.dropped}))
    return histogram


def lift(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    code_maps: Mapping[str, NDArray[np.uint8]],
    codebook: Codebook,
    config: LiftedConfig,
    *,
    listener: Listener = silent,
) -> LiftedField:
    """Language on the Gaussians in one pass over the views; arguments as in `accumulate_histogram`."""
    histogram = accumulate_histogram(
        gaussians, cameras, code_maps, codebook.num_codes, config, listener=listener
    )
    return field_from_histogram(gaussians, histogram, codebook, config)


def field_from_histogram(
    gaussians: Gaussians, histogram: CodeHistogram, codebook: Codebook, config: LiftedConfig
) -> LiftedField:
    """Distributions from a histogram: visibility gate, smoothing if set, normalized over the kept codes."""
    visible = histogram.visible(config)
    uncertainties = histogram.uncertainties(config)
    weights = histogram.weights / histogram.weights.sum(1, keepdim=True).clamp_min(1e-30)
    weights = torch.where(visible[:, None], weights, torch.zeros_like(weights))
    codes = histogram.codes
    if config.use_smoothing and len(gaussians) > 1:
        codes, weights = smooth_codes(
            gaussians.means, codes, weights, uncertainties, visible, histogram.num_codes, config
        )
    return LiftedField(codebook, codes, weights, uncertainties, dropped=histogram.dropped)


def smooth_codes(
    means: Tensor,
    codes: Tensor,
    weights: Tensor,
    uncertainties: Tensor,
    visible: Tensor,
    num_codes: int,
    config: LiftedConfig,
) -> tuple[Tensor, Tensor]:
    """Mix neighbors in, the counterpart of Eq. 10 and 14 for distributions.

    Minimizing (1 - u) |q - p|^2 + max(u, w_s) |q - m|^2, with p the Gaussian's own distribution and m the
    mean of its neighbors in space weighted by 1 - u_j, gives q = ((1 - u) p + max(u, w_s) m) / (1 - u +
    max(u, w_s)): a certain Gaussian keeps to itself, an uncertain one follows its neighbors, one that was
    never seen is filled in by them.

    Args:
        means: Centers ``[N, 3]``.
        codes: ``[N, T]`` uint8.
        weights: ``[N, T]``, rows sum to 1, or 0 where not visible.
        uncertainties: ``[N]``.
        visible: ``[N]`` bool; only these are neighbors.
        num_codes: K.
        config: Settings.

    Returns:
        Codes ``[N, T]`` uint8 and weights ``[N, T]``, rows normalized again.
    """
    sources = visible.nonzero()[:, 0]
    if len(sources) == 0:
        return codes, weights
    points = means.detach().cpu().numpy()
    tree = cKDTree(points[sources.cpu().numpy()])
    near = min(config.neighbors + 1, len(sources))
    pull = uncertainties.clamp(min=config.min_smoothing_weight)
    share = pull / (1 - uncertainties + pull).clamp_min(1e-12)
    new_codes, new_weights = torch.zeros_like(codes), torch.zeros_like(weights)
    for rows in _row_ranges(len(points)):
        _, local = tree.query(points[rows], k=near, workers=-1)
        neighbors = sources[torch.as_tensor(local.reshape(-1, near), device=means.device)]
        trust = (1 - uncertainties)[neighbors]
        own = torch.arange(rows.start, rows.stop, device=means.device)
        trust = torch.where(neighbors == own[:, None], torch.zeros_like(trust), trust)
        trust = trust / trust.sum(1, keepdim=True).clamp_min(1e-12)
        mixed = weights.new_zeros(len(own), num_codes)
        mixed.scatter_add_(1, codes[rows].long(), (1 - share[rows])[:, None] * weights[rows])
        for column in range(near):
            index, portion = neighbors[:, column], (share[rows] * trust[:, column])[:, None]
            mixed.scatter_add_(1, codes[index].long(), portion * weights[index])
        top = mixed.topk(codes.shape[1], dim=1)
        new_codes[rows] = top.indices.to(torch.uint8)
        new_weights[rows] = top.values / top.values.sum(1, keepdim=True).clamp_min(1e-30)
    return new_codes, new_weights


@dataclass(frozen=True)
class TuningConfig:
    """Settings of `tune`.

    Args:
        fit_steps: Steps that fit s_G and the decoder to the distributions, without rendering.
        batch_size: Gaussians of such a step, drawn in proportion to 1 - u (certain and well seen).
        fit_lr: Learning rate of s_G and the decoder in these steps; the smoothing MLP has a tenth of it.
        iterations: Rendered steps afterwards; what is not set here is set by `TrainedConfig`.
        semantics_lr: Learning rate of s_G in the rendered steps, which start close to the goal.
    """

    fit_steps: int = 300
    batch_size: int = 2048
    fit_lr: float = 0.02
    iterations: int = 200
    semantics_lr: float = 0.01

    def __post_init__(self) -> None:
        if self.fit_steps < 0 or self.iterations < 0 or self.batch_size < 1:
            raise ValueError("fit_steps and iterations must not be negative, batch_size must be positive")


def tune(
    lifted: LiftedField,
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    code_maps: Mapping[str, NDArray[np.uint8]],
    config: TuningConfig,
    embedding: TrainedConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    listener: Listener = silent,
) -> TrainedField:
    """From a lifted field to the paper's form, "lifted+tuned".

    Args:
        lifted: The start.
        gaussians: The geometry.
        cameras: The training views by name, and only these.
        code_maps: Index maps by view name.
        config: Settings of the fit.
        embedding: Settings of the rendered steps, but for what `TuningConfig` sets.
        seed: Of the decoder's start and of all samples.
        checkpoint: Where the rendered steps are saved on the way, and go on from.
        listener: Hears of stages "fit" and "language".
    """
    generator = torch.Generator().manual_seed(seed)
    field = TrainedField.initial(
        gaussians,
        lifted.codebook,
        generator=generator,
        num_frequencies=embedding.num_frequencies,
        normalize_rendering=embedding.normalize_rendering,
    )
    field.method = "lifted+tuned"
    with torch.no_grad():
        field.semantics.copy_(principal_semantics(lifted))
        field.uncertainty_logits.copy_(lifted.uncertainties.clamp(0.01, 0.9).logit())
    fit_semantics(field, lifted, gaussians, config, generator=generator, listener=listener)
    rendered = replace(embedding, iterations=config.iterations, semantics_lr=config.semantics_lr)
    trainer = FieldTrainer(gaussians, lifted.codebook, rendered, seed=seed, field=field)
    return train_field(
        gaussians,
        cameras,
        code_maps,
        lifted.codebook,
        rendered,
        seed=seed,
        listener=listener,
        trainer=trainer,
        checkpoint=checkpoint,
    )


@torch.no_grad()
def principal_semantics(lifted: LiftedField) -> Tensor:
    """A start for s_G ``[N, 8]``: expected code features on their eight main axes, scaled to unit variance.

    Like meanings start close together, which N(0, 1) does not give.
    """
    codebook = lifted.codebook
    features = codebook.clip
    if codebook.dino is not None:
        features = torch.cat([features, codebook.lambda_dino**0.5 * codebook.dino], dim=1)
    usage = features.new_zeros(codebook.num_codes)
    for rows in torch.arange(len(lifted.codes), device=lifted.codes.device).split(ROWS):
        usage += lifted.select(rows).code_probabilities().sum(0)
    share = usage / usage.sum().clamp_min(1e-12)
    centered = (features - share @ features) * share.sqrt()[:, None]
    axes = torch.linalg.svd(centered.double(), full_matrices=False).Vh[:SEMANTIC_CHANNELS].float()
    projected = (features - share @ features) @ axes.T
    spread = (share @ projected.square()).sqrt().clamp_min(1e-6)
    coordinates = functional.pad(projected / spread, (0, SEMANTIC_CHANNELS - projected.shape[1]))
    return lifted.scores(coordinates)


def fit_semantics(
    field: TrainedField,
    lifted: LiftedField,
    gaussians: Gaussians,
    config: TuningConfig,
    *,
    generator: torch.Generator,
    listener: Listener = silent,
) -> None:
    """Fit s_G, the decoder and the smoothing MLP of a field, in place, to a lifted field; nothing is
    rendered.

    The loss is the cross-entropy between the lifted distribution of a Gaussian and softmax(D_MLP(s_G)), which
    is Eq. 9 with soft labels, plus the first term of Eq. 14, so that smoothing does not start from a random
    MLP.
    """
    known = (lifted.weights.sum(1) > 0).nonzero()[:, 0]
    if len(known) == 0 or config.fit_steps == 0:
        return
    optimizer = torch.optim.Adam(
        [
            {"params": [field.semantics, *field.decoder.parameters()], "base_lr": config.fit_lr},
            {"params": list(field.smoother.parameters()), "base_lr": 0.1 * config.fit_lr},
        ]
    )
    cumulative = (1 - lifted.uncertainties[known]).clamp_min(0.05).double().cpu().cumsum(0)
    for step in range(config.fit_steps):
        draws = torch.rand(config.batch_size, generator=generator, dtype=torch.float64) * cumulative[-1]
        rows = known[torch.searchsorted(cumulative, draws).clamp_max(len(known) - 1).to(known.device)]
        for group in optimizer.param_groups:
            group["lr"] = group["base_lr"] * 0.1 ** (step / config.fit_steps)
        semantics = field.semantics.index_select(0, rows)  # rows repeat; see `embedding`
        log_p = field.decode(semantics).log_softmax(-1)
        loss = -(lifted.weights[rows] * log_p.gather(1, lifted.codes[rows].long())).sum(1).mean()
        smoothed = field.smoother(gaussians.means[rows])
        loss = loss + torch.linalg.vector_norm(smoothed - semantics.detach(), dim=-1).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if (step + 1) % 50 == 0 or step + 1 == config.fit_steps:
            listener(Event("fit", step + 1, config.fit_steps, {"loss": float(loss.detach())}))


def _full_size(code_map: NDArray[np.uint8], camera: Camera) -> Tensor:
    """An index map at the size of a camera, int32 ``[H, W]``."""
    coarse = torch.as_tensor(np.asarray(code_map))
    if coarse.shape == (camera.height, camera.width):
        return coarse.to(torch.int32)
    pixels = torch.arange(camera.height * camera.width)
    codes = codes_at_pixels(coarse, camera.height, camera.width, pixels)
    return codes.view(camera.height, camera.width).to(torch.int32)


def _code_ranges(num_codes: int, count: int, memory_bytes: int) -> Iterator[range]:
    """Codes in ranges so small that a float32 histogram and one working copy keep to the bound."""
    width = max(1, min(num_codes, memory_bytes // (2 * 4 * max(count, 1))))
    for start in range(0, num_codes, width):
        yield range(start, min(start + width, num_codes))


def _row_ranges(count: int) -> Iterator[slice]:
    for start in range(0, count, ROWS):
        yield slice(start, min(start + ROWS, count))


def _top(dense: Tensor, offset: int, count: int) -> tuple[Tensor, Tensor]:
    """Heaviest columns of every row: indices ``[N, T]`` (int16) and values; ties go to the lower index."""
    values, indices = dense.topk(min(count, dense.shape[1]), dim=1)
    return (indices + offset).to(torch.int16), values


def _merge(found: list[tuple[Tensor, Tensor]], count: int) -> tuple[Tensor, Tensor]:
    """The heaviest of several lists, padded with code 0 of weight 0 up to ``count`` columns."""
    codes = torch.cat([part[0] for part in found], dim=1)
    weights = torch.cat([part[1] for part in found], dim=1)
    values, order = weights.topk(min(count, weights.shape[1]), dim=1)
    codes = codes.gather(1, order)
    codes = torch.where(values > 0, codes, torch.zeros_like(codes))
    missing = count - values.shape[1]
    return functional.pad(codes, (0, missing)), functional.pad(values, (0, missing))
