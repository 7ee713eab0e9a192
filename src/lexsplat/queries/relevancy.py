"""Questions in words: from text embeddings to relevancy of pixels and Gaussians, and masks (supplement B).

Nothing here needs an encoder: text comes in as embeddings. Dimension letters: P prompts (positives),
M negatives, T texts, K codes, D feature dimensions, N Gaussians, H and W image size.

Relevancy is LERF's: a prompt is compared with each canonical phrase by a softmax of two, and the least
favorable phrase counts. 0.5 means "as near to the prompt as to a canonical phrase". Two forms, by name:

- ``"feature"`` (the paper): code probabilities p become a feature, F = p S, which is compared with the text.
- ``"code"``: each code is compared with the text once (a table r of K numbers for a prompt), and the answers
  are blended, sum over k of p_k r_k. Linear: the map of a view is the rendering of the Gaussians' scores.

Where a view is not opaque, the missing part counts as "nothing here", relevancy 0, in both forms: relevancy
is an expectation over what a pixel shows. Dividing by the coverage instead would give a faint floater before
an empty background the full relevancy of the object it resembles, and would break linearity.
``coverage="divide"`` does it nevertheless, for scenes where opaque surfaces carry Gaussians without language
because no training view saw them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import QueryError

if TYPE_CHECKING:
    from lexsplat.codebook import Codebook

CANONICAL_PHRASES = ("object", "things", "stuff", "texture")
"""What a prompt is compared with (LERF, and the paper after it)."""

NO_TEMPLATE = ("{}",)
"""Prompts as they are, the paper's way."""

PHOTO_TEMPLATES = (
    "a photo of {}",
    "a photo of a {}",
    "a close-up photo of the {}",
    "there is a {} in the scene",
)
"""A small ensemble of sentences; their embeddings are averaged."""


_CHUNK = 1 << 13  # pixels at a time; small enough that a block stays in the cache
_GAUSSIANS = 1 << 16  # whose distributions are held at a time
_MIN_COVERAGE = 0.05

QueryForm = Literal["feature", "code"]
"""Whether the blended feature or each code is compared with the text."""
TextEncoder = Callable[[list[str]], Tensor]
"""Texts to embeddings ``[T, D]``; they need not be of unit length."""


@dataclass(frozen=True)
class QueryConfig:
    """How text is compared with a scene.

    Args:
        temperature: Factor on cosines before the pairwise softmax (the paper and LERF: 10).
        form: ``"code"`` blends the comparisons of codes with the text; ``"feature"`` compares the blended feature
            (the paper). "code" measured better for every field (docs/results.md).
        negatives: Phrases that a prompt has to beat.
        templates: Sentences with ``{}`` for the prompt; several are averaged.
        threshold: Relevancy from which a pixel belongs to the mask, in 0..1 (paper: 0.5).
        coverage: ``"composite"`` counts what is not covered as not relevant; ``"divide"`` ignores it.
    """

    temperature: float = 10.0
    form: QueryForm = "code"
    negatives: tuple[str, ...] = CANONICAL_PHRASES
    templates: tuple[str, ...] = NO_TEMPLATE
    threshold: float = 0.5
    coverage: Literal["composite", "divide"] = "composite"

    def __post_init__(self) -> None:
        if not 0 < self.temperature < float("inf"):
            raise ValueError(f"temperature must be positive, got {self.temperature}")
        if self.form not in ("feature", "code"):
            raise ValueError(f"form must be 'feature' or 'code', got {self.form!r}")
        if self.coverage not in ("composite", "divide"):
            raise ValueError(f"coverage must be 'composite' or 'divide', got {self.coverage!r}")
        if not self.negatives:
            raise ValueError("negatives must hold at least one phrase")
        for template in self.templates:
            if template.count("{}") != 1:
                raise ValueError(f"a template needs {{}} once, got {template!r}")
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"threshold must be in 0..1, got {self.threshold}")


