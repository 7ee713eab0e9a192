"""SAM 2 on a grid of points: the masks of a photo in three levels, from parts to things.

A point prompts three masks: of a part, of a larger part, and of the thing. Each of the three is a level, as in
LangSplat. The mask generation of transformers requires torchvision, so its steps are here: confident and stable masks
are kept, of those that nearly coincide the best one.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features.extraction import pixels_hash
from lexsplat.features.pretrained import IMAGENET, PretrainedModel, normalization, precision

if TYPE_CHECKING:
    from lexsplat.captures import View

DEFAULT_SAM2 = "facebook/sam2.1-hiera-small"
"""The SAM 2 of ``--features.segments sam2``."""

CONFIDENT = 0.8
"""Least quality that the model predicts of a mask, as in SAM 2's own mask generation."""
STABLE = 0.95
"""Least IoU of the masks at logits of 1 and of -1, as there."""
ALIKE = 0.8
"""IoU from which on two masks of a level are the same."""

_BATCH = 64  # points decoded at once


class Sam2Segmenter(PretrainedModel):
    """SAM 2 or 2.1, of the classes for photos or for videos, of which the part for photos is used.

    Args:
        folder: Local model folder.
        name: Its name in messages and records.
        device: Device of the model.
        points: Points along a side of the grid; None is 32 on CUDA, as in SAM 2's own mask generation, and 16
            elsewhere.

    Raises:
        ModelError: If it is not a SAM 2, or cannot be loaded whole.
    """

    tower = "segments"
    kept_apart = True

    def __init__(
        self, folder: Path, name: str, device: torch.device | str = "cpu", points: int | None = None
    ) -> None:
        super().__init__(folder, name, device)
        if self._model.config.model_type != "sam2":
            raise self._refusal("a SAM 2 model", f"try {DEFAULT_SAM2}, or `--features.segments slic`")
        self.points = points or (32 if self.device.type == "cuda" else 16)
        side = self._model.config.prompt_encoder_config.image_size
        self.image_size = int(side if isinstance(side, int) else side[0])
        self._mean, self._std = normalization(folder, IMAGENET, self.device)

    def key(self, view: View) -> list[Any]:
        """The model, the settings and the photo."""
        settings = [self.points, CONFIDENT, STABLE, ALIKE]
        return ["sam2", self.content_hash, *settings, pixels_hash(view, (self.image_size, self.image_size))]

    def labels(self, view: View, size: tuple[int, int]) -> NDArray[np.int32]:
        """Three levels of masks; see `lexsplat.features.segments2d.Segmenter`."""
        image = torch.from_numpy(view.load_image((self.image_size, self.image_size))).permute(2, 0, 1)
        logits, scores = self.masks(image, size)
        return np.stack([paint(logits[:, level], scores[:, level]) for level in range(logits.shape[1])])

    @torch.inference_mode()
    def masks(self, image: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """The masks of every point of the grid.

        Args:
            image: The photo ``[3, s, s]`` in 0..1, stretched to the square that the model sees.
            size: Width and height of the masks.

        Returns:
            Logits ``[points^2, 3, height, width]`` and predicted qualities ``[points^2, 3]``, float32 on the CPU.
        """
        pixels = (image[None].to(self.device) - self._mean) / self._std
        places = (torch.arange(self.points, device=self.device) + 0.5) * (self.image_size / self.points)
        grid = torch.stack(torch.meshgrid(places, places, indexing="xy"), -1).reshape(1, -1, 1, 2)
        logits, scores = [], []
        with precision(self.device):
            seen = self._model.get_image_embeddings(pixels)
            for points in grid.split(_BATCH, dim=1):
                found = self._model(image_embeddings=seen, input_points=points, multimask_output=True)
                masks = found.pred_masks[0].float()
                masks = F.interpolate(masks, (size[1], size[0]), mode="bilinear", align_corners=False)
                logits.append(masks.cpu())
                scores.append(found.iou_scores[0].float().cpu())
        return torch.cat(logits), torch.cat(scores)


def paint(logits: Tensor, scores: Tensor) -> NDArray[np.int32]:
    """One level of segments from masks that may overlap: smaller ones lie on top of larger ones.

    Args:
        logits: ``[n, h, w]``; a mask is where they are positive.
        scores: Predicted quality of each ``[n]``.

    Returns:
        ``[h, w]``, numbered by area from the largest; -1 where no mask is.
    """
    masks = (logits > 0).flatten(1)
    strict, loose = (logits > 1).flatten(1).sum(1), (logits > -1).flatten(1).sum(1)
    good = (scores >= CONFIDENT) & (strict >= STABLE * loose) & masks.any(1)
    order = scores[good].argsort(descending=True, stable=True)
    masks = masks[good][order].float()
    kept = masks[_distinct(masks)].bool()
    found = np.full(logits[0].numel(), -1, np.int32)
    areas = kept.sum(1).argsort(descending=True, stable=True)
    for number, mask in enumerate(kept[areas].numpy()):
        found[mask] = number
    return found.reshape(logits.shape[1:])


def _distinct(masks: Tensor) -> list[int]:
    """Indices of the masks ``[n, pixels]`` that are not like one before."""
    shared, areas = masks @ masks.T, masks.sum(1)
    alike = shared > ALIKE * (areas[:, None] + areas - shared)
    kept: list[int] = []
    for index in range(len(masks)):
        if not bool(alike[index, kept].any()):
            kept.append(index)
    return kept
