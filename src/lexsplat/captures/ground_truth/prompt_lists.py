"""The prompts of the paper's evaluation on Mip-NeRF 360: the supplement's list and the released code's.

The lists differ in 19 of 48 prompts, in capitals and in words ("curtain" and "silver gray curtain"). The authors'
masks are named after the released code's list; `prompt_names` maps file names from either list to one of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lexsplat.runtime.errors import CaptureError

PromptList = Literal["paper", "released"]

_SAME = None
# By scene: the prompts of the supplement, and those of the released code where they differ.
_PROMPTS: dict[str, dict[str, str | None]] = {
    "bicycle": {
        "green grass": _SAME,
        "white bicycle": _SAME,
        "tire": _SAME,
        "bench": _SAME,
        "asphalt ground": "Asphalt ground",
        "silver oak tree": "Silver Oak Tree",
    },
    "bonsai": {
        "piano keyboard": _SAME,
        "bicycle": _SAME,
        "purple table cloth": _SAME,
        "black stool": _SAME,
        "plastic bonsai tree": _SAME,
        "dark grey patterned carpet": _SAME,
    },
    "counter": {
        "jar of coconut oil": "Jar of coconut oil",
        "fruit oranges": _SAME,
        "onions": _SAME,
        "plants": _SAME,
        "blue oven gloves": "blue Oven Gloves",
        "wood rolling pin": "Wood Rolling Pin",
        "free range eggs box": _SAME,
        "stable bread": "stale bread",
        "garofalo pasta": "Garofalo pasta",
        "napolina tomatoes": "Napolina Tomatoes",
        "gold ripple baking pan": "gold Ripple Baking Pan",
    },
    "garden": {
        "football": _SAME,
        "wood round table": _SAME,
        "green grass": _SAME,
        "wood pot": _SAME,
        "elderflower": _SAME,
        "green plant": _SAME,
        "bricks wall": _SAME,
        "windows": _SAME,
        "stone ground": "Hexagonal Stone ground",
    },
    "kitchen": {
        "LEGO Technic 856 Bulldozer": _SAME,
        "basket weave cloth": "Basket Weave Cloth",
        "wood plat": "Wood plat",
        "old pink striped cloth": _SAME,
        "red oven gloves": "Red Oven Gloves",
    },
    "room": {
        "blue grey chair": _SAME,
        "curtain": "silver gray curtain",
        "brown shoes": _SAME,
        "books": "yellow books",
        "windows": _SAME,
        "door": "white wood door",
        "piano keyboard": _SAME,
        "wood floor": "yellow wood floors",
        "wine glasses and bottles": _SAME,
        "yucca plant": "green Yucca plant",
        "deep green carpets": "deep dark green carpets",
    },
}

SCENES = tuple(_PROMPTS)
"""The scenes of the paper's evaluation."""


def prompts_of(scene: str, prompt_list: PromptList = "released") -> tuple[str, ...]:
    """The prompts of a scene.

    Raises:
        ValueError: If the scene or the list is unknown.
    """
    return tuple(dict.fromkeys(prompt_names(scene, prompt_list).values()))


def prompt_names(scene: str, prompt_list: PromptList) -> dict[str, str]:
    """A map from the prompts of both lists to those of one, for `Annotations.renamed`.

    Raises:
        ValueError: If the scene or the list is unknown.
    """
    if scene not in _PROMPTS or prompt_list not in ("paper", "released"):
        raise ValueError(
            f"prompt lists are paper and released, for {', '.join(SCENES)}; got {prompt_list!r} for {scene!r}"
        )
    names: dict[str, str] = {}
    for paper, other in _PROMPTS[scene].items():
        released = other or paper
        names |= dict.fromkeys((paper, released), paper if prompt_list == "paper" else released)
    return names


def capture_prompt_names(root: Path, prompt_list: PromptList) -> dict[str, str]:
    """`prompt_names` of the scene that a capture's folder is named after.

    Raises:
        CaptureError: If the folder is not named after a scene of the paper.
    """
    name = root.resolve().name
    if name not in SCENES:
        raise CaptureError(
            root,
            expected=f"a capture named {', '.join(SCENES)}, which have prompt lists",
            found=repr(name),
            remedy="omit the prompt list to use the file names of the masks as prompts",
        )
    return prompt_names(name, prompt_list)
