"""Small images of an evaluation, collected while it runs."""

from __future__ import annotations

import io
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lexsplat.evaluation.metrics import resize_scores
from lexsplat.evaluation.results import ViewImages
from lexsplat.queries.heatmaps import overlay_heatmap, overlay_mask
from lexsplat.runtime.device import kernel_threads


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
        photo, image = (self._small(_to_bytes(side)) for side in (view.photo, view.image))
        self.views[view.name] = {"photo": _jpeg(photo), "render": _jpeg(image)}
        height, width = image.shape[:2]

        def case(prompt: str) -> dict[str, bytes]:
            # Maps are made small before they are colored: three times as fast as small pictures of large ones.
            relevancy = view.relevancy[prompt]
            heat = resize_scores(relevancy, width, height)
            mask, ground_truth = (
                resize_scores(part, width, height) >= 0.5
                for part in (relevancy >= view.thresholds[prompt], view.ground_truth[prompt])
            )
            return {
                "heatmap": _jpeg(overlay_heatmap(image, heat)),
                "mask": _jpeg(overlay_mask(image, mask)),
                "ground_truth": _jpeg(overlay_mask(photo, ground_truth, color=(64, 200, 140))),
            }

        with ThreadPoolExecutor(kernel_threads()) as pool:  # coloring and compressing release the GIL
            for prompt, pictures in zip(view.relevancy, pool.map(case, view.relevancy)):
                self.cases[view.name, prompt] = pictures

    def add_features(self, view: str, picture: NDArray[np.float32]) -> None:
        """Store a thumbnail of the language features of a view ``[H, W, 3]`` in 0..1."""
        self.views[view]["features"] = _jpeg(self._small(_to_bytes(picture)))

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

    def _small(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        height = max(1, round(pixels.shape[0] * self.width / pixels.shape[1]))
        image = Image.fromarray(pixels)
        return np.asarray(image.resize((self.width, height), Image.Resampling.LANCZOS, reducing_gap=3.0))


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=82)
    return buffer.getvalue()


def _to_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (np.clip(image, 0, 1) * 255).round().astype(np.uint8)
