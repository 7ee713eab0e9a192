"""No 3D: the 2D features of the evaluated photo itself, as a reference.

It reads the held-out photo, so it is not a method for novel views. A 3D method below it loses more by its geometry
than it gains from the other views.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lexsplat.evaluation.baselines.baseline import BaselineRun
from lexsplat.evaluation.baselines.feature_rendering import TrainingData, resized_map, unit_texts
from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.relevancy import Question, pairwise_relevancy


class ViewFeatures:
    """Feature maps, looked up by the pose of their camera.

    Args:
        cameras: All views by name, at any size.
        maps: Dense features by view name.
    """

    method = "nearest"

    def __init__(self, cameras: Mapping[str, Camera], maps: Mapping[str, FeatureMap]) -> None:
        self._names = {camera.viewmat.tobytes(): name for name, camera in cameras.items()}
        self._maps = maps

    def relevancy(self, gaussians: Gaussians, camera: Camera, question: Question) -> Tensor:
        """Maps ``[P, H, W]``: relevancy of the cells, enlarged.

        Raises:
            ValueError: If no view has this camera's pose.
        """
        name = self._names.get(camera.viewmat.tobytes())
        if name is None:
            raise ValueError("features of a view are known only from the poses of the capture")
        positives, negatives = unit_texts(question.positives, question.negatives)
        clip = torch.nn.functional.normalize(self._maps[name].clip.float(), dim=-1)
        found = pairwise_relevancy(clip @ positives.T, clip @ negatives.T, question.config.temperature)
        return resized_map(found, camera).permute(2, 0, 1).clamp(0, 1).contiguous()

    def gaussian_scores(self, question: Question) -> Tensor | None:
        """None: there is nothing in 3D."""
        return None

    def tensors(self) -> dict[str, Tensor]:
        """The maps of all views in half precision."""
        return {name: self._maps[name].clip.half() for name in self._names.values()}


class Nearest:
    """The baseline."""

    name, settings, knows_prompts, needs_crop_sizes = "nearest", None, False, False

    def fit(self, data: TrainingData, run: BaselineRun) -> ViewFeatures:
        """The maps of all views; nothing is fitted."""
        return ViewFeatures(run.cameras, data.maps)