class QueryableField(Protocol):
    """What a query needs of a language field (``language_field.LanguageField`` has it)."""

    codebook: Codebook

    @property
    def uncertainties(self) -> Tensor:
        """``[N]`` in 0..1."""

    def select(self, index: Tensor) -> QueryableField:
        """The rows of some Gaussians."""

    def code_probabilities(self) -> Tensor:
        """Distribution over codes of every Gaussian ``[N, K]``; a row of zeros was never seen."""

    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Distribution over codes at every pixel ``[H, W, K]``; sums to the coverage."""

    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] at every pixel: ``[K, P]`` to ``[H, W, P]``."""


# Text


def check_prompts(prompts: Sequence[str]) -> list[str]:
    """Prompts without surrounding space.

    Raises:
        QueryError: If there is none, or one is empty or no text.
    """
    if isinstance(prompts, str):
        prompts = [prompts]
    cleaned = [" ".join(prompt.split()) for prompt in prompts]
    if not cleaned:
        raise QueryError(
            "query",
            expected="at least one prompt",
            found="none",
            remedy='ask for something, such as "red apple"',
        )
    for number, prompt in enumerate(cleaned, start=1):
        # Bytes that are no text come from the command line as halves of characters.
        is_text = prompt.encode("utf-8", "ignore").decode("utf-8") == prompt
        if not prompt or not is_text:
            raise QueryError(
                f"prompt {number} of {len(cleaned)}",
                expected="a word or phrase",
                found="bytes that are no text" if prompt else "an empty text",
                remedy='name something, such as "red apple"',
            )
    return cleaned


def expand_templates(prompts: Sequence[str], templates: Sequence[str] = NO_TEMPLATE) -> list[str]:
    """Every prompt in every template, prompts outermost: ``P * len(templates)`` texts.

    Raises:
        QueryError: If a prompt is empty.
        ValueError: If there is no template, or one does not have exactly one ``{}``.
    """
    if not templates:
        raise ValueError("templates must hold at least one sentence with {}")
    for template in templates:
        if template.count("{}") != 1:
            raise ValueError(f"a template needs {{}} once, got {template!r}")
    return [template.replace("{}", prompt) for prompt in check_prompts(prompts) for template in templates]


def average_templates(embeddings: Tensor, num_templates: int) -> Tensor:
    """Mean direction over each prompt's templates: ``[P * num_templates, D]`` to unit rows ``[P, D]``."""
    if num_templates < 1 or embeddings.ndim != 2 or len(embeddings) % num_templates:
        raise ValueError(f"{list(embeddings.shape)} embeddings do not divide into {num_templates} templates")
    unit = torch.nn.functional.normalize(embeddings.float(), dim=-1)
    return torch.nn.functional.normalize(unit.view(-1, num_templates, unit.shape[-1]).mean(1), dim=-1)


def embed_prompts(
    prompts: Sequence[str], encode_text: TextEncoder, templates: Sequence[str] = NO_TEMPLATE
) -> Tensor:
    """Unit embeddings ``[P, D]`` of prompts, averaged over templates, by one call of the encoder."""
    return average_templates(encode_text(expand_templates(prompts, templates)), len(templates))


# Relevancy


def pairwise_relevancy(positives: Tensor, negatives: Tensor, temperature: float = 10.0) -> Tensor:
    """LERF's relevancy: min over negatives n of exp(t c+) / (exp(t c+) + exp(t c_n)).

    The pairwise softmax of two is a sigmoid of the difference, and it falls as c_n grows, so only the nearest
    negative matters.

    Args:
        positives: Cosines with the prompts ``[..., P]``.
        negatives: Cosines with the negatives ``[..., M]``, M > 0.
        temperature: Factor t on the cosines.

    Returns:
        Relevancy ``[..., P]`` in 0..1.
    """
    if negatives.shape[-1] == 0:
        raise ValueError("relevancy needs at least one negative")
    return torch.sigmoid(temperature * (positives - negatives.amax(-1, keepdim=True)))


