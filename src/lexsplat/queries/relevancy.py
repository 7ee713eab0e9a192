"""Text queries: from text embeddings to the relevancy of pixels and Gaussians (supplement B of the paper).

Nothing here needs an encoder: texts arrive as embeddings. Dimension letters: P prompts (positives),
M negatives, T texts, K codes, D feature dimensions, N Gaussians, H and W image size.

LERF and the paper compare a prompt with each canonical phrase by a softmax over the two, and the smallest result
counts. 0.5 means that the prompt and a canonical phrase are equally near. There are two forms:

- ``"feature"`` (the paper): code probabilities p become a feature, F = p S, which is compared with the text.
- ``"code"``: each code is compared with the text once (a table r of K numbers per prompt), and the results
  are blended, sum over k of p_k r_k. This is linear: the map of a view is the rendering of the Gaussians' scores.
  In a scene the table is relative to everyday words (`lexsplat.queries.everyday`) unless negatives are given.

Both forms give relevancy 0 to the transparent part of a pixel: relevancy is an expectation over what the pixel
shows. Dividing by the coverage instead would give a faint floater in front of an empty background the full
relevancy of the object it resembles, and would break linearity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.queries.everyday import EverydayScale
from lexsplat.runtime.errors import QueryError

CANONICAL_PHRASES = ("object", "things", "stuff", "texture")
"""The negatives of LERF and of the paper."""

NO_TEMPLATE = ("{}",)
"""The prompt as it is, as in the paper."""

_CHUNK = 1 << 13  # pixels per block; small enough for a block to stay in the cache
_GAUSSIANS = 1 << 16  # Gaussians per block, so that [N, K] is never held
_PEAK_SHARE, _PEAK_COUNT = 5e-4, 20
"""The peak of a level is the mean of its best 0.05 percent of the Gaussians, and of at least this many."""

QueryForm = Literal["segment", "code", "feature"]
"""How text is compared with the scene (`QueryConfig.form`)."""
TextEncoder = Callable[[list[str]], Tensor]
"""Texts to embeddings ``[T, D]``, of any length."""


@dataclass(frozen=True)
class QueryConfig:
    """How text is compared with a scene.

    Args:
        temperature: Factor on cosines before the pairwise softmax (the paper and LERF: 10).
        form: ``"code"`` blends the relevancies of codes; ``"feature"`` (the paper) compares the blended feature;
            ``"segment"`` takes or leaves whole segments by their relevancy in the form "code"
            (`lexsplat.queries.segments`), and is "code" for a field without segments.
        negatives: Phrases that each prompt is compared with. None given: "code" and "segment" compare with everyday
            words (`lexsplat.queries.everyday`), "feature" with `CANONICAL_PHRASES` (LERF and the paper).
        templates: Sentences with ``{}`` for the prompt; the embeddings of several are averaged.
        threshold: Fixed relevancy threshold of masks, in 0..1 (paper: 0.5).
        fixed: Take it for every prompt (the paper) instead of deriving one from the scene.
    """

    temperature: float = 10.0
    form: QueryForm = "segment"
    negatives: tuple[str, ...] = ()
    templates: tuple[str, ...] = NO_TEMPLATE
    threshold: float = 0.5
    fixed: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.temperature < float("inf"):
            raise ValueError(f"temperature must be positive, got {self.temperature}")
        if self.form not in get_args(QueryForm):
            raise ValueError(f"form must be one of {', '.join(get_args(QueryForm))}, got {self.form!r}")
        if not self.templates:
            raise ValueError("templates must hold at least one sentence with {}")
        for template in self.templates:
            if template.count("{}") != 1:
                raise ValueError(f"a template must contain {{}} exactly once, got {template!r}")
        for flaw in filter(None, map(_flaw, self.negatives)):
            remedy = 'name something, such as "object"'
            raise ValueError(f"negatives: expected words or phrases, found {flaw}; {remedy}")
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"threshold must be in 0..1, got {self.threshold}")

    @property
    def everyday(self) -> bool:
        """Whether relevancy is relative to everyday words."""
        return self.form != "feature" and not self.negatives

    @property
    def compared(self) -> tuple[str, ...]:
        """The negatives, by default the canonical phrases."""
        return self.negatives or CANONICAL_PHRASES


@dataclass(frozen=True, eq=False, repr=False)
class Question:
    """Embedded prompts, the negatives they are compared with, and how.

    Args:
        positives: Text embeddings of the prompts ``[P, D]``, of any length.
        negatives: Text embeddings of the negatives ``[M, D]``, M > 0, of any length.
        config: Temperature and form.
        scale: Scores of everyday words in the scene; they replace the negatives in form "code".
        best: Heights that each prompt is compared with at each code ``[K, P]``; None takes those of the scale.
    """

    positives: Tensor
    negatives: Tensor
    config: QueryConfig = field(default_factory=QueryConfig)
    scale: EverydayScale | None = None
    best: Tensor | None = None

    def __repr__(self) -> str:
        return f"Question({len(self)} prompts, form {self.config.form!r})"

    def __len__(self) -> int:
        return len(self.positives)

    def units(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Positives and negatives of unit length in float32, on the device of ``like [..., D]``.

        Raises:
            ValueError: If their dimension D differs from that of ``like``.
        """
        return _unit_texts(self.positives, like, "positives"), _unit_texts(self.negatives, like, "negatives")


