"""Captures by name: the scenes that ship stand beside folders."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from lexsplat.pipeline.config import BuildConfig

BUNDLED = ("demo", "second")
"""Captures that ship with the package, by name."""


def capture_and_settings(capture: str, settings: BuildConfig) -> tuple[Path, BuildConfig]:
    """The folder of a capture; the words of `BUNDLED` stand for the bundled ones, with the demo's settings."""
    path = Path(capture)
    if capture not in BUNDLED or path.exists():
        return path, settings
    from lexsplat.evaluation.demo import DEMO_CONFIG, demo_capture

    changes: dict[str, Any] = {}
    for name in ("clip", "dino", "codebook"):
        if getattr(settings, name) == getattr(BuildConfig(), name):
            changes[name] = getattr(DEMO_CONFIG, name)
    folder = demo_capture("tabletop" if capture == "demo" else "second")
    return folder, dataclasses.replace(settings, **changes)
