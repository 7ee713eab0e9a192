"""DINO and related models: from an image to a grid of features."""

from __future__ import annotations

import inspect
import re
import threading
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.pretrained import IMAGENET, PretrainedModel, check_images, normalization, resize_images
from lexsplat.features.towers import vision_transformer
from lexsplat.features.weights import load_weights, read_config

DEFAULT_DINO = "facebook/dino-vits8"
"""The DINO of the paper's released code."""

Facet = Literal["key", "token"]


class DinoEncoder(PretrainedModel):
    """A vision transformer: DINO (``vit``), DINOv2 with or without registers, DINOv3."""

    tower = "dino"
    _spare = r"(^|\.)(pooler\.|mask_token$|position_ids$)"

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        super().__init__(folder, name, device)
        config = self._model.config
        self._keys = _key_projections(self._model)
        if not self._keys or not isinstance(getattr(config, "patch_size", None), int):
            raise self._refusal(
                "a vision transformer such as DINO, DINOv2 or DINOv3 (ViT)",
                f"try {DEFAULT_DINO}, `--dino bundled` or `--dino none`",
            )
        self.patch_size = int(config.patch_size)
        self.dim = int(config.hidden_size)
        self.num_layers = len(self._keys)
        self._mean, self._std = normalization(folder, IMAGENET, self.device)
        self._caught = threading.local()  # each thread that evaluates the model captures its own keys
        for projection in self._keys:
            projection.register_forward_hook(self._catch)
        # Models that do not take this option interpolate always, or use rotary positions.
        taken = inspect.signature(self._model.forward).parameters
        self._options = {name: True for name in ("interpolate_pos_encoding",) if name in taken}

    def _own_model(self, folder: Path) -> Any:
        config = read_config(folder / "config.json", "a model configuration")
        if config.get("model_type") != "vit":
            return None
        return vision_transformer(config, load_weights(folder, self.name))

    @torch.inference_mode()
    def encode_dense(
        self,
        image: Tensor,
        *,
        short_side: int = 224,
        stride: int | None = None,
        facet: Facet = "key",
        layer: int | None = None,
        max_tokens: int = 4096,
    ) -> Tensor:
        """Dense features on a regular grid of cells that tiles the image.

        For a stride below the patch size, shifted copies of the image are evaluated on the model's own patch grid and
        the results interleaved. Patch centers then lie exactly on cell centers, and attention sees
        ``(patch / stride)**2`` times fewer tokens at once than with a smaller convolution stride.

        Args:
            image: ``[3, h, w]`` in 0..1.
            short_side: The image is resized to this many pixels on its short side (rounded to whole patches).
            stride: Most pixels of the resized image between cells; rounded down to a whole fraction of the patch
                size. None is the patch size.
            facet: "key": attention keys of a layer. "token": output tokens of the last layer.
            layer: Layer of the keys, 0-based; None is the last. Ignored for tokens.
            max_tokens: Most patches that attention sees at once; larger images are evaluated in overlapping windows.

        Returns:
            Features ``[h', w', D]``, float32 on the CPU, unit length.
        """
        check_images(image[None])
        if stride is not None and stride < 1:
            raise ValueError(f"stride must be at least 1, got {stride}")
        if facet not in ("key", "token"):
            raise ValueError(f"facet must be 'key' or 'token', got {facet!r}")
        if layer is not None and not -self.num_layers <= layer < self.num_layers:
            raise ValueError(f"layer must be below {self.num_layers}, got {layer}")
        patch = self.patch_size
        scale = short_side / min(image.shape[-2:])
        rows, cols = (max(1, round(length * scale / patch)) for length in image.shape[-2:])
        image = resize_images(image[None].to(self.device, torch.float32), rows * patch, cols * patch)
        pixels = (image - self._mean) / self._std
        phases = -(-patch // min(stride or patch, patch))
        # The shift of each phase aligns its patch centers with cell centers of the fine grid.
        shifts = [round((phase + 0.5) * patch / phases - patch / 2) for phase in range(phases)]
        margin = max(abs(shift) for shift in shifts)
        padded = F.pad(pixels, (margin, margin, margin, margin), mode="replicate")
        fine = torch.empty(rows, phases, cols, phases, self.dim)
        for i, down in enumerate(shifts):
            for j, right in enumerate(shifts):
                top, left = margin + down, margin + right
                shifted = padded[..., top : top + rows * patch, left : left + cols * patch]
                fine[:, i, :, j] = self._windowed(shifted, facet, layer, max_tokens)
        return F.normalize(fine.reshape(rows * phases, cols * phases, self.dim), dim=-1)

    def _windowed(self, pixels: Tensor, facet: Facet, layer: int | None, max_tokens: int) -> Tensor:
        """Patch features ``[rows, cols, D]`` of ``[1, 3, H, W]``, at most ``max_tokens`` patches at once."""
        patch = self.patch_size
        rows, cols = pixels.shape[-2] // patch, pixels.shape[-1] // patch
        if rows * cols <= max_tokens:
            return self._forward(pixels, facet, layer)
        side = max(1, int(max_tokens**0.5))
        height = min(rows, max(side, max_tokens // cols))
        width = min(cols, max(1, max_tokens // height))
        total = torch.zeros(rows, cols, self.dim)
        weight = torch.zeros(rows, cols, 1)
        ramp = torch.minimum(_ramp(height)[:, None], _ramp(width)[None, :])[..., None]
        for top in _window_starts(rows, height):
            for left in _window_starts(cols, width):
                window = pixels[
                    ..., top * patch : (top + height) * patch, left * patch : (left + width) * patch
                ]
                features = F.normalize(self._forward(window, facet, layer), dim=-1)
                total[top : top + height, left : left + width] += ramp * features
                weight[top : top + height, left : left + width] += ramp
        return total / weight

    def _catch(self, projection: torch.nn.Module, inputs: Any, output: Tensor) -> None:
        if getattr(self._caught, "layer", None) is projection:
            self._caught.keys = output

    def _forward(self, pixels: Tensor, facet: Facet, layer: int | None) -> Tensor:
        """Patch features ``[rows, cols, D]`` of one forward pass on ``[1, 3, H, W]``."""
        rows, cols = pixels.shape[-2] // self.patch_size, pixels.shape[-1] // self.patch_size
        self._caught.layer = self._keys[-1 if layer is None else layer] if facet == "key" else None

        def compute() -> Tensor:
            tokens = self._model(pixel_values=pixels, **self._options).last_hidden_state
            return self._caught.__dict__.pop("keys").reshape(1, -1, self.dim) if facet == "key" else tokens

        tokens = self._finite(compute)
        # The class token and registers come first in all these models; the patches are the last rows * cols.
        return tokens[0, -rows * cols :].reshape(rows, cols, self.dim).float().cpu()


def _key_projections(model: torch.nn.Module) -> list[torch.nn.Module]:
    """The linear layers that compute attention keys, by layer; their name depends on the version of transformers."""
    found = {}
    for path, module in model.named_modules():
        if match := re.search(r"(?:^|\.)layers?\.(\d+)\..*\b(?:k_proj|key)$", path):
            found[int(match.group(1))] = module
    return [found[index] for index in sorted(found)]


def _ramp(length: int) -> Tensor:
    """Positive weights that decrease towards both ends, so that windows blend without seams."""
    position = torch.arange(length, dtype=torch.float32)
    return torch.minimum(position, length - 1 - position) + 1


def _window_starts(total: int, window: int) -> list[int]:
    """Starts of windows that cover ``total`` evenly; several overlap by at least a quarter."""
    if window >= total:
        return [0]
    step = max(1, window - max(1, window // 4))
    count = -(-(total - window) // step) + 1
    return [round(index * (total - window) / (count - 1)) for index in range(count)]