def code_relevancy(
    codewords: Tensor, positives: Tensor, negatives: Tensor, temperature: float = 10.0
) -> Tensor:
    """Relevancy of each code by itself: the table r ``[K, P]`` that the ``"code"`` form blends.

    Args:
        codewords: CLIP part of the codebook ``[K, D]``, of any length.
        positives: Text embeddings of the prompts ``[P, D]``.
        negatives: Text embeddings of the negatives ``[M, D]``.
        temperature: Factor on the cosines.
    """
    codewords, positives, negatives = _matching(codewords, positives, negatives)
    unit = torch.nn.functional.normalize(codewords, dim=-1)
    return pairwise_relevancy(unit @ positives.T, unit @ negatives.T, temperature)


def feature_cosines_naive(probabilities: Tensor, codewords: Tensor, texts: Tensor) -> Tensor:
    """Cosine of the blended feature F = p S with texts, by building F: ``[..., K]`` to ``[..., T]``.

    The reference for `feature_cosines`; it holds a feature map ``[..., D]``. A zero feature has cosine 0.
    """
    features = torch.nn.functional.normalize(probabilities @ codewords, dim=-1)
    return features @ torch.nn.functional.normalize(texts, dim=-1).T


def feature_cosines(probabilities: Tensor, codewords: Tensor, texts: Tensor) -> Tensor:
    """Cosine of the blended feature F = p S with texts, without building F.

    cos(p S, t) = p . (S t) / sqrt(p G p) with G = S S^T: exact, as the length of F is a quadratic form of p.
    S t is K numbers for a text, the length is shared by all texts, and pixels are done in bounded blocks.

    Args:
        probabilities: Code weights p ``[..., K]``; their scale does not matter. A zero row has cosine 0.
        codewords: CLIP part S of the codebook ``[K, D]``.
        texts: Text embeddings ``[T, D]``.

    Returns:
        Cosines ``[..., T]`` in -1..1.
    """
    codewords, texts, _ = _matching(codewords, texts, texts)
    num_codes, num_texts = len(codewords), len(texts)
    products = codewords @ texts.T
    # The shorter way to the length: through G when there are fewer codes than dimensions, else through S.
    gram = num_codes <= codewords.shape[1]
    matrix = torch.cat([products, codewords @ codewords.T if gram else codewords], dim=1)
    flat = probabilities.reshape(-1, num_codes)
    cosines = flat.new_empty(len(flat), num_texts)
    for start in range(0, len(flat), _CHUNK):
        block = flat[start : start + _CHUNK]
        image = block @ matrix
        rest = image[:, num_texts:]
        squares = (rest * block).sum(-1) if gram else rest.square().sum(-1)
        lengths = squares.clamp_min(0).sqrt_().clamp_min_(1e-12)
        torch.div(image[:, :num_texts], lengths[:, None], out=cosines[start : start + _CHUNK])
    return cosines.view(*probabilities.shape[:-1], num_texts).clamp_(-1.0, 1.0)


def probability_relevancy(
    probabilities: Tensor,
    codewords: Tensor,
    positives: Tensor,
    negatives: Tensor,
    config: QueryConfig | None = None,
) -> Tensor:
    """Relevancy of distributions over codes, in either form.

    Args:
        probabilities: ``[..., K]``, non-negative; a row's sum is its coverage in 0..1.
        codewords: CLIP part of the codebook ``[K, D]``.
        positives: Text embeddings of the prompts ``[P, D]``.
        negatives: Text embeddings of the negatives ``[M, D]``.
        config: Form, temperature, coverage.

    Returns:
        Relevancy ``[..., P]`` in 0..1; 0 where the distribution is empty.
    """
    config = config or QueryConfig()
    codewords, positives, negatives = _matching(codewords.to(probabilities.device), positives, negatives)
    if config.form == "code":
        scores = probabilities @ code_relevancy(codewords, positives, negatives, config.temperature)
        if config.coverage == "divide":
            return _divide(scores, probabilities.sum(-1, keepdim=True))
        return scores.clamp_(0.0, 1.0)
    coverage = probabilities.sum(-1, keepdim=True).clamp_(0.0, 1.0)
    cosines = feature_cosines(probabilities, codewords, torch.cat([positives, negatives]))
    split = len(positives)
    relevancy = pairwise_relevancy(cosines[..., :split], cosines[..., split:], config.temperature)
    if config.coverage == "divide":
        return relevancy * (coverage > _MIN_COVERAGE)
    return relevancy * coverage


