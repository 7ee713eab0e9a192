"""``lexsplat demo``: the whole system on a bundled capture with bundled encoders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from lexsplat.evaluation.scenes import evaluate_scene
from lexsplat.language.methods import MethodName
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.rendering.backends import choose_rasterizer
from lexsplat.runtime.progress import Listener, silent
from lexsplat.scenes.scene import open_scene

CaptureName = Literal["tabletop", "second"]

CAPTURES = Path(__file__).resolve().parents[1] / "demo" / "captures"
"""Folder of the captures: ``images/``, ``sparse/0/``, ``segmentations/``, ``test_views.json``."""

DEMO_CONFIG = BuildConfig(clip="bundled", dino="bundled")
"""Settings of the demo; docs/results.md states on which views each setting was chosen."""


def demo_capture(capture: CaptureName = "tabletop") -> Path:
    """The folder of a bundled capture."""
    return CAPTURES / capture


def run_demo(
    output: Path,
    *,
    capture: CaptureName = "tabletop",
    method: MethodName | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    seed: int = 0,
    iterations: int | None = None,
    listener: Listener = silent,
) -> dict[str, Any]:
    """Build a bundled capture and evaluate the scene on its held-out views.

    Args:
        output: Scene folder to make or to resume.
        capture: Name of the bundled capture.
        method: Method of the language; None takes the default.
        device: Device to compute on (`choose_rasterizer`).
        seed: Seed of all randomness.
        iterations: Reconstruction steps; None takes what suits the device.
        listener: Receives progress events.

    Returns:
        The content of ``metrics.json``.
    """
    method, device = method or DEMO_CONFIG.method, choose_rasterizer(device)
    config = replace(DEMO_CONFIG, method=method, device=device, seed=seed, iterations=iterations)
    build(demo_capture(capture), output, config, listener=listener)
    opened = open_scene(output, device=device)
    return evaluate_scene(opened, title="lexsplat demo", listener=listener)
