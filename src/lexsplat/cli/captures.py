"""Captures by name: a word stands for each bundled capture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from lexsplat.cli.options import note_hidden
from lexsplat.pipeline.config import BuildConfig

BUNDLED: dict[str, Literal["tabletop", "second"]] = {"demo": "tabletop", "second": "second"}
"""Names of the bundled captures by their words on the command line."""


def capture_and_settings(capture: str, settings: BuildConfig) -> tuple[Path, BuildConfig]:
    """The folder of a capture, and the settings to build it with.

    A word of `BUNDLED` stands for the bundled capture unless a folder has that name. Settings of a bundled capture
    that are left at their defaults become those of the demo: the bundled encoders.
    """
    path = Path(capture)
    if capture not in BUNDLED or path.exists():
        for word in BUNDLED:
            note_hidden(word, capture)
        return path, settings
    from lexsplat.evaluation.demo import DEMO_CONFIG, demo_capture

    changes: dict[str, Any] = {}
    for name in ("clip", "dino"):
        if getattr(settings, name) == getattr(BuildConfig(), name):
            changes[name] = getattr(DEMO_CONFIG, name)
    return demo_capture(BUNDLED[capture]), dataclasses.replace(settings, **changes)
