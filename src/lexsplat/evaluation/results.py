"""Results of an evaluation: scores of each prompt in each view, and the content of ``metrics.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.evaluation.metrics import MaskScores, ThresholdCounts
from lexsplat.evaluation.protocols import Lerf2dScores, OfficialScores

THRESHOLD_KINDS = ("auto", "fixed", "oracle")


@dataclass(frozen=True)
class PairResult:
    """One prompt in one view.

    Args:
        counts: Pixel counts at 1001 thresholds; ``counts.at(threshold)`` has IoU, accuracy and precision.
        auto: Scores of the mask at the automatic threshold, which is not rounded.
        average_precision: Strict, in 0..1; NaN if the ground truth is empty.
        localization: 1 if the highest relevancy lies on the object, else 0; NaN if the ground truth is empty.
        official: Scores of the authors' protocol, if requested.
        lerf_2d: Scores of LangSplat's protocol, if requested.
        lerf_3d: IoU of the selected Gaussians' silhouette, if requested and the method scores Gaussians.
    """

    counts: ThresholdCounts
    auto: MaskScores
    average_precision: float
    localization: float
    official: OfficialScores | None = None
    lerf_2d: Lerf2dScores | None = None
    lerf_3d: float | None = None


Pairs = Mapping[str, Mapping[str, PairResult]]
"""``{view: {prompt: result}}``."""


@dataclass(frozen=True)
class ViewImages:
    """The images of one view, passed to an observer; arrays must not be changed.

    Args:
        name: Name of the view.
        photo: ``[H, W, 3]`` in 0..1, at the working size.
        image: The rendering, same shape.
        relevancy: ``[h, w]`` in 0..1 by prompt, at the size of the ground truth.
        ground_truth: Boolean ``[h, w]`` by prompt.
        thresholds: The automatic threshold by prompt.
    """

    name: str
    photo: NDArray[np.float32]
    image: NDArray[np.float32]
    relevancy: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    ground_truth: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    thresholds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Metrics:
    """All results. The first six attributes are the sections of ``metrics.json``.

    Args:
        quality: "psnr", "ssim", "lpips" (or None with "lpips_reason"), "per_view".
        language: "strict", "official", "lerf_2d", "lerf_3d", "per_prompt", "per_view", "form"; None for a scene
            without masks.
        speed: "render_fps" (color and the map of one prompt), "rgb_fps", "query_ms" (the map of one prompt in one
            view, including the rendering of the language), "stage_seconds" (empty until `with_facts`).
        size: "gaussians", "language_bytes", "gaussian_bytes", "peak_rss_bytes", "peak_gpu_bytes".
        config: Settings of the evaluation, and those of the build (`with_facts`).
        machine: Hardware and versions (`with_facts`).
        curves: Interpolated precision at the 101 recalls by prompt, over the pixels of all views.
        thresholds: ``{prompt: {kind: threshold}}``.
        pairs: ``{view: {prompt: PairResult}}``.
    """

    quality: dict[str, Any]
    language: dict[str, Any] | None
    speed: dict[str, Any]
    size: dict[str, Any]
    config: dict[str, Any]
    machine: dict[str, Any] = field(default_factory=dict)
    curves: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    thresholds: dict[str, dict[str, float]] = field(default_factory=dict)
    pairs: dict[str, dict[str, PairResult]] = field(default_factory=dict)

    def with_facts(
        self,
        *,
        stage_seconds: Mapping[str, float],
        settings: Mapping[str, Any],
        machine: Mapping[str, Any],
        stored_bytes: Mapping[str, int] | None = None,
    ) -> Metrics:
        """The same results with facts that are known, not measured.

        Args:
            stage_seconds: Time of each stage of the build.
            settings: Settings of the build, added to those of the evaluation.
            machine: Facts about the machine.
            stored_bytes: "language_bytes" and "gaussian_bytes" on disk; None keeps the size of the tensors.
        """
        return replace(
            self,
            speed={**self.speed, "stage_seconds": dict(stage_seconds)},
            size={**self.size, **(stored_bytes or {})},
            config={**self.config, **settings},
            machine=dict(machine),
        )

    def to_json(self) -> dict[str, Any]:
        """The content of ``metrics.json``: plain types, 6 decimals, None for NaN and infinity."""
        names = ("quality", "language", "speed", "size", "config", "machine")
        return {name: plain(getattr(self, name)) for name in names}


def plain(value: Any) -> Any:
    """Plain JSON data: 6 decimals, None for NaN and infinity, strings for paths."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return round(float(value), 6) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value
