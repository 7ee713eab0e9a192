"""Quantization of language features: Eq. 2 to 7 of the paper and its supplement A.

A scene holds few meanings, so its hybrid features F = F_CLIP (+) F_DINO (Eq. 2) are replaced by the nearest
of K codes (the paper calls this number N). The codebook is fitted first and every view is assigned
afterwards, in one pass with the finished codes. Held-out views take no part in the fit.

Equations 1 to 15 are counted through the main text of the paper; supplement A describes the load-balancing
loss.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lexsplat.errors import TrainingError
from lexsplat.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.features import FeatureMap

MAX_CODES = 256
"""An index map holds one byte a pixel."""

BLOCK_ROWS = 16_384
"""Feature vectors handled at a time, which bounds the memory of a similarity matrix."""


@dataclass(frozen=True)
class CodebookConfig:
    """Settings of the quantization.

    Args:
        num_codes: Size K of the discrete feature space, 1 to 256. The paper uses 128 (bonsai 64, kitchen 32).
        lambda_dino: Weight of the DINO cosine in Eq. 4 and 5.
        lambda_cos: Weight of the cosine loss in Eq. 7.
        lambda_lb: Weight of the load-balancing loss in Eq. 7 (the authors' code has 1).
        use_dino: Off is the paper's ablation "w/o DINO".
        load_balancing: Off is the paper's ablation "w/o L_lb".
        temperature: Of the softmax in supplement A; the paper has 1.
        init: "kmeans" starts from spherical k-means, "uniform" from uniform(-1/K, 1/K) as the authors' code
            does.
        kmeans_iterations: Lloyd iterations of the k-means start.
        steps: Gradient steps on Eq. 7 after the start.
        learning_rate: Of AdamW in these steps.
        weight_decay: Of AdamW in these steps.
        batch_size: Feature vectors per gradient step.
        sample_size: At most so many feature vectors are looked at, spread evenly over the training views.
    """

    num_codes: int = 128
    lambda_dino: float = 0.5
    lambda_cos: float = 1.0
    lambda_lb: float = 0.5
    use_dino: bool = True
    load_balancing: bool = True
    temperature: float = 1.0
    init: Literal["kmeans", "uniform"] = "kmeans"
    kmeans_iterations: int = 20
    steps: int = 100
    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    batch_size: int = 4096
    sample_size: int = 50_000

    def __post_init__(self) -> None:
        if not 1 <= self.num_codes <= MAX_CODES:
            raise ValueError(
                f"num_codes must be 1 to {MAX_CODES} because an index map holds one byte a pixel, "
                f"got {self.num_codes}"
            )
        if self.init not in ("kmeans", "uniform"):
            raise ValueError(f'init must be "kmeans" or "uniform", got {self.init!r}')
        if self.temperature <= 0:
            raise ValueError(f"temperature must be positive, got {self.temperature:g}")
        if self.sample_size < 1 or self.batch_size < 1 or self.steps < 0 or self.kmeans_iterations < 0:
            raise ValueError(
                "sample_size and batch_size must be positive, steps and kmeans_iterations not negative"
            )

    def as_in_paper(self) -> CodebookConfig:
        """The same weights with the fit of the paper: gradient steps on Eq. 7 from a random start."""
        return replace(
            self, init="uniform", steps=2000, learning_rate=1e-4, weight_decay=0.01, batch_size=16_384
        )


def similarity(
    clip: Tensor, dino: Tensor | None, code_clip: Tensor, code_dino: Tensor | None, lambda_dino: float
) -> Tensor:
    """Eq. 4: D(F, f_i) = cos<F_CLIP, f_i_CLIP> + lambda_DINO cos<F_DINO, f_i_DINO>.

    Args:
        clip: CLIP parts of M features ``[M, Dc]``; any length, zero vectors have cosine 0.
        dino: DINO parts ``[M, Dd]``, or None.
        code_clip: CLIP parts of the codes ``[K, Dc]``.
        code_dino: DINO parts of the codes ``[K, Dd]``, or None to compare by CLIP only.
        lambda_dino: Weight of the DINO cosine.

    Returns:
        Similarities ``[M, K]`` in -(1 + lambda) to 1 + lambda.

    Raises:
        ValueError: If the codes have a DINO part and the features do not.
    """
    scores = functional.normalize(clip, dim=-1) @ functional.normalize(code_clip, dim=-1).T
    if code_dino is None:
        return scores
    if dino is None:
        raise ValueError("the codebook was fitted with DINO features, but the features have none")
    return scores + lambda_dino * (
        functional.normalize(dino, dim=-1) @ functional.normalize(code_dino, dim=-1).T
    )


def quantize(codewords: Tensor, code_indices: Tensor) -> Tensor:
    """Eq. 3: the quantized feature, sum_i f_i onehot(m)_i, which is row m.

    Args:
        codewords: ``[K, D]``.
        code_indices: Integers ``[...]`` in 0 to K - 1.

    Returns:
        ``[..., D]``.
    """
    return codewords[code_indices.long()]


def cosine_loss(
    clip: Tensor,
    dino: Tensor | None,
    quantized_clip: Tensor,
    quantized_dino: Tensor | None,
    lambda_dino: float,
) -> Tensor:
    """Eq. 5: (1 - cos CLIP) + lambda_DINO (1 - cos DINO), averaged over the M features.

    Args:
        clip: ``[M, Dc]``.
        dino: ``[M, Dd]`` or None.
        quantized_clip: Their codes by Eq. 3 ``[M, Dc]``.
        quantized_dino: ``[M, Dd]`` or None to leave the second term out.
        lambda_dino: Weight of the second term.
    """
    loss = 1 - functional.cosine_similarity(clip, quantized_clip, dim=-1)
    if quantized_dino is not None:
        if dino is None:
            raise ValueError("quantized DINO features without DINO features")
        loss = loss + lambda_dino * (1 - functional.cosine_similarity(dino, quantized_dino, dim=-1))
    return loss.mean()


def load_balancing_loss(similarities: Tensor, temperature: float = 1.0) -> Tensor:
    """Eq. 6 and supplement A: sum_N r * p.

    r is the share of features whose best code is i (a count, without gradient), p the mean softmax
    probability of code i. The minimum 1 / K is reached where all codes are used alike.

    Args:
        similarities: D(F_i, S) of a batch ``[M, K]``.
        temperature: The similarities are divided by it before the softmax; the paper has 1.
    """
    num_codes = similarities.shape[-1]
    chosen = similarities.argmax(-1)
    used = torch.bincount(chosen, minlength=num_codes).to(similarities.dtype) / len(chosen)
    probability = (similarities / temperature).softmax(-1).mean(0)
    return (used * probability).sum()


def quantization_loss(
    clip: Tensor, dino: Tensor | None, code_clip: Tensor, code_dino: Tensor | None, config: CodebookConfig
) -> Tensor:
    """Eq. 7: lambda_cos L_cos + lambda_lb L_lb for a batch of features.

    The index m is the argmax of Eq. 4 and has no gradient; the gradient reaches the codes through Eq. 3 and
    the softmax.
    """
    scores = similarity(clip, dino, code_clip, code_dino, config.lambda_dino)
    chosen = scores.argmax(-1)
    quantized_dino = None if code_dino is None else quantize(code_dino, chosen)
    loss = config.lambda_cos * cosine_loss(
        clip, dino, quantize(code_clip, chosen), quantized_dino, config.lambda_dino
    )
    if config.load_balancing:
        loss = loss + config.lambda_lb * load_balancing_loss(scores, config.temperature)
    return loss


@dataclass(frozen=True)
class Codebook:
    """The discrete language feature space S.

    Args:
        clip: CLIP parts of the codes ``[K, Dc]``, unit length.
        dino: DINO parts ``[K, Dd]``, unit length, or None when DINO is not used.
        lambda_dino: Weight of the DINO cosine in Eq. 4.

    Raises:
        ValueError: If there are more than 256 codes, shapes disagree, or a number is not finite.
    """

    clip: Tensor
    dino: Tensor | None = None
    lambda_dino: float = 0.5

    def __post_init__(self) -> None:
        if self.clip.ndim != 2 or not 1 <= len(self.clip) <= MAX_CODES:
            raise ValueError(f"codes must be [1 to {MAX_CODES}, D], got {list(self.clip.shape)}")
        if self.dino is not None and (self.dino.ndim != 2 or len(self.dino) != len(self.clip)):
            raise ValueError(f"DINO codes must be [{len(self.clip)}, D], got {list(self.dino.shape)}")
        for part in (self.clip, self.dino):
            if part is not None and not bool(torch.isfinite(part).all()):
                raise ValueError("the codebook has a number that is not finite")

    @property
    def num_codes(self) -> int:
        """K."""
        return len(self.clip)

    def similarity(self, clip: Tensor, dino: Tensor | None = None) -> Tensor:
        """Eq. 4 between features ``[M, Dc]``, ``[M, Dd]`` and all codes: ``[M, K]``."""
        return similarity(clip, dino, self.clip, self.dino, self.lambda_dino)

    def quantize(self, code_indices: Tensor) -> tuple[Tensor, Tensor | None]:
        """Eq. 3 for both halves: ``[..., Dc]`` and ``[..., Dd]`` or None."""
        dino = None if self.dino is None else quantize(self.dino, code_indices)
        return quantize(self.clip, code_indices), dino

    @torch.no_grad()
    def assign(self, feature_map: FeatureMap) -> NDArray[np.uint8]:
        """Index map M of one view: the most similar code of every cell (Eq. 4), ``[h, w]`` uint8.

        Ties go to the lower index. Works in blocks of cells.
        """
        height, width = feature_map.clip.shape[:2]
        indices = [
            self.similarity(clip, dino).argmax(-1)
            for clip, dino in _blocks(feature_map, self.clip.device, self.dino is not None)
        ]
        return torch.cat(indices).reshape(height, width).to(torch.uint8).cpu().numpy()

    def to(self, device: torch.device | str) -> Codebook:
        """A copy on another device."""
        return Codebook(
            self.clip.to(device), None if self.dino is None else self.dino.to(device), self.lambda_dino
        )

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, for safetensors."""
        stored = {"clip": self.clip, "lambda_dino": torch.tensor(self.lambda_dino, dtype=torch.float64)}
        if self.dino is not None:
            stored["dino"] = self.dino
        return stored

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Codebook:
        """The inverse of `tensors`.

        Raises:
            ValueError: If a tensor is missing or of the wrong shape.
        """
        missing = {"clip", "lambda_dino"} - set(tensors)
        if missing:
            raise ValueError(f"codebook lacks {', '.join(sorted(missing))}")
        return cls(tensors["clip"], tensors.get("dino"), float(tensors["lambda_dino"]))


@dataclass(frozen=True)
class CodeUsage:
    """How the codes are used by index maps.

    Args:
        counts: Cells per code ``[K]``.
        used: Codes with at least one cell.
        perplexity: exp of the entropy of the counts, 1 to K: how many codes would be as informative if used
            alike.
    """

    counts: NDArray[np.int64]
    used: int
    perplexity: float


def code_usage(code_maps: Iterable[NDArray[np.uint8]], num_codes: int) -> CodeUsage:
    """Utilisation of the codes over index maps ``[h, w]``; indices from K on (ignored cells) do not count."""
    counts = np.zeros(num_codes, dtype=np.int64)
    for code_map in code_maps:
        counts += np.bincount(np.asarray(code_map).ravel(), minlength=MAX_CODES)[:num_codes]
    share = counts[counts > 0] / max(counts.sum(), 1)
    perplexity = float(np.exp(-(share * np.log(share)).sum())) if len(share) else 0.0
    return CodeUsage(counts, int((counts > 0).sum()), perplexity)


def assign_code_maps(
    feature_maps: Mapping[str, FeatureMap],
    codebook: Codebook,
    names: Iterable[str] | None = None,
    *,
    listener: Listener = silent,
) -> dict[str, NDArray[np.uint8]]:
    """The one assignment pass: an index map ``[h, w]`` uint8 for every named view (default: all)."""
    chosen = list(feature_maps if names is None else names)
    code_maps = {}
    for done, name in enumerate(chosen, start=1):
        code_maps[name] = codebook.assign(feature_maps[name])
        listener(Event("assign", done, len(chosen)))
    return code_maps


def fit_codebook(
    feature_maps: Mapping[str, FeatureMap],
    names: Sequence[str],
    config: CodebookConfig,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
    listener: Listener = silent,
) -> Codebook:
    """Fit the discrete feature space S by Eq. 7 to a bounded sample of the named views.

    The codes come back with halves of unit length: only their directions enter Eq. 4 and 5.

    Args:
        feature_maps: Dense features by view name; only `names` are read, one at a time.
        names: Training views.
        config: Settings.
        seed: Of the sample, the start and the batches.
        device: Where the fit runs and the codebook lies.
        listener: Hears of stage "codebook", with the mean CLIP cosine between features and codes at the end.

    Raises:
        ValueError: If `names` is empty, or a feature is not finite.
        TrainingError: If the loss stops being finite.
    """
    if not names:
        raise ValueError("a codebook needs at least one training view")
    generator = torch.Generator(device="cpu").manual_seed(seed)
    clip, dino = sample_features(feature_maps, names, config, generator=generator)
    clip, dino = clip.to(device), None if dino is None else dino.to(device)
    lambda_dino = config.lambda_dino
    total = config.steps + 1
    if config.init == "kmeans":
        code_clip, code_dino = spherical_kmeans(
            clip,
            dino,
            config.num_codes,
            lambda_dino,
            iterations=config.kmeans_iterations,
            generator=generator,
        )
    else:
        code_clip = _uniform_codes(clip, config.num_codes, generator)
        code_dino = None if dino is None else _uniform_codes(dino, config.num_codes, generator)
    listener(Event("codebook", 1, total))
    code_clip, code_dino = _refine(clip, dino, code_clip, code_dino, config, generator, listener)
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
    for start in range(0, len(clip), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
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
    """At most ``config.sample_size`` unit features of the named views, as many from each.

    Returns:
        CLIP parts ``[M, Dc]`` and DINO parts ``[M, Dd]``, or None without DINO. All-zero features are left
        out.

    Raises:
        ValueError: If a feature is not finite, or none is left.
    """
    quota = -(-config.sample_size // len(names))
    clips, dinos = [], []
    for name in names:
        feature_map = feature_maps[name]
        clip = torch.as_tensor(feature_map.clip).flatten(0, 1)
        rows = torch.randperm(len(clip), generator=generator)[:quota]
        clips.append(clip[rows].float())
        if config.use_dino and feature_map.dino is not None:
            dinos.append(torch.as_tensor(feature_map.dino).flatten(0, 1)[rows].float())
        if not all(bool(torch.isfinite(part[-1]).all()) for part in (clips, dinos) if part):
            raise ValueError(f"features of {name} have a number that is not finite")
    if dinos and len(dinos) != len(clips):
        raise ValueError("some views have DINO features and some have none")
    clip = torch.cat(clips)
    dino = torch.cat(dinos) if dinos else None
    keep = (clip.norm(dim=-1) > 0).nonzero()[:, 0]
    if len(keep) == 0:
        raise ValueError("the training views have no features that are not zero")
    if len(keep) > config.sample_size:
        keep = keep[torch.randperm(len(keep), generator=generator)[: config.sample_size]]
    clip = functional.normalize(clip[keep], dim=-1)
    return clip, None if dino is None else functional.normalize(dino[keep], dim=-1)


@torch.no_grad()
def spherical_kmeans(
    clip: Tensor,
    dino: Tensor | None,
    num_codes: int,
    lambda_dino: float,
    *,
    iterations: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor | None]:
    """k-means for the similarity of Eq. 4, with k-means++ seeds.

    The normalised sum of a cluster's unit vectors, half by half, minimises Eq. 5 for a given assignment, so
    every iteration lowers L_cos. A cluster left without features restarts at the feature that is served
    worst.

    Returns:
        Codes ``[K, Dc]`` and ``[K, Dd]`` (or None), unit length.
    """
    joint = clip if dino is None else torch.cat([clip, lambda_dino**0.5 * dino], dim=-1)
    split = clip.shape[1]
    centres = joint[_kmeans_seeds(joint, num_codes, generator)]
    for _ in range(iterations):
        best, chosen = _nearest(joint, centres)
        sums = torch.zeros_like(centres).index_add_(0, chosen, joint)
        counts = torch.bincount(chosen, minlength=num_codes)
        empty = (counts == 0).nonzero()[:, 0]
        if len(empty):
            worst = best.argsort()[: len(empty)]
            sums[empty[: len(worst)]] = joint[worst]
        halves = [functional.normalize(sums[:, :split], dim=-1)]
        if dino is not None:
            halves.append(lambda_dino**0.5 * functional.normalize(sums[:, split:], dim=-1))
        updated = torch.cat(halves, dim=-1)
        if torch.equal(updated, centres):
            break
        centres = updated
    code_dino = None if dino is None else functional.normalize(centres[:, split:], dim=-1)
    return functional.normalize(centres[:, :split], dim=-1), code_dino


def _uniform_codes(features: Tensor, num_codes: int, generator: torch.Generator) -> Tensor:
    """The authors' start, uniform(-1/K, 1/K), on the device of the features."""
    unit = torch.rand(num_codes, features.shape[1], generator=generator) * 2 - 1
    return (unit / num_codes).to(features.device)


def _kmeans_seeds(joint: Tensor, num_codes: int, generator: torch.Generator) -> Tensor:
    """k-means++: the next seed is drawn in proportion to the squared distance from the seeds so far."""
    count = len(joint)
    seeds = [int(torch.randint(count, (1,), generator=generator))]
    norms = joint.square().sum(-1)
    nearest = torch.full((count,), torch.inf, device=joint.device)
    for _ in range(1, num_codes):
        seed = joint[seeds[-1]]
        squared = (norms + seed.square().sum() - 2 * (joint @ seed)).clamp_min(0)
        nearest = torch.minimum(nearest, squared)
        cumulative = nearest.double().cumsum(0)
        draw = torch.rand(1, generator=generator, dtype=torch.float64).to(joint.device) * cumulative[-1]
        seeds.append(min(int(torch.searchsorted(cumulative, draw, right=True)), count - 1))
    return torch.tensor(seeds, device=joint.device)


def _nearest(joint: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Best similarity and its index for every row, in blocks."""
    parts = [(joint[i : i + BLOCK_ROWS] @ centres.T).max(-1) for i in range(0, len(joint), BLOCK_ROWS)]
    return torch.cat([part.values for part in parts]), torch.cat([part.indices for part in parts])


def _refine(
    clip: Tensor,
    dino: Tensor | None,
    code_clip: Tensor,
    code_dino: Tensor | None,
    config: CodebookConfig,
    generator: torch.Generator,
    listener: Listener,
) -> tuple[Tensor, Tensor | None]:
    """Gradient steps on Eq. 7 over batches of the sample."""
    parameters = [
        part.detach().clone().requires_grad_() for part in (code_clip, code_dino) if part is not None
    ]
    optimizer = torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
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


def _blocks(feature_map: Any, device: torch.device, use_dino: bool) -> Iterator[tuple[Tensor, Tensor | None]]:
    clip = torch.as_tensor(feature_map.clip).flatten(0, 1)
    if use_dino and feature_map.dino is None:
        raise ValueError("the codebook was fitted with DINO features, but the feature map has none")
    dino = torch.as_tensor(feature_map.dino).flatten(0, 1) if use_dino else None
    for start in range(0, len(clip), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        yield (
            clip[rows].to(device, torch.float32),
            None if dino is None else dino[rows].to(device, torch.float32),
        )
