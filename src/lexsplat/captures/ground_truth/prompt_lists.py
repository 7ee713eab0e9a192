"""The prompts of the paper's evaluation on Mip-NeRF 360: the supplement's list and the released code's.

The lists differ in 19 of 48 prompts, in capitals and in words ("curtain" and "silver gray curtain"). The authors'
masks are named after the released code's list; `prompt_names` maps file names from either list to one of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lexsplat.runtime.errors import CaptureError

PromptList = Literal["paper", "released"]

# By scene: the prompts of the supplement; after "=", the released code's spelling where it differs.
_TABLE = {
    "bicycle": """green grass, white bicycle, tire, bench, asphalt ground=Asphalt ground,
        silver oak tree=Silver Oak Tree""",
    "bonsai": """piano keyboard, bicycle, purple table cloth, black stool, plastic bonsai tree,
        dark grey patterned carpet""",
    "counter": """jar of coconut oil=Jar of coconut oil, fruit oranges, onions, plants,
        blue oven gloves=blue Oven Gloves, wood rolling pin=Wood Rolling Pin, free range eggs box,
        stable bread=stale bread, garofalo pasta=Garofalo pasta, napolina tomatoes=Napolina Tomatoes,
        gold ripple baking pan=gold Ripple Baking Pan""",
    "garden": """football, wood round table, green grass, wood pot, elderflower, green plant, bricks wall,
        windows, stone ground=Hexagonal Stone ground""",
    "kitchen": """LEGO Technic 856 Bulldozer, basket weave cloth=Basket Weave Cloth, wood plat=Wood plat,
        old pink striped cloth, red oven gloves=Red Oven Gloves""",
    "room": """blue grey chair, curtain=silver gray curtain, brown shoes, books=yellow books, windows,
        door=white wood door, piano keyboard, wood floor=yellow wood floors, wine glasses and bottles,
        yucca plant=green Yucca plant, deep green carpets=deep dark green carpets""",
}
_PROMPTS = {
    scene: [pair.strip().partition("=")[::2] for pair in prompts.split(",")]
    for scene, prompts in _TABLE.items()
}

SCENES = tuple(_PROMPTS)
"""The scenes of the paper's evaluation."""


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
    for paper, other in _PROMPTS[scene]:
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
