"""What an evaluation asks of a method that finds words in a scene: maps, and scores of Gaussians if it has them.

Language fields (`language_field.LanguageField`) are one kind; the rebuilt methods of
`lexsplat.evaluation.baselines` others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.presence import PresenceClassifier, found_thresholds
from lexsplat.queries.relevancy import QueryConfig, gaussian_relevancy, render_relevancy
from lexsplat.queries.thresholds import automatic_threshold

if TYPE_CHECKING:
    from lexsplat.language.fields import LanguageField


@runtime_checkable
class Method(Protocol):
    """A method that answers words with relevancy maps."""

    method: str

    def relevancy(
        self, gaussians: Gaussians, camera: Camera, positives: Tensor, negatives: Tensor, config: QueryConfig
    ) -> Tensor:
        """Maps ``[P, H, W]`` in 0..1 of prompts ``[P, D]`` against negatives ``[M, D]``."""
        ...

    def gaussian_scores(self, positives: Tensor, negatives: Tensor, config: QueryConfig) -> Tensor | None:
        """Scores ``[P, N]`` in 0..1 of the Gaussians; None for a method without 3D."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """What has to be stored to answer."""
        ...


class FieldMethod:
    """A language field as a `Method`.

    Args:
        field: The language of the scene.
    """

    def __init__(self, field: LanguageField) -> None:
        self.field = field
        self.method = field.method

    def relevancy(
        self, gaussians: Gaussians, camera: Camera, positives: Tensor, negatives: Tensor, config: QueryConfig
    ) -> Tensor:
        """See `queries.render_relevancy`."""
        return render_relevancy(self.field, gaussians, camera, positives, negatives, config)

    def gaussian_scores(self, positives: Tensor, negatives: Tensor, config: QueryConfig) -> Tensor | None:
        """See `queries.gaussian_relevancy`."""
        return gaussian_relevancy(self.field, positives, negatives, config)

    def thresholds(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        positives: Tensor,
        negatives: Tensor,
        references: Tensor,
        config: QueryConfig,
    ) -> Tensor:
        """See `presence.found_thresholds`: what a user of the scene gets."""
        judge = PresenceClassifier(gaussians, self.field, references, negatives, config.temperature)
        return found_thresholds(judge, gaussians, cameras, positives, negatives, config)

    def tensors(self) -> dict[str, Tensor]:
        """Everything the field stores."""
        return self.field.tensors()


def method_thresholds(
    method: Method,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    positives: Tensor,
    negatives: Tensor,
    references: Tensor,
    config: QueryConfig,
    *,
    long_side: int = 320,
) -> Tensor:
    """Automatic thresholds ``[P]`` from maps of views that are not evaluated, the same rule for every method.

    Language fields say in addition what is not in the scene (`presence.found_thresholds`), by ``references``
    ``[V, D]``, the embeddings of `presence.REFERENCE_PHRASES`; its masks are then all but empty.
    """
    if isinstance(method, FieldMethod):
        return method.thresholds(gaussians, cameras, positives, negatives, references, config)
    if not cameras:
        raise ValueError("an automatic threshold needs at least one camera")
    maps = []
    for camera in cameras:
        small = camera.downscaled(max(1.0, max(camera.width, camera.height) / long_side))
        maps.append(method.relevancy(gaussians, small, positives, negatives, config).flatten(1).cpu())
    return automatic_threshold(torch.cat(maps, dim=1))
