"""Scores of prompts in the form that the question asks for: by segments, by Gaussians, or as in the paper."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.language.fields.rendering import render_chunks
from lexsplat.queries.relevancy import QueryConfig, QueryForm
from lexsplat.queries.segments import segment_relevancy
from lexsplat.queries.selection import Presence


def form_used(field: LanguageField, query: QueryConfig) -> QueryForm:
    """The form in which a field answers: "code" where segments are asked for and the field has none."""
    return "code" if query.form == "segment" and field.segments is None else query.form


def scores_in_form(
    field: LanguageField, query: QueryConfig, relevancy: Tensor, presences: Sequence[Presence]
) -> Tensor:
    """Scores ``[P, N]`` of Gaussians from their relevancies.

    Prompts that the scene does not hold keep the relevancies of single Gaussians, of which next to nothing exceeds
    0.5. By segments, something would always be taken.

    Args:
        field: The language of the scene.
        query: Settings of its comparison with text.
        relevancy: ``[P, N]`` (`lexsplat.queries.relevancy.gaussian_relevancy`).
        presences: Whether the scene holds each prompt.
    """
    held = [place for place, presence in enumerate(presences) if presence != "no"]
    if field.segments is None or query.form != "segment" or not held:
        return relevancy
    scores = relevancy.clone()
    scores[held] = segment_relevancy(relevancy[held], field.segments, field.uncertainties)
    return scores


@torch.no_grad()
def render_gaussian_scores(gaussians: Gaussians, camera: Camera, scores: Tensor) -> Tensor:
    """The rendering ``[P, H, W]`` of scores ``[P, N]``, in 0..1."""
    columns = scores.T
    maps = render_chunks(gaussians, camera, len(scores), lambda part: columns[:, part].contiguous())
    return maps.permute(2, 0, 1).clamp(0.0, 1.0).contiguous()
