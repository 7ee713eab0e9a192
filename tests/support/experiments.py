"""Settings of a small build that tests can repeat."""

from __future__ import annotations

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureConfig
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.pipeline.config import BuildConfig

CONFIG = BuildConfig(
    clip="color",
    dino="color",
    device="cpu",
    downscale=2.0,
    iterations=20,
    method="trained",
    features=FeatureConfig(crop_sizes=(0.25, 0.4), crop_strides=(0.5, 0.5), map_cells=18),
    codebook=CodebookConfig(num_codes=6, steps=3),
    trained=TrainedConfig(iterations=4, pixel_sample=256, smoothing_sample=256),
)