# Text


def check_prompts(prompts: str | Sequence[str]) -> list[str]:
    """The prompts as a list, with surrounding and repeated spaces removed; a single text is one prompt.

    Raises:
        QueryError: If there is no prompt, or one of them is empty or not text.
    """
    if isinstance(prompts, str):
        prompts = [prompts]
    if not isinstance(prompts, Sequence) or not all(isinstance(prompt, str) for prompt in prompts):
        raise QueryError(
            "prompts",
            expected="a text or a list of texts",
            found=repr(prompts)[:60],
            remedy='name something, such as "red apple"',
        )
    cleaned = [" ".join(prompt.split()) for prompt in prompts]
    if not cleaned:
        raise QueryError(
            "query",
            expected="at least one prompt",
            found="none",
            remedy='name something, such as "red apple"',
        )
    for number, prompt in enumerate(cleaned, start=1):
        if flaw := _flaw(prompt):
            raise QueryError(
                f"prompt {number} of {len(cleaned)}",
                expected="a word or phrase",
                found=flaw,
                remedy='name something, such as "red apple"',
            )
    return cleaned


def _flaw(text: str) -> str:
    """Why a text is not a word or phrase, as the "found" of an error; "" if it is one."""
    if not text.strip():
        return "an empty text"
    # Bytes of the command line that are not UTF-8 arrive as lone surrogates.
    return "" if text.encode("utf-8", "ignore").decode("utf-8") == text else "bytes that are not UTF-8"


def check_phrase(phrase: str) -> str:
    """A phrase without surrounding space.

    Raises:
        QueryError: If it is empty or not a single text.
    """
    if not isinstance(phrase, str):
        raise QueryError(
            "phrase",
            expected="one phrase as text",
            found=repr(phrase)[:60],
            remedy="ask several at once with scene.ask",
        )
    return check_prompts(phrase)[0]


def embed_prompts(
    prompts: str | Sequence[str], encode_text: TextEncoder, templates: Sequence[str] = NO_TEMPLATE
) -> Tensor:
    """Unit embeddings ``[P, D]`` of prompts, in one call of the encoder: the mean direction over the templates.

    Raises:
        QueryError: If there is no prompt, or one is empty.
    """
    texts = [template.replace("{}", prompt) for prompt in check_prompts(prompts) for template in templates]
    unit = torch.nn.functional.normalize(encode_text(texts).float(), dim=-1)
    return torch.nn.functional.normalize(unit.unflatten(0, (-1, len(templates))).mean(1), dim=-1)


# Relevancy


