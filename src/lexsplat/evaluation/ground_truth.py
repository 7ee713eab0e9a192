"""Ground truth of an evaluation: where it comes from, and its content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.ground_truth.prompt_lists import PromptList

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
