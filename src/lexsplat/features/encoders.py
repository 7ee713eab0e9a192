"""Encoders: images and texts to one space (CLIP, SigLIP), and images to dense features (DINO, DINOv2, DINOv3).

CLIP's own architecture and DINO's are computed by lexsplat, others by transformers. Every size (image, text length,
projection, patch) is read from the model's configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from lexsplat.features.clip import DEFAULT_CLIP, ClipEncoder
from lexsplat.features.dino import DEFAULT_DINO, DinoEncoder, Facet
from lexsplat.features.hub import model_folder


class ImageTextEncoder(Protocol):
    """Maps images and texts to unit vectors of one space."""

    name: str
    content_hash: str
    image_size: int
    dim: int
    device: torch.device

    @property
    def patches(self) -> int:
        """Patches along a side in `encode_patches`; 0 if the encoder has none."""

    def encode_images(self, images: Tensor) -> Tensor:
        """``[B, 3, h, w]`` in 0..1 to ``[B, D]``, float32 on the CPU, unit length."""

    def encode_patches(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """The same ``[B, D]``, and embeddings of the patches ``[B, P, P, D]``; see `ClipEncoder`."""

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length."""


class DenseEncoder(Protocol):
    """Maps an image to a grid of unit vectors."""

    name: str
    content_hash: str
    dim: int
    device: torch.device

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
        """``[3, h, w]`` in 0..1 to ``[h', w', D]``, float32 on the CPU, unit length; see `DinoEncoder`."""


def load_clip(name: str = DEFAULT_CLIP, device: torch.device | str = "cpu") -> ImageTextEncoder:
    """A CLIP-like encoder by name, folder, or "bundled".

    Raises:
        ModelError: If it is not available and cannot be downloaded, or is not a CLIP-like model.
    """
    return ClipEncoder(model_folder(name, "clip"), name, device)


def load_dino(name: str = DEFAULT_DINO, device: torch.device | str = "cpu") -> DenseEncoder:
    """A DINO-like encoder by name, folder, or "bundled".

    Raises:
        ModelError: If it is not available and cannot be downloaded, or is not a vision transformer.
    """
    return DinoEncoder(model_folder(name, "dino"), name, device)
