"""Checks of loaded encoders on images that ship with the package."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
from lexsplat.features.pretrained import resize_images
from lexsplat.runtime.errors import ModelError

CAPTURE = Path(__file__).resolve().parents[1] / "demo" / "captures" / "tabletop"
"""A bundled capture with masks of what its photos show."""

PLACES = {
    "red apple": ("view_015", (92, 162, 185, 251)),
    "blue mug": ("view_057", (190, 154, 262, 232)),
    "gold ring": ("view_015", (338, 244, 421, 294)),
    "brown teddy bear": ("view_051", (87, 66, 193, 213)),
    "green bottle": ("view_057", (2, 51, 54, 163)),
    "rubber duck": ("view_051", (268, 198, 384, 268)),
    "stack of books": ("view_015", (358, 141, 480, 226)),
    "traffic cone": ("view_003", (26, 179, 119, 285)),
    "potted plant": ("view_057", (178, 25, 314, 143)),
    "table lamp": ("view_033", (394, 36, 475, 136)),
    "banana": ("view_015", (47, 225, 176, 290)),
    "pumpkin": ("view_057", (278, 135, 358, 202)),
}
"""For a word, the first bundled photo where its mask is widest, and the box around it (left, top, right, bottom)."""

WORDS = tuple(PLACES)
"""Content of the images."""

ENOUGH = 0.75
"""Least share of the other words that rank below the right one; 0.5 is chance."""

ENOUGH_TILES = 0.8
"""The same for tiles of photos: features of the bundled encoder reach 0.96, mirrored maps and features with
permuted channels 0.77 at most."""
_TILES = (3, 4)
"""Rows and columns of tiles of a photo."""
_MARGIN = 1.2  # side of an image, in sides of the box around what it shows


def bundled_images(side: int, words: Sequence[str] = WORDS) -> Tensor:
    """Square images of words, where each is widest in the bundled photos: ``[W, 3, side, side]`` in 0..1."""
    photos = {name: _photo(name) for name in {PLACES[word][0] for word in words}}
    return torch.cat([_cut(photos[name], box, side) for name, box in map(PLACES.__getitem__, words)])


def _photo(name: str) -> Tensor:
    with Image.open(CAPTURE / "images" / f"{name}.jpg") as photo:
        return torch.from_numpy(np.asarray(photo.convert("RGB"), dtype=np.float32) / 255).permute(2, 0, 1)


def _cut(image: Tensor, box: tuple[int, int, int, int], side: int) -> Tensor:
    half = _MARGIN * max(box[2] - box[0], box[3] - box[1]) / 2
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    top, left = max(0, round(y - half)), max(0, round(x - half))
    crop = image[:, top : round(y + half), left : round(x + half)]
    return resize_images(crop[None], side, side)


def rank_words(clip: ImageTextEncoder, *, patches: bool = False) -> float:
    """How well words match images: the mean share of the other words that rank below the right one, in 0..1.

    Args:
        clip: The encoder.
        patches: Compare the mean of an image's patches instead of its class token.

    Raises:
        ModelError: If the two towers give embeddings of different sizes, or equal embeddings to different images.
    """
    shown, texts = bundled_images(clip.image_size), clip.encode_text(WORDS)
    images = clip.encode_patches(shown)[1].mean((1, 2)) if patches else clip.encode_images(shown)
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


def check_words(clip: ImageTextEncoder, *, patches: bool = False) -> float:
    """`rank_words`, at least `ENOUGH`.

    Raises:
        ModelError: If words rank little better than by chance, or as `rank_words`.
    """
    right = rank_words(clip, patches=patches)
    if right < ENOUGH:
        read, other = (
            (" at their patches", "; or read class tokens: `--features.crop-tokens class`")
            if patches
            else ("", "")
        )
        raise ModelError(
            f"model {clip.name}",
            expected=f"words that match the bundled images{read} (at least {ENOUGH:.2f} of the others rank lower)",
            found=f"{right:.2f}, where chance is 0.50",
            remedy=f"choose another model{other}",
        )
    return right


def rank_tiles(clip: ImageTextEncoder, photos: Iterable[Tensor], maps: Iterable[Tensor]) -> float:
    """How well feature maps of another program are of an encoder: what `rank_words` is, for tiles of photos.

    A tile's embedding by the encoder is compared with the mean features of each tile. What all have in common does
    not count.

    Args:
        clip: The encoder.
        photos: A few photos ``[3, H, W]`` in 0..1.
        maps: Their features ``[h, w, D]``, D as of the encoder.

    Returns:
        The mean share of the other tiles that rank below the right one, in 0..1; 0.5 is chance.
    """
    rows, columns = _TILES
    tiles, means = [], []
    for photo, features in zip(photos, maps, strict=True):
        for row in range(rows):
            for column in range(columns):
                tile = _part(photo.permute(1, 2, 0), row / rows, column / columns).permute(2, 0, 1)
                tiles.append(resize_images(tile[None], clip.image_size, clip.image_size))
                means.append(_part(features, row / rows, column / columns).mean((0, 1)))
    own, given = clip.encode_images(torch.cat(tiles)), torch.stack(means)
    own, given = (F.normalize(each - each.mean(0), dim=1) for each in (own, given))
    similarity = own @ given.T
    below = (similarity < similarity.diagonal()[:, None]).sum(1)
    return float(below.double().mean()) / (len(own) - 1)


def _part(image: Tensor, top: float, left: float) -> Tensor:
    """The tile of an image ``[H, W, C]`` that begins at shares of its sides; of a small one at least a pixel."""
    (height, width, _), (rows, columns) = image.shape, _TILES
    y, x = int(top * height), int(left * width)
    return image[y : max(y + 1, y + height // rows), x : max(x + 1, x + width // columns)]


def check_dense(dino: DenseEncoder) -> None:
    """Check that a dense encoder gives different features to different places of an image.

    Raises:
        ModelError: If it does not.
    """
    features = dino.encode_dense(bundled_images(96, WORDS[:1])[0], short_side=96)
    _check_unlike(features.flatten(0, 1)[:: max(1, features.shape[1] + 1)], dino.name)


def _check_unlike(features: Tensor, name: str) -> None:
    if float(torch.pdist(features).max()) < 1e-4:
        raise ModelError(
            f"model {name}",
            expected="different features for different images",
            found="the same for all",
            remedy="fetch the whole model again, or choose another model",
        )
