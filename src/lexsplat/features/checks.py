"""Checks of loaded encoders on images that ship with the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
from lexsplat.features.pretrained import resize_images
from lexsplat.runtime.errors import ModelError

CAPTURE = Path(__file__).resolve().parents[1] / "demo" / "captures" / "tabletop"
"""A bundled capture with masks of what its photos show."""

WORDS = (
    "red apple", "blue mug", "gold ring", "brown teddy bear", "green bottle", "rubber duck", "stack of books",
    "traffic cone", "potted plant", "table lamp", "banana", "pumpkin",
)  # fmt: skip
"""Content of the images."""

ENOUGH = 0.75
"""Least share of the other words that rank below the right one; 0.5 is chance."""

_MARGIN = 1.2  # side of an image, in sides of the box around what it shows


def bundled_images(side: int) -> Tensor:
    """Square images of `WORDS`, where each is largest in the bundled photos: ``[W, 3, side, side]`` in 0..1."""
    return torch.cat([_bundled_image(word, side) for word in WORDS])


def _bundled_image(word: str, side: int) -> Tensor:
    best, box = Path(), (0, 0, 0, 0)
    for path in sorted(CAPTURE.glob(f"segmentations/*/{word.replace(' ', '_')}.png")):
        with Image.open(path) as mask:
            found = mask.convert("L").getbbox() or (0, 0, 0, 0)
        if found[2] - found[0] > box[2] - box[0]:
            best, box = path, found
    with Image.open(CAPTURE / "images" / f"{best.parent.name}.jpg") as photo:
        image = torch.from_numpy(np.asarray(photo.convert("RGB"), dtype=np.float32) / 255).permute(2, 0, 1)
    half = _MARGIN * max(box[2] - box[0], box[3] - box[1]) / 2
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    top, left = max(0, round(y - half)), max(0, round(x - half))
    crop = image[:, top : round(y + half), left : round(x + half)]
    return resize_images(crop[None], side, side)


def rank_words(clip: ImageTextEncoder) -> float:
    """How well words match images: the mean share of the other words that rank below the right one, in 0..1.

    Raises:
        ModelError: If the two towers give embeddings of different sizes, or equal embeddings to different images.
    """
    images, texts = clip.encode_images(bundled_images(clip.image_size)), clip.encode_text(WORDS)
    if images.shape[1] != texts.shape[1]:
        raise ModelError(
            f"model {clip.name}",
            expected="image and text embeddings of one size",
            found=f"{images.shape[1]} and {texts.shape[1]} numbers",
            remedy="choose another model",
        )
    _check_unlike(images, clip.name)
    similarity = images @ texts.T
    below = (similarity < similarity.diagonal()[:, None]).sum(1)
    return float(below.double().mean()) / (len(WORDS) - 1)


def check_words(clip: ImageTextEncoder) -> float:
    """`rank_words`, at least `ENOUGH`.

    Raises:
        ModelError: If words rank little better than by chance, or as `rank_words`.
    """
    right = rank_words(clip)
    if right < ENOUGH:
        raise ModelError(
            f"model {clip.name}",
            expected=f"words that match the bundled images (at least {ENOUGH:.2f} of the others rank lower)",
            found=f"{right:.2f}, where chance is 0.50",
            remedy="choose another model",
        )
    return right


def check_dense(dino: DenseEncoder) -> None:
    """Check that a dense encoder gives different features to different places of an image.

    Raises:
        ModelError: If it does not.
    """
    features = dino.encode_dense(bundled_images(96)[0], short_side=96)
    _check_unlike(features.flatten(0, 1)[:: max(1, features.shape[1] + 1)], dino.name)


def _check_unlike(features: Tensor, name: str) -> None:
    if float(torch.pdist(features).max()) < 1e-4:
        raise ModelError(
            f"model {name}",
            expected="different features for different images",
            found="the same for all",
            remedy="fetch the whole model again, or choose another model",
        )
