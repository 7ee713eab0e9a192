"""Fitting the codes: a bounded sample of features, a k-means start, then gradient steps on Eq. 7.

The fit runs on one thread, so the same seed gives bit-identical codes on any number of cores.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from lexsplat.codebook.losses import quantization_loss
from lexsplat.codebook.settings import CodebookConfig
from lexsplat.codebook.space import BLOCK_ROWS, Codebook
from lexsplat.runtime import memory as budget
from lexsplat.runtime.adam import AdamW
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.features import FeatureMap

_SMALL_BLOCK = 1024
"""Features handled at a time if several copies of them are held."""
_SLACK, _ROUNDING = 1 - 1e-5, 1e-5
"""Of squared distances that are compared: single precision."""


@one_thread()
def fit_codebook(
    feature_maps: Mapping[str, FeatureMap],
    names: Sequence[str],
    config: CodebookConfig,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> Codebook:
    """Fit the discrete feature space S by Eq. 7 to a bounded sample of the named views.

    Both halves of every code are normalized: only their directions enter Eq. 4 and 5.

    Args:
        feature_maps: Dense features by view name; only those of `names` are read, one at a time.
        names: Training views.
        config: Settings.
        seed: Seed of the sample, the start and the batches.
        device: Device of the fit and of the codebook.
        memory: Host memory in bytes, three quarters of which the sample and the fit may take; the rest is for maps.
        listener: Receives events of stage "codebook"; the last has the mean CLIP cosine between features and codes.

    Raises:
        ValueError: If `names` is empty, or a feature is NaN or infinite.
        TrainingError: If the loss becomes NaN or infinite.
        MemoryBudgetError: If the sample does not fit into ``memory``.
    """
    if not names:
        raise ValueError("a codebook needs at least one training view")
    generator = torch.Generator(device="cpu").manual_seed(seed)
    total = config.steps + 1
    listener(Event("codebook", 0, total))
    check_sample(feature_maps[names[0]], len(names), config, memory)
    clip, dino = sample_features(feature_maps, names, config, generator=generator)
    clip, dino = clip.to(device), None if dino is None else dino.to(device)
    lambda_dino = config.lambda_dino
    if config.init == "kmeans":
        code_clip, code_dino = spherical_kmeans(
            clip,
            dino,
            config.num_codes,
            lambda_dino,
            iterations=config.kmeans_iterations,
            generator=generator,
            listener=listener,
        )
    else:
        code_clip = _uniform_codes(clip, config.num_codes, generator)
        code_dino = None if dino is None else _uniform_codes(dino, config.num_codes, generator)
    listener(Event("codebook", 1, total))
    code_clip, code_dino = refine(clip, dino, code_clip, code_dino, config, generator, listener)
    codebook = Codebook(
        functional.normalize(code_clip, dim=-1),
        None if code_dino is None else functional.normalize(code_dino, dim=-1),
        lambda_dino,
    )
    listener(Event("codebook", total, total, {"cosine": mean_cosine(codebook, clip, dino)}))
    return codebook


@torch.no_grad()
def mean_cosine(codebook: Codebook, clip: Tensor, dino: Tensor | None) -> float:
    """Mean CLIP cosine between features ``[M, Dc]`` and the codes they are assigned to."""
    kept = 0.0
    for start in range(0, len(clip), _SMALL_BLOCK):
        rows = slice(start, start + _SMALL_BLOCK)
        chosen = codebook.similarity(clip[rows], None if dino is None else dino[rows]).argmax(-1)
        kept += float(functional.cosine_similarity(clip[rows], codebook.clip[chosen], dim=-1).sum())
    return kept / len(clip)


def sample_features(
    feature_maps: Mapping[str, FeatureMap],
    names: Sequence[str],
    config: CodebookConfig,
    *,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor | None]:
    """At most ``config.sample_size`` unit features, equally many from each of the named views.

    Returns:
        CLIP parts ``[M, Dc]``, and DINO parts ``[M, Dd]`` or None. Features that are zero are left out.

    Raises:
        ValueError: If a feature is NaN or infinite, or all are zero.
    """
    quota = -(-config.sample_size // len(names))
    clips, dinos = _Rows(quota, len(names)), _Rows(quota, len(names))
    for name in names:
        feature_map = feature_maps[name]
        clip = torch.as_tensor(feature_map.clip).flatten(0, 1)
        rows = torch.randperm(len(clip), generator=generator)[:quota]
        finite = clips.add(clip[rows])
        if config.use_dino and feature_map.dino is not None:
            finite = dinos.add(torch.as_tensor(feature_map.dino).flatten(0, 1)[rows]) and finite
        if not finite:
            raise ValueError(f"features of {name}: NaN or infinity")
    if dinos.count not in (0, clips.count):
        raise ValueError("some views have DINO features and some have none")
    keep = (clips.rows().norm(dim=-1) > 0).nonzero()[:, 0]
    if len(keep) == 0:
        raise ValueError("all features of the training views are zero")
    if len(keep) > config.sample_size:
        keep = keep[torch.randperm(len(keep), generator=generator)[: config.sample_size]]
    return clips.take(keep), dinos.take(keep) if dinos.count else None


class _Rows:
    """Vectors collected part by part in one store; concatenating the parts would take twice the memory."""

    def __init__(self, quota: int, views: int) -> None:
        self._most, self._views = quota * views, views
        self._store, self.count = torch.empty(0, 0), 0

    def add(self, part: Tensor) -> bool:
        """Append rows ``[n, D]``; returns whether all are finite."""
        if not self.count:
            self._store = torch.empty(min(self._most, self._views * len(part)), part.shape[1])
        if self.count + len(part) > len(self._store):  # maps of several sizes
            larger = torch.empty(self._most, part.shape[1])
            larger[: self.count] = self.rows()
            self._store = larger
        self._store[self.count : self.count + len(part)] = part
        self.count += len(part)
        return bool(torch.isfinite(part).all())

    def rows(self) -> Tensor:
        """All rows so far ``[count, D]``."""
        return self._store[: self.count]

    def take(self, keep: Tensor) -> Tensor:
        """The normalized rows ``keep``; frees the store."""
        whole = len(keep) == self.count and bool((keep.diff() == 1).all())
        kept = self.rows() if whole else self.rows()[keep]
        self._store = torch.empty(0, 0)
        return kept.div_(kept.norm(dim=-1, keepdim=True).clamp_min(1e-12))


def check_sample(first: FeatureMap, views: int, config: CodebookConfig, memory: int) -> None:
    """Refuse a sample of ``views`` maps of the size of ``first`` that needs more than three quarters of the memory.

    Raises:
        MemoryBudgetError: With a sample size that fits.
    """
    cells, dimensions = first.clip.shape[0] * first.clip.shape[1], first.clip.shape[-1]
    if config.use_dino and first.dino is not None:
        dimensions += first.dino.shape[-1]
    rows = min(-(-config.sample_size // views), cells) * views
    batch = min(config.batch_size, rows)
    what = f"a sample of {rows:,} features"
    budget.require_sample("codebook", what, rows, dimensions, config.num_codes, batch, memory, share=0.75)


@torch.no_grad()
def spherical_kmeans(
    clip: Tensor,
    dino: Tensor | None,
    num_codes: int,
    lambda_dino: float,
    *,
    iterations: int,
    generator: torch.Generator,
    listener: Listener = silent,
) -> tuple[Tensor, Tensor | None]:
    """k-means for the similarity of Eq. 4, from `_kmeans_seeds`.

    The sum of a cluster's unit vectors, normalized half by half, minimizes Eq. 5 for a given assignment, so every
    iteration lowers L_cos. An empty cluster restarts at the feature with the lowest similarity to its code.

    Returns:
        Codes ``[K, Dc]`` and ``[K, Dd]`` (or None), unit length.
    """
    joint = clip if dino is None else torch.cat([clip, lambda_dino**0.5 * dino], dim=-1)
    split = clip.shape[1]
    listener(Event("clusters", 0, iterations))
    centers = joint[_kmeans_seeds(joint, num_codes, generator)]
    for done in range(iterations):
        if done:
            listener(Event("clusters", done, iterations))
        best, chosen = _nearest(joint, centers)
        sums = torch.zeros_like(centers).index_add_(0, chosen, joint)
        counts = torch.bincount(chosen, minlength=num_codes)
        empty = (counts == 0).nonzero()[:, 0]
        if len(empty):
            worst = best.argsort()[: len(empty)]
            sums[empty[: len(worst)]] = joint[worst]
        halves = [functional.normalize(sums[:, :split], dim=-1)]
        if dino is not None:
            halves.append(lambda_dino**0.5 * functional.normalize(sums[:, split:], dim=-1))
        updated = torch.cat(halves, dim=-1)
        if torch.equal(updated, centers):
            break
        centers = updated
    listener(Event("clusters", iterations, iterations))
    code_dino = None if dino is None else functional.normalize(centers[:, split:], dim=-1)
    return functional.normalize(centers[:, :split], dim=-1), code_dino


def _uniform_codes(features: Tensor, num_codes: int, generator: torch.Generator) -> Tensor:
    """The start of the authors' code: uniform(-1/K, 1/K)."""
    unit = torch.rand(num_codes, features.shape[1], generator=generator) * 2 - 1
    return (unit / num_codes).to(features.device)