@torch.no_grad()
def render_relevancy(
    field: QueryableField,
    gaussians: Gaussians,
    camera: Camera,
    positives: Tensor,
    negatives: Tensor,
    config: QueryConfig | None = None,
) -> Tensor:
    """Relevancy of every prompt at every pixel of a view (supplement B).

    Args:
        field: The language of the scene.
        gaussians: Its geometry.
        camera: The view.
        positives: Text embeddings of the prompts ``[P, D]``.
        negatives: Text embeddings of the negatives ``[M, D]``.
        config: Form, temperature, coverage.

    Returns:
        ``[P, H, W]`` in 0..1, on the device of the Gaussians.
    """
    config = config or QueryConfig()
    codewords = field.codebook.clip.to(gaussians.device)
    if config.form == "feature":
        probabilities = field.render_code_probabilities(gaussians, camera)
        relevancy = probability_relevancy(probabilities, codewords, positives, negatives, config)
        return relevancy.permute(2, 0, 1).contiguous()
    table = code_relevancy(codewords, positives, negatives, config.temperature)
    if config.coverage == "divide":
        table = torch.cat([table, torch.ones_like(table[:, :1])], dim=1)
    scores = field.render_scores(gaussians, camera, table)
    if config.coverage == "divide":
        scores = _divide(scores[..., :-1], scores[..., -1:])
    return scores.permute(2, 0, 1).clamp(0.0, 1.0).contiguous()


@torch.no_grad()
def gaussian_relevancy(
    field: QueryableField, positives: Tensor, negatives: Tensor, config: QueryConfig | None = None
) -> Tensor:
    """Relevancy of every prompt for every Gaussian ``[P, N]`` in 0..1; 0 for those that were never seen."""
    config = config or QueryConfig()
    if config.form == "code" and config.coverage == "composite" and hasattr(field, "scores"):
        table = code_relevancy(field.codebook.clip, positives, negatives, config.temperature)
        return field.scores(table).T.clamp(0.0, 1.0).contiguous()  # sparse: [N, K] is never held
    codewords = field.codebook.clip.to(field.uncertainties.device)
    index = torch.arange(len(field.uncertainties), device=codewords.device)
    blocks = [
        probability_relevancy(rows.code_probabilities(), codewords, positives, negatives, config).T
        for rows in map(field.select, index.split(_GAUSSIANS))  # [N, K] is never held
    ]
    return torch.cat(blocks, dim=1).contiguous()


def ranking(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The best of each prompt, best first: indices and scores, both ``[P, min(count, N)]``.

    For Gaussians (`gaussian_relevancy`) and for codes (``code_relevancy(...).T``). Ties keep their order.
    """
    if scores.ndim != 2 or count < 1:
        raise ValueError(
            f"ranking needs scores [P, N] and a positive count, got {list(scores.shape)}, {count}"
        )
    values, indices = scores.sort(dim=1, descending=True, stable=True)
    return indices[:, :count], values[:, :count]


def _divide(scores: Tensor, coverage: Tensor) -> Tensor:
    ratio = scores / coverage.clamp_min(_MIN_COVERAGE)
    return (ratio * (coverage > _MIN_COVERAGE)).clamp(0.0, 1.0)


def _matching(codewords: Tensor, positives: Tensor, negatives: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The three on one device in float32, texts of unit length, their dimensions checked."""
    for name, texts in (("positives", positives), ("negatives", negatives)):
        if texts.ndim != 2 or texts.shape[1] != codewords.shape[-1]:
            raise ValueError(f"{name} must be [*, {codewords.shape[-1]}], got {list(texts.shape)}")
    positives, negatives = (
        torch.nn.functional.normalize(texts.to(codewords.device, torch.float32), dim=-1)
        for texts in (positives, negatives)
    )
    return codewords.float(), positives, negatives
