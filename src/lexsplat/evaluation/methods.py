"""The interface that evaluation needs of a method: relevancy maps, and scores of Gaussians if it has any.

Language fields (`lexsplat.language.fields.LanguageField`) are one kind of method; the rebuilt methods of
`lexsplat.evaluation.baselines` are others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.presence import PresenceClassifier
from lexsplat.queries.relevancy import Question, gaussian_relevancy, render_relevancy
from lexsplat.queries.selection import Presence

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

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """See `lexsplat.queries.relevancy.render_relevancy`."""
        return render_relevancy(self.field, gaussians, camera, question)

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """See `lexsplat.queries.relevancy.gaussian_relevancy`."""
        return gaussian_relevancy(self.field, question)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors of the field."""
        return self.field.tensors()


def method_presences(
    method: Method, gaussians: Gaussians, scores: Tensor | None, references: Question
) -> Sequence[Presence] | None:
    """Whether the scene holds each prompt, as for its users; None for methods other than language fields.

    Args:
        method: The method.
        gaussians: The reconstruction.
        scores: Relevancy of the prompts ``[P, N]``.
        references: The embedded `lexsplat.queries.presence.REFERENCE_PHRASES`.
    """
    if not isinstance(method, FieldMethod) or scores is None:
        return None
    classifier = PresenceClassifier(gaussians, method.field, references)
    return [classifier.classify(row) for row in scores]
