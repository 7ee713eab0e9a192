"""Settings of a small build that tests can repeat, and experiments with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lexsplat.codebook import CodebookConfig
from lexsplat.evaluation import EvaluationConfig
from lexsplat.evaluation.ablate import ablate, paper_evaluation
from lexsplat.evaluation.compare import compare
from lexsplat.evaluation.experiments import Bench
from lexsplat.features import FeatureConfig
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.pipeline.config import BuildConfig

CONFIG = BuildConfig(
    clip="color",
    dino="color",
    device="cpu",
    downscale=3.0,
    iterations=20,
    method="trained",
    features=FeatureConfig(crop_sizes=(0.25, 0.4), crop_strides=(0.5, 0.5), map_cells=18),
    codebook=CodebookConfig(num_codes=6, steps=3),
    trained=TrainedConfig(iterations=4, pixel_sample=256, smoothing_sample=256),
)


def ablated(
    capture: Path, output: Path, config: BuildConfig, plan: Any = None, ground_truth: Any = None
) -> list:
    """The rows of an ablation on a bench of its own."""
    return ablate(Bench(capture, output, config, paper_evaluation(), ground_truth), plan)


def compared(
    capture: Path,
    output: Path,
    config: BuildConfig,
    plan: Any = None,
    evaluation: EvaluationConfig | None = None,
) -> list:
    """The rows of a comparison on a bench of its own."""
    return compare(Bench(capture, output, config, evaluation or EvaluationConfig()), plan)
