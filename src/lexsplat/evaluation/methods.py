"""Subjects of an evaluation: a `Scene`, or a rebuilt method on the same Gaussians (`MethodScene`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import QueryConfig, Question, TextEncoder, embed_prompts
from lexsplat.queries.thresholds import scene_thresholds


@runtime_checkable
class Method(Protocol):
    """A method without codes that answers prompts with relevancy maps (`lexsplat.evaluation.baselines`)."""

    method: str

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]`` of the prompts in a view, in 0..1."""

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """Scores ``[P, N]`` of the Gaussians in 0..1; None for a method without 3D."""

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that have to be stored to answer prompts."""


@dataclass(frozen=True)
class MethodAnswers:
    """Answers of `MethodScene.ask`, with the names that `lexsplat.scenes.answers.Answers` has.

    Args:
        scores: Relevancy of every Gaussian ``[P, N]``; None for a method without 3D.
        thresholds: The automatic threshold of each prompt ``[P]``.
    """

    scores: Tensor | None
    thresholds: Tensor

    def chosen(self, index: int) -> Tensor:
        """The Gaussians ``[N]`` bool that reach the threshold of a prompt."""
        if self.scores is None:
            raise ValueError("a method without scores of Gaussians selects none")
        return self.scores[index] >= self.thresholds[index]


@dataclass(frozen=True)
class MethodScene:
    """A method that is asked like a `lexsplat.scenes.scene.Scene`; it does not decide about presence.

    Args:
        gaussians: Geometry and appearance.
        field: The method.
        cameras: The training views, from which thresholds are found.
        encode_text: Texts to embeddings.
        query: Settings of the comparison with text.
    """

    gaussians: Gaussians
    field: Method
    cameras: Sequence[Camera]
    encode_text: TextEncoder
    query: QueryConfig

    def ask(self, prompts: Sequence[str]) -> MethodAnswers:
        """Scores and threshold of each prompt."""
        question = self._question(prompts)
        thresholds = scene_thresholds(
            lambda camera: self.field.relevancy(self.gaussians, camera, question), self.cameras
        )
        return MethodAnswers(self.field.gaussian_scores(question), thresholds)

    def relevancy(self, prompts: Sequence[str], view: Camera) -> Tensor:
        """Maps ``[P, H, W]`` of the prompts in a view, in 0..1."""
        return self.field.relevancy(self.gaussians, view, self._question(prompts))

    def _question(self, prompts: Sequence[str]) -> Question:
        positives, negatives = (
            embed_prompts(texts, self.encode_text, self.query.templates)
            for texts in (prompts, self.query.compared)
        )
        return Question(positives, negatives, self.query)
