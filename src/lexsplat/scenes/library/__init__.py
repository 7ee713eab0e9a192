"""Many scenes, searched at once: which of them holds a thing, and where.

    library = lexsplat.open_library("rooms")
    library.add("scans/kitchen")
    for hit in library.search("fire extinguisher").hits:
        print(hit.scene, hit.present, hit.count)

`lexsplat.scenes.library.bounds` rules out scenes by their codes alone. The scenes that are left are answered from the
index where it suffices, else by the scene itself (`Scene.find`).
"""

from __future__ import annotations

from lexsplat.scenes.library.found import Found, Hit
from lexsplat.scenes.library.library import Library, open_library

__all__ = ["Found", "Hit", "Library", "open_library"]
