"""The interface that evaluation needs of a method: relevancy maps, and scores of Gaussians if it has any.

Language fields (`lexsplat.language.fields.LanguageField`) are one kind of method; the rebuilt methods of
`lexsplat.evaluation.baselines` are others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.presence import PresenceClassifier
from lexsplat.queries.relevancy import Question
from lexsplat.queries.scoring import Classify, render_scored, score_prompts
from lexsplat.queries.segments import SEGMENT_THRESHOLD
from lexsplat.queries.thresholds import scene_thresholds

if TYPE_CHECKING:
    from lexsplat.language.fields import LanguageField


@runtime_checkable
class Method(Protocol):
    """A method that answers prompts with relevancy maps."""

    method: str

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]`` of the prompts in a view, in 0..1."""
        ...

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]`` of the Gaussians in 0..1; None for a method without 3D."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that have to be stored to answer prompts."""
        ...


class FieldMethod:
    """A language field as a `Method`.

    Args:
        field: The language of the scene.
    """

    def __init__(self, field: LanguageField) -> None:
        self.field = field
        self.method = field.method
        self.classify: Classify | None = None

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """See `lexsplat.queries.scoring.render_scored`."""
        return render_scored(self.field, gaussians, camera, question, self.classify)

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """See `lexsplat.queries.scoring.score_prompts`."""
        return score_prompts(self.field, question, self.classify).scores

    def tensors(self) -> dict[str, Tensor]:
        """The tensors of the field."""
        return self.field.tensors()


def automatic_answers(
    method: Method,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    question: Question,
    references: Question,
) -> tuple[Tensor | None, Tensor]:
    """Scores ``[P, N]`` of the Gaussians, if the method has any, and automatic thresholds ``[P]``, as for its users.

    Args:
        method: The method. A language field learns here what decides presence.
        gaussians: The reconstruction.
        cameras: The training views.
        question: The embedded prompts.
        references: The embedded `lexsplat.queries.presence.REFERENCE_PHRASES`.
    """

    def maps(camera: Camera) -> Tensor:
        return method.relevancy(gaussians, camera, question)

    if not isinstance(method, FieldMethod):
        return method.gaussian_scores(question), scene_thresholds(maps, cameras)
    method.classify = PresenceClassifier(gaussians, method.field, references).classify
    scored = score_prompts(method.field, question, method.classify)
    if scored.by_segments:
        return scored.scores, torch.full((len(question),), SEGMENT_THRESHOLD)
    return scored.scores, scene_thresholds(maps, cameras, scored.presences)