def pairwise_relevancy(positives: Tensor, negatives: Tensor, temperature: float = 10.0) -> Tensor:
    """LERF's relevancy: min over negatives n of exp(t c+) / (exp(t c+) + exp(t c_n)).

    The pairwise softmax is a sigmoid of the difference and falls as c_n grows, so only the nearest negative
    matters.

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


def code_relevancy(codewords: Tensor, question: Question) -> Tensor:
    """Relevancy of each code by itself: the table r ``[K, P]`` that the ``"code"`` form blends.

    Args:
        codewords: CLIP part of the codebook ``[K, D]``, of any length.
        question: Embeddings of the prompts.
    """
    positives, negatives = question.units(codewords)
    if question.scale is not None:
        return question.scale.relevancy(codewords, positives, question.best)
    unit = torch.nn.functional.normalize(codewords.float(), dim=-1)
    return pairwise_relevancy(unit @ positives.T, unit @ negatives.T, question.config.temperature)


def feature_cosines(probabilities: Tensor, codewords: Tensor, texts: Tensor) -> Tensor:
    """Cosine of the blended feature F = p S with texts, without building F.

    cos(p S, t) = p . (S t) / sqrt(p G p) with G = S S^T. This is exact, as the squared length of F is a quadratic
    form of p. S t is K numbers per text, all texts share the length, and pixels are processed in blocks.

    Args:
        probabilities: Code weights p ``[..., K]``; their scale does not matter. A zero row has cosine 0.
        codewords: CLIP part S of the codebook ``[K, D]``.
        texts: Text embeddings ``[T, D]``.

    Returns:
        Cosines ``[..., T]`` in -1..1.
    """
    texts, codewords = _unit_texts(texts, codewords, "texts"), codewords.float()
    num_codes, num_texts = len(codewords), len(texts)
    products = codewords @ texts.T
    # The length is cheaper through G when there are fewer codes than dimensions, else through S.
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


def probability_relevancy(probabilities: Tensor, codewords: Tensor, question: Question) -> Tensor:
    """Relevancy of distributions over codes, in the form that the question asks for.

    Args:
        probabilities: ``[..., K]``, non-negative; the sum of a row is its coverage in 0..1.
        codewords: CLIP part of the codebook ``[K, D]``.
        question: Embeddings of the prompts.

    Returns:
        Relevancy ``[..., P]`` in 0..1; 0 where the distribution is empty.
    """
    codewords = codewords.to(probabilities.device)
    if question.config.form != "feature":
        return (probabilities @ code_relevancy(codewords, question)).clamp_(0.0, 1.0)
    coverage = probabilities.sum(-1, keepdim=True).clamp_(0.0, 1.0)
    positives, negatives = question.units(codewords)
    cosines = feature_cosines(probabilities, codewords, torch.cat([positives, negatives]))
    split = len(question)
    relevancy = pairwise_relevancy(cosines[..., :split], cosines[..., split:], question.config.temperature)
    return relevancy * coverage


@torch.no_grad()
def render_relevancy(
    field: LanguageField, gaussians: Gaussians, camera: Camera, question: Question
) -> Tensor:
    """Relevancy of every prompt at every pixel of a view (supplement B).

    Returns:
        ``[P, H, W]`` in 0..1, on the device of the Gaussians.
    """
    if field.levels:
        maps = [render_relevancy(level, gaussians, camera, question) for level in field.levels]
        return _of_best_level(maps, [gaussian_relevancy(level, question) for level in field.levels])
    codewords = field.codebook.clip.to(gaussians.device)
    if question.config.form == "feature":
        probabilities = field.render_code_probabilities(gaussians, camera)
        relevancy = probability_relevancy(probabilities, codewords, question)
    else:
        relevancy = field.render_scores(gaussians, camera, code_relevancy(codewords, question))
    return relevancy.permute(2, 0, 1).clamp(0.0, 1.0).contiguous()


@torch.no_grad()
def gaussian_relevancy(field: LanguageField, question: Question) -> Tensor:
    """Relevancy of every prompt for every Gaussian ``[P, N]`` in 0..1; 0 for Gaussians that no view saw.

    Of a field with levels of 2D segments, the level with the highest peak answers a prompt, as in LangSplat.
    """
    if field.levels:
        own = [gaussian_relevancy(level, question) for level in field.levels]
        return _of_best_level(own, own)
    if question.config.form != "feature":
        scores = field.scores(code_relevancy(field.codebook.clip, question))
        return scores.T.clamp(0.0, 1.0).contiguous()
    codewords = field.codebook.clip.to(field.uncertainties.device)
    index = torch.arange(len(field.uncertainties), device=codewords.device)
    blocks = [
        probability_relevancy(rows.code_probabilities(), codewords, question).T
        for rows in map(field.select, index.split(_GAUSSIANS))
    ]
    return torch.cat(blocks, dim=1).contiguous()


def _of_best_level(answers: Sequence[Tensor], relevancies: Sequence[Tensor]) -> Tensor:
    """For each prompt the answer of the level whose Gaussians reach the highest peak.

    Args:
        answers: ``[P, ...]`` of each level.
        relevancies: Relevancy of the Gaussians ``[P, N]`` at each level.
    """
    number = relevancies[0].shape[1]
    count = min(number, max(_PEAK_COUNT, int(_PEAK_SHARE * number)))
    peaks = torch.stack([own.topk(count, dim=1).values.sum(1) for own in relevancies])
    found = answers[0].clone()
    for prompt, level in enumerate(peaks.argmax(0).tolist()):
        found[prompt] = answers[level][prompt]
    return found


def _unit_texts(texts: Tensor, like: Tensor, name: str) -> Tensor:
    """Embeddings ``[*, D]`` of unit length in float32, on the device of ``like [..., D]``."""
    if texts.ndim != 2 or texts.shape[1] != like.shape[-1]:
        raise ValueError(f"{name} must be [*, {like.shape[-1]}], got {list(texts.shape)}")
    return torch.nn.functional.normalize(texts.to(like.device, torch.float32), dim=-1)
