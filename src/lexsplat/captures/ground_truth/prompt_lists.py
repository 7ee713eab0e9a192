"""The prompts and test views of the paper's evaluation on Mip-NeRF 360: the supplement's and the released code's.

The two differ in 19 of 48 prompts: capitals, and words ("curtain" became "silver gray curtain"). The authors' masks
are named by the released code; `prompt_names` maps what a file is called, in the words of either, to one of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lexsplat.runtime.errors import CaptureError

PromptList = Literal["paper", "released"]

_SAME = None
# Scene to pairs: the words of the paper's supplement, and those of the released code where they differ.
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

# Scene to prefix, digits, and numbers of the test views of the released code.
_TEST_VIEWS: dict[str, tuple[str, str]] = {
    "bicycle": (
        "_DSC",
        "8683 8695 8705 8709 8713 8715 8721 8733 8738 8746 8751 8756 8776 8812 8824 8830 8836 8848 8872",
    ),
    "bonsai": (
        "DSCF",
        "5565 5575 5585 5595 5605 5615 5625 5635 5645 5655 5660 5675 5685 5695 5710 5720 5730 5740 5745 5755 5765 "
        "5775 5785 5790 5800 5810 5824 5838 5850",
    ),
    "counter": (
        "DSCF",
        "5857 5865 5875 5885 5895 5905 5915 5925 5935 5945 5955 5965 5975 5985 5995 6005 6015 6025 6035 6045 6055 "
        "6065 6075 6085",
    ),
    "garden": (
        "DSC0",
        "7956 7960 7970 7980 7990 8000 8010 8020 8030 8040 8050 8060 8070 8080 8090 8095 8120 8135",
    ),
    "kitchen": (
        "DSCF",
        "0660 0670 0680 0690 0700 0710 0720 0730 0740 0750 0760 0775 0785 0795 0805 0815 0822 0825 0835 0845 0855 "
        "0865 0880 0890 0900 0910 0920 0930",
    ),
    "room": (
        "DSCF",
        "4670 4680 4690 4700 4721 4730 4759 4770 4780 4795 4800 4816 4854 4867 4880 4908 4920 4925 4958",
    ),
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
    """What the mask files of a scene are called, in either list, to the words of one, for `Annotations.renamed`.

    Raises:
        ValueError: If the scene or the list is unknown.
    """
    if scene not in _PROMPTS or prompt_list not in ("paper", "released"):
        raise ValueError(
            f"prompt lists are paper and released, of {', '.join(SCENES)}; got {prompt_list!r} of {scene!r}"
        )
    names: dict[str, str] = {}
    for paper, other in _PROMPTS[scene].items():
        released = other or paper
        names |= dict.fromkeys((paper, released), paper if prompt_list == "paper" else released)
    return names


def capture_prompt_names(root: Path, prompt_list: PromptList) -> dict[str, str]:
    """`prompt_names` of the scene that a capture's folder is called after.

    Raises:
        CaptureError: If the folder is called like no scene of the paper.
    """
    name = root.resolve().name
    if name not in SCENES:
        raise CaptureError(
            root,
            expected=f"a capture called {', '.join(SCENES)}, which have prompt lists",
            found=repr(name),
            remedy="leave the prompt list out: prompts are then what the masks are called",
        )
    return prompt_names(name, prompt_list)


def evaluation_views(scene: str) -> tuple[str, ...]:
    """Stems of the test views of the released code, where masks were drawn.

    Raises:
        ValueError: If the scene is unknown.
    """
    if scene not in _TEST_VIEWS:
        raise ValueError(f"test views are known of {', '.join(SCENES)}; got {scene!r}")
    prefix, numbers = _TEST_VIEWS[scene]
    return tuple(prefix + number for number in numbers.split())
