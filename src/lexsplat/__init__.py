"""lexsplat: search a place with words.

    import lexsplat
    scene = lexsplat.open_scene("output/demo")
    apple = scene.find("red apple")

Everything else is imported from its module: ``from lexsplat.rendering import render``.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

# Without this, torch's OpenMP threads spin for a while after every operation, on the cores that the rasterizer needs
# next: measured on two cores, a backward pass takes 80 instead of 26 ms of CPU time. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from lexsplat.pipeline.build import build
    from lexsplat.queries.selection import Selection
    from lexsplat.scenes.scene import Scene, open_scene

__version__ = "0.1.0"

__all__ = ["Scene", "Selection", "__version__", "build", "open_scene"]

_HOMES = {
    "Scene": "lexsplat.scenes.scene",
    "Selection": "lexsplat.queries.selection",
    "build": "lexsplat.pipeline.build",
    "open_scene": "lexsplat.scenes.scene",
}
"""Public names and their modules, which are imported at first use: ``import lexsplat`` stays quick."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'lexsplat' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