def _kmeans_seeds(joint: Tensor, num_codes: int, generator: torch.Generator) -> Tensor:
    """Greedy k-means++ seeds, as in scikit-learn (Arthur and Vassilvitskii 2007, section 4).

    Some features are drawn in proportion to the squared distance to the nearest earlier seed. The next seed is the
    one that lowers the sum of these distances most. With a single draw, a small part such as the handle of a mug had
    no code of its own in one fit of eleven (docs/lab-notes/2026-11-language.md).

    Only those features are compared with the drawn ones that may be nearer to one of them than to their own seed: by
    the triangle inequality, those more than half as far from their seed as that is from the drawn one.
    """
    count, drawn = len(joint), 2 + int(math.log(num_codes))
    seeds = torch.randint(count, (1,), generator=generator).to(joint.device)
    blocks = (joint[i : i + _SMALL_BLOCK] for i in range(0, count, _SMALL_BLOCK))
    norms = torch.cat([block.square().sum(-1) for block in blocks])
    nearest = _squared_distances(joint, norms, torch.arange(count, device=joint.device), seeds)[:, 0]
    owners = torch.zeros(count, dtype=torch.long, device=joint.device)
    for number in range(1, num_codes):
        cumulative = nearest.cumsum(0, dtype=torch.float64)
        draws = torch.rand(drawn, generator=generator, dtype=torch.float64).to(joint.device) * cumulative[-1]
        candidates = torch.searchsorted(cumulative, draws, right=True).clamp_max(count - 1)
        apart = _squared_distances(joint, norms, seeds, candidates).amin(1)
        near = (apart[owners] * _SLACK <= 4 * nearest + _ROUNDING).nonzero()[:, 0]
        squared = _squared_distances(joint, norms, near, candidates)
        best = (nearest[near, None] - squared).clamp_min(0).sum(0, dtype=torch.float64).argmax()
        nearer = squared[:, best] < nearest[near]
        near = near[nearer]
        nearest[near], owners[near] = squared[nearer, best], number
        seeds = torch.cat([seeds, candidates[best, None]])
    return seeds


