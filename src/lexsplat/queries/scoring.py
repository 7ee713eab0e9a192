"""Scores of prompts in the form that the question asks for: by segments, by Gaussians, or as in the paper.

Prompts that the scene does not hold keep the relevancies of single Gaussians, of which next to nothing exceeds 0.5.
By segments, something would always be taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.language.fields.rendering import render_chunks
from lexsplat.queries.relevancy import QueryConfig, QueryForm, Question, gaussian_relevancy, render_relevancy
from lexsplat.queries.segments import segment_relevancy
from lexsplat.queries.selection import Presence

Classify = Callable[[Tensor], Presence]
"""Whether the scene holds a phrase, from the relevancies ``[N]`` of the Gaussians in the form "code"."""


@dataclass(frozen=True, eq=False)
class Scored:
    """Scores of Gaussians for P prompts.

    Args:
        scores: ``[P, N]`` in 0..1.
        presences: Whether the scene holds each prompt; "yes" for all if nothing decides it.
        by_segments: Whether whole segments are taken: the threshold is then
            `lexsplat.queries.segments.SEGMENT_THRESHOLD`.
    """

    scores: Tensor
    presences: tuple[Presence, ...]
    by_segments: bool


def form_used(field: LanguageField, query: QueryConfig) -> QueryForm:
    """The form in which a field answers: "code" where segments are asked for and the field has none."""
    return "code" if query.form == "segment" and field.segments is None else query.form


def score_prompts(field: LanguageField, question: Question, classify: Classify | None) -> Scored:
    """Scores of all Gaussians for the prompts of a question.

    Args:
        field: The language of the scene.
        question: Embeddings of the prompts.
        classify: Decides presence; None takes every prompt as present.
    """
    scores = gaussian_relevancy(field, question)
    presences: tuple[Presence, ...] = tuple(classify(row) if classify else "yes" for row in scores)
    if field.segments is None or question.config.form != "segment":
        return Scored(scores, presences, False)
    present = [place for place, presence in enumerate(presences) if presence != "no"]
    if present:
        scores[present] = segment_relevancy(scores[present], field.segments)
    return Scored(scores, presences, True)


@torch.no_grad()
def render_scored(
    field: LanguageField,
    gaussians: Gaussians,
    camera: Camera,
    question: Question,
    classify: Classify | None,
) -> Tensor:
    """Maps ``[P, H, W]`` of the prompts in a view, in 0..1: by segments, the rendering of the scores.

    Args:
        field: The language of the scene.
        gaussians: Its geometry.
        camera: The view.
        question: Embeddings of the prompts.
        classify: See `score_prompts`.
    """
    if form_used(field, question.config) != "segment":
        return render_relevancy(field, gaussians, camera, question)
    scores = score_prompts(field, question, classify).scores.T
    maps = render_chunks(gaussians, camera, scores.shape[1], lambda part: scores[:, part].contiguous())
    return maps.permute(2, 0, 1).clamp(0.0, 1.0).contiguous()
