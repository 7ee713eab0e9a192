"""Ground truth of an evaluation: where it comes from, and its content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures import Capture
from lexsplat.captures.ground_truth.layouts import Annotations, load_annotations
from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.runtime.errors import CaptureError

Masks = Mapping[str, Mapping[str, "Path | NDArray[np.bool_]"]]
"""Ground truth by view and prompt: files or boolean arrays ``[H, W]``."""

Boxes = Mapping[str, Mapping[str, NDArray[np.float64]]]
"""Boxes ``[B, 4]`` (x0, y0, x1, y1 in pixels of the mask) by view and prompt."""


@dataclass(frozen=True)
class GroundTruthSource:
    """Where the ground truth of a capture is read from, and under which prompts.

    Args:
        masks: Folder with ground truth in any layout of `lexsplat.captures.ground_truth`; None takes the capture's.
        prompt_list: Use the prompts of the paper or of the released code, for captures named like its scenes.
    """

    masks: Path | None = None
    prompt_list: PromptList | None = None


@dataclass(frozen=True)
class GroundTruth:
    """Annotations that a scene is measured against.

    Args:
        masks: Masks by view and prompt. Those of training views are ignored.
        boxes: Boxes by view and prompt for LangSplat's localization; those of the masks stand in for missing ones.
        prompt_kinds: Kind of each prompt ("name", "color", "part", ...); adds the numbers of each kind.
    """

    masks: Masks
    boxes: Boxes = field(default_factory=dict)
    prompt_kinds: Mapping[str, str] = field(default_factory=dict)


def read_held_out(capture: Capture, source: GroundTruthSource) -> Annotations:
    """The ground truth of a capture, some of it of held-out views.

    Args:
        capture: The capture.
        source: Where its ground truth is read from.

    Raises:
        CaptureError: If no held-out view has any, or as `load_annotations`.
    """
    found = load_annotations(capture, source.masks, source.prompt_list)
    if any(found.masks.get(name) for name in capture.test_names):
        return found
    remedy = "draw some into segmentations/STEM/PROMPT.png (see docs/evaluation.md)"
    if source.masks is not None:
        remedy = "hold out the views that have ground truth: list them in test_views.json of the capture"
    if source.prompt_list is not None:
        remedy = "leave the prompt list out, or name the masks as the released code does"
    raise CaptureError(
        source.masks or capture.root,
        expected="masks of held-out views to measure against",
        found=f"none in the words of the list {source.prompt_list!r}" if source.prompt_list else "none",
        remedy=remedy,
    )