def _squared_distances(joint: Tensor, norms: Tensor, rows: Tensor, others: Tensor) -> Tensor:
    """Squared distances ``[R, O]`` of some features to some others, from the squared lengths of all."""
    many = len(rows) > len(joint) // 2  # then copies take longer than products
    products = (joint @ joint[others].T)[rows] if many else joint[rows] @ joint[others].T
    return (norms[rows, None] + norms[others] - 2 * products).clamp_min_(0)


def _nearest(joint: Tensor, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Highest similarity and its index for every row, in blocks."""
    parts = [(joint[i : i + BLOCK_ROWS] @ centers.T).max(-1) for i in range(0, len(joint), BLOCK_ROWS)]
    return torch.cat([part.values for part in parts]), torch.cat([part.indices for part in parts])


def refine(
    clip: Tensor,
    dino: Tensor | None,
    code_clip: Tensor,
    code_dino: Tensor | None,
    config: CodebookConfig,
    generator: torch.Generator,
    listener: Listener = silent,
) -> tuple[Tensor, Tensor | None]:
    """Gradient steps on Eq. 7 over batches of the sample."""
    parameters = [
        part.detach().clone().requires_grad_() for part in (code_clip, code_dino) if part is not None
    ]
    optimizer = AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
    for step in range(config.steps):
        rows = torch.randint(len(clip), (min(config.batch_size, len(clip)),), generator=generator)
        rows = rows.to(clip.device)
        codes_dino = parameters[1] if dino is not None else None
        loss = quantization_loss(
            clip[rows], None if dino is None else dino[rows], parameters[0], codes_dino, config
        )
        if not bool(torch.isfinite(loss)):
            raise TrainingError(
                "codebook",
                expected="a finite loss",
                found=f"{float(loss)} at step {step}",
                remedy="lower learning_rate",
            )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if (step + 1) % 50 == 0:
            listener(Event("codebook", step + 1, config.steps + 1, {"loss": float(loss.detach())}))
    return parameters[0].detach(), parameters[1].detach() if dino is not None else None
