"""lexsplat: search a place with words.

    import lexsplat
    scene = lexsplat.open_scene("output/demo")
    apple = scene.find("red apple")

Everything else is imported from its module: ``from lexsplat.rendering import render``.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from lexsplat.runtime.lazy import at_first_use

# Without this, torch's OpenMP threads spin for a while after every operation, on the cores that the rasterizer needs
# next: measured on two cores, a backward pass takes 80 instead of 26 ms of CPU time. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from lexsplat.pipeline.build import build
    from lexsplat.queries.selection import Selection
    from lexsplat.scenes.library import Library, open_library
    from lexsplat.scenes.scene import Scene, open_scene

__version__ = "0.1.0"

__all__ = ["Library", "Scene", "Selection", "__version__", "build", "open_library", "open_scene"]

__getattr__ = at_first_use(
    "lexsplat",
    {
        "scenes.library": ("Library", "open_library"),
        "scenes.scene": ("Scene", "open_scene"),
        "queries.selection": ("Selection",),
        "pipeline.build": ("build",),
    },
)


def __dir__() -> list[str]:
    return sorted(__all__)
