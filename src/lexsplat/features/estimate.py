"""Time estimate of the encoders for one photo, measured before a long build."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.features.checks import WORDS, bundled_images
from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
from lexsplat.features.extraction import cpu_batch, crop_levels, encoded_size, parallel_views
from lexsplat.features.pretrained import resize_images
from lexsplat.features.pyramid import cut_crops, encode_stream, unique_boxes
from lexsplat.features.settings import FeatureConfig
from lexsplat.runtime.device import torch_threads
from lexsplat.runtime.progress import SHORTEST_FORECAST, duration

_SHORT = 0.5  # seconds below which a measurement is repeated with more crops
_MOST_CROPS = 256
_IMAGE = 256  # side of the bundled image that is resized to a photo


@dataclass(frozen=True)
class Estimate:
    """The work for one photo.

    Args:
        crops: Crops of it that CLIP encodes.
        seconds: Time for it, CLIP and DINO together.
    """

    crops: int
    seconds: float

    def describe(self, photos: int, *, at_most: bool = False) -> str:
        """One line with the time of one photo and of several, which may be more than are read."""
        each = f"{self.seconds:.1f} s" if self.seconds < 60 else f"{self.seconds / 60:.1f} min"
        seconds = self.seconds * photos
        total = duration(seconds) if seconds >= SHORTEST_FORECAST else f"{seconds:.1f} s"
        what = "training photo" if photos == 1 else "training photos"
        limit = "at most " if at_most else ""
        return f"{self.crops:,} crops and about {each} a photo; {limit}{total} for {photos:,} {what}"


def estimate(
    clip: ImageTextEncoder, dino: DenseEncoder | None, config: FeatureConfig, capture_size: tuple[int, int]
) -> Estimate:
    """Cut and encode some crops as the extraction does, and scale the time to a photo.

    On the CPU several photos are processed at once; the time of one is that of all of them divided by their number.

    Args:
        clip: Encoder of the crops.
        dino: Encoder of dense features; None for CLIP alone.
        config: Settings of the features.
        capture_size: Width and height of a photo.
    """
    photos = parallel_views(clip.device)
    with torch_threads(max(1, torch.get_num_threads() // photos)):
        seconds = _crop_seconds(clip, config, capture_size) * count_crops(config, capture_size)
        if dino is not None:
            seconds += _dense_seconds(dino, config, capture_size)
    return Estimate(count_crops(config, capture_size), seconds / photos)


def _crop_seconds(clip: ImageTextEncoder, config: FeatureConfig, capture_size: tuple[int, int]) -> float:
    """Seconds of one crop by one worker."""
    boxes, (width, height) = _boxes(config, capture_size), encoded_size(capture_size, config)
    image = resize_images(bundled_images(_IMAGE, WORDS[:1]), height, width)[0].to(clip.device)
    batch, count = cpu_batch(clip.image_size), 1
    encode = clip.encode_images if config.tokens == "class" else lambda crops: clip.encode_patches(crops)[0]

    def measure(count: int) -> float:
        # Not `evenly`: few boxes are repeated, so that always ``count`` crops are timed.
        chosen = boxes[np.linspace(0, len(boxes) - 1, count).round().astype(int)]
        start = time.perf_counter()
        list(encode_stream(encode, [((), cut_crops(image, chosen, clip.image_size, batch))], batch))
        return time.perf_counter() - start

    measure(count)  # the first call takes longer
    count = batch
    while (seconds := measure(count)) < _SHORT and count < _MOST_CROPS:
        count = min(_MOST_CROPS, 4 * count)
    return seconds / count


def _boxes(config: FeatureConfig, capture_size: tuple[int, int]) -> NDArray[np.int32]:
    """The crops of a photo of this width and height ``[n, 3]``."""
    return unique_boxes(crop_levels(encoded_size(capture_size, config), config, seed=0))[0]


def count_crops(config: FeatureConfig, capture_size: tuple[int, int]) -> int:
    """Number of crops of a photo of this width and height."""
    return config.random_crops if config.mode == "random" else len(_boxes(config, capture_size))


def _dense_seconds(dino: DenseEncoder, config: FeatureConfig, capture_size: tuple[int, int]) -> float:
    """Seconds of DINO for a photo: one pass on its own patch grid, times the number of shifted copies."""
    image = bundled_images(config.dino_short_side, WORDS[:1])[0]
    start = time.perf_counter()
    grid = dino.encode_dense(image, short_side=config.dino_short_side, max_tokens=config.dino_max_tokens)
    seconds = time.perf_counter() - start
    patch = config.dino_short_side / grid.shape[0]
    copies = np.ceil(patch / min(config.dino_stride, patch)) ** 2
    return float(seconds * copies * max(capture_size) / min(capture_size))
