"""Ground truth of an evaluation: where it comes from."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lexsplat.captures import Capture, View
from lexsplat.captures.ground_truth.layouts import Annotations, load_annotations, load_ground_truth
from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.runtime.errors import CaptureError

log = logging.getLogger("lexsplat")


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


def warn_of_odd_masks(ground_truth: Annotations, views: Sequence[View]) -> None:
    """Warn of masks of some views that cover no pixel, and of prompts that differ only in case or spaces."""
    pairs = [(view, *pair) for view in views for pair in ground_truth.masks.get(view.name, {}).items()]
    empty = [
        f"{prompt!r} in {mask if isinstance(mask, Path) else view.name}"
        for view, prompt, mask in pairs
        if not load_ground_truth(view, mask).any()
    ]
    if empty:
        log.warning(
            "%s: %d masks cover no pixel: %s; they count as things that are not visible (docs/evaluation.md)",
            ground_truth.origin,
            len(empty),
            ", ".join(empty[:3]) + (" and more" if len(empty) > 3 else ""),
        )
    spellings: dict[str, list[str]] = {}
    for prompt in sorted({prompt for _, prompt, _ in pairs}):
        spellings.setdefault(" ".join(prompt.lower().split()), []).append(prompt)
    for same in spellings.values():
        if len(same) > 1:
            told = (
                "%s: %s differ only in case or spaces and are measured as different prompts: write them alike"
            )
            log.warning(told, ground_truth.origin, " and ".join(map(repr, same)))
