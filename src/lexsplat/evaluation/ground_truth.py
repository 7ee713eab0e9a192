"""Ground truth of an evaluation: where it comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lexsplat.captures import Capture
from lexsplat.captures.ground_truth.layouts import Annotations, load_annotations
from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.runtime.errors import CaptureError


@dataclass(frozen=True)
class GroundTruthSource:
    """Where the ground truth of a capture is read from, and under which prompts.

    Args:
        masks: Folder with ground truth in any layout of `lexsplat.captures.ground_truth`; None takes the capture's.
        prompt_list: Use the prompts of the paper or of the released code, for captures named like its scenes.
    """

    masks: Path | None = None
    prompt_list: PromptList | None = None


def read_held_out(capture: Capture, source: GroundTruthSource) -> Annotations:
    """The ground truth of a capture, some of it of held-out views.

    Args:
        capture: The capture.
        source: Source of its ground truth.

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
        remedy = "leave the prompt list out, or name the files of the ground truth as the released code does"
    raise CaptureError(
        source.masks or capture.root,
        expected="ground truth of held-out views",
        found=f"none in the words of the list {source.prompt_list!r}" if source.prompt_list else "none",
        remedy=remedy,
    )
