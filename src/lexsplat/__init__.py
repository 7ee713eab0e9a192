"""lexsplat: search a place with words.

    import lexsplat
    scene = lexsplat.open_scene("output/demo")
    scores = scene.scores(["red apple"])

Everything else is imported from its module: ``from lexsplat.rendering import render``.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

# torch's OpenMP threads would spin for a while after every operation, on the cores that our kernels need next:
# measured on two cores, 80 instead of 26 ms of CPU time for a backward pass. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene, open_scene

__version__ = "0.1.0"

__all__ = ["Scene", "__version__", "open_scene"]


def __getattr__(name: str) -> Any:
    # Loaded when first used, so that `import lexsplat` and `lexsplat --help` stay quick.
    if name in ("open_scene", "Scene"):
        from lexsplat.scenes import scene

        return getattr(scene, name)
    raise AttributeError(f"module 'lexsplat' has no attribute {name!r}")
