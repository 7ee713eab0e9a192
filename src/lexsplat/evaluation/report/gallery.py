"""Small images of an evaluation, collected while it runs."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lexsplat.evaluation.results import ViewImages
from lexsplat.queries.heatmaps import overlay_heatmap, overlay_mask


@dataclass
class Gallery:
    """Collects small images while a scene is evaluated: pass `add` as the observer.

    Args:
        width: Width of an image in pixels.
        views: ``{view: {"photo" | "render" | "features": JPEG}}``.
        cases: ``{(view, prompt): {"heatmap" | "mask" | "ground_truth": JPEG}}``.
    """

    width: int = 300
    views: dict[str, dict[str, bytes]] = field(default_factory=dict)
    cases: dict[tuple[str, str], dict[str, bytes]] = field(default_factory=dict)

    def add(self, view: ViewImages) -> None:
        """Store thumbnails of a view and of all its prompts."""
        self.views[view.name] = {
            "photo": self._jpeg(_to_bytes(view.photo)),
            "render": self._jpeg(_to_bytes(view.image)),
        }
        shapes = {relevancy.shape for relevancy in view.relevancy.values()}
        pictures = {
            shape: tuple(_fit(_to_bytes(side), shape) for side in (view.image, view.photo))
            for shape in shapes
        }
        for prompt, relevancy in view.relevancy.items():
            image, photo = pictures[relevancy.shape]
            self.cases[view.name, prompt] = {
                "heatmap": self._jpeg(overlay_heatmap(image, relevancy)),
                "mask": self._jpeg(overlay_mask(image, relevancy >= view.thresholds[prompt])),
                "ground_truth": self._jpeg(
                    overlay_mask(photo, view.ground_truth[prompt], color=(64, 200, 140))
                ),
            }

    def add_features(self, view: str, picture: NDArray[np.float32]) -> None:
        """Store a thumbnail of the language features of a view ``[H, W, 3]`` in 0..1."""
        self.views[view]["features"] = self._jpeg(_to_bytes(picture))

    def tensors(self) -> dict[str, Tensor]:
        """All JPEGs by name as uint8 tensors, for safetensors."""
        stored = {
            f"view/{kind}/{view}": jpeg for view, kinds in self.views.items() for kind, jpeg in kinds.items()
        }
        for (view, prompt), kinds in self.cases.items():
            stored |= {f"case/{kind}/{view}\n{prompt}": jpeg for kind, jpeg in kinds.items()}
        return {name: torch.frombuffer(bytearray(jpeg), dtype=torch.uint8) for name, jpeg in stored.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Gallery:
        """The inverse of `tensors`.

        Raises:
            ValueError: If a name was not written by `tensors`.
        """
        gallery = cls()
        for name, tensor in tensors.items():
            part, kind, place = name.split("/", 2)
            jpeg = tensor.numpy().tobytes()
            if part == "view":
                gallery.views.setdefault(place, {})[kind] = jpeg
            else:
                view, prompt = place.split("\n", 1)
                gallery.cases.setdefault((view, prompt), {})[kind] = jpeg
        return gallery

    def _jpeg(self, pixels: NDArray[np.uint8]) -> bytes:
        height = max(1, round(pixels.shape[0] * self.width / pixels.shape[1]))
        image = Image.fromarray(pixels).resize(
            (self.width, height), Image.Resampling.LANCZOS, reducing_gap=3.0
        )
        buffer = io.BytesIO()
        image.save(buffer, format="JPEG", quality=82)
        return buffer.getvalue()


def _to_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (np.clip(image, 0, 1) * 255).round().astype(np.uint8)


def _fit(image: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if image.shape[:2] == shape:
        return image
    return np.asarray(Image.fromarray(image).resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
