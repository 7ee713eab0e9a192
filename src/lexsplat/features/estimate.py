"""How long the encoders take for one photo, measured before a long build."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from lexsplat.features.checks import bundled_images
from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
from lexsplat.features.extraction import encoded_size
from lexsplat.features.pyramid import grid_levels, unique_boxes
from lexsplat.features.settings import FeatureConfig

_SHORT = 1.0  # seconds below which a measurement is repeated with more crops
_MOST_CROPS = 192


@dataclass(frozen=True)
class Estimate:
    """The work for one photo.

    Args:
        crops: Crops of it that CLIP encodes.
        seconds: Time for it, CLIP and DINO together.
    """

    crops: int
    seconds: float

    def describe(self, photos: int) -> str:
        """One line with the time of one photo and of several."""
        each = f"{self.seconds:.1f} s" if self.seconds < 60 else f"{self.seconds / 60:.1f} min"
        minutes, seconds = divmod(round(self.seconds * photos), 60)
        total = (
            f"{minutes // 60}:{minutes % 60:02}:{seconds:02} hours"
            if minutes >= 60
            else f"{minutes}:{seconds:02} min"
        )
        return f"{self.crops:,} crops and about {each} a photo; {total} for {photos:,} training photos"


def estimate(
    clip: ImageTextEncoder, dino: DenseEncoder | None, config: FeatureConfig, capture_size: tuple[int, int]
) -> Estimate:
    """Measure the encoders on bundled images and scale the time to a photo.

    Args:
        clip: Encoder of the crops.
        dino: Encoder of dense features; None for CLIP alone.
        config: Settings of the features.
        capture_size: Width and height of a photo.
    """
    crops = count_crops(config, capture_size)
    encode = clip.encode_images if config.tokens == "class" else clip.encode_patches
    images = bundled_images(clip.image_size)
    encode(images[:1])  # the first call takes longer
    while True:
        start = time.perf_counter()
        encode(images)
        seconds = time.perf_counter() - start
        if seconds > _SHORT or len(images) >= _MOST_CROPS:
            break
        images = images.repeat(4, 1, 1, 1)[:_MOST_CROPS]
    total = crops * seconds / len(images)
    if dino is not None:
        total += _dense_seconds(dino, config, capture_size)
    return Estimate(crops, total)


def count_crops(config: FeatureConfig, capture_size: tuple[int, int]) -> int:
    """Number of crops of a photo of this width and height."""
    if config.mode == "random":
        return config.random_crops
    levels = grid_levels(*encoded_size(capture_size, config), config.crop_sizes, config.crop_strides)
    return len(unique_boxes(levels)[0])


def _dense_seconds(dino: DenseEncoder, config: FeatureConfig, capture_size: tuple[int, int]) -> float:
    """Seconds of DINO for a photo: one pass on its own patch grid, times the number of shifted copies."""
    image = bundled_images(config.dino_short_side)[0]
    start = time.perf_counter()
    grid = dino.encode_dense(image, short_side=config.dino_short_side, max_tokens=config.dino_max_tokens)
    seconds = time.perf_counter() - start
    patch = config.dino_short_side / grid.shape[0]
    copies = np.ceil(patch / min(config.dino_stride, patch)) ** 2
    return float(seconds * copies * max(capture_size) / min(capture_size))
