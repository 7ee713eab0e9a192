"""What a notebook shows of a scene: a table of facts and its first view."""

from __future__ import annotations

from lexsplat.queries.notebook import facts_html, view_image
from lexsplat.scenes.scene import Scene


def scene_html(scene: Scene) -> str:
    """A scene as HTML."""
    segments, scale = scene.field.segments, scene.world.meters_per_unit
    facts = {
        "scene": scene.folder.root if scene.folder else None,
        "gaussians": f"{len(scene.gaussians):,}",
        "views": len(scene.views),
        "method": scene.field.method,
        "segments": None if segments is None else int(segments.levels.shape[1]),
        "text encoder": scene.clip,
        "scale": None if scale is None else f"one unit is {scale:.4g} m",
    }
    first = next(iter(scene.views), None)
    return facts_html(facts) + ("" if first is None else view_image(scene.gaussians, scene.camera(first)))
