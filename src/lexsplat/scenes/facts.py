"""Facts about a scene folder, read from its records: nothing of the scene itself is loaded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from lexsplat.geometry.world import world_of
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import REBUILD
from lexsplat.scenes.unsaved import discarding, outdated_steps, saving, unsaved_steps

NO_SEGMENTS = (
    "single Gaussians answer; lexsplat language CAPTURE --output SCENE, with the options of the build, adds segments"
    " (method averaged) to a scene without edits"
)
"""A note on a scene without segments: the consequence, and how to add them."""


def is_of_chosen_views(record: Mapping[str, Any]) -> bool:
    """Whether the views of a scene were chosen from splats that came without a capture."""
    rendered = record.get("capture") is None and record.get("images") == "poses/images"
    return rendered and "up" in record["stages"].get("views", {})


def _chosen_views(record: Mapping[str, Any]) -> dict[str, Any] | None:
    """The splats from which the views of a scene were chosen, and their coverage; None for photos."""
    if not is_of_chosen_views(record):
        return None
    names = ("splats", "views", "candidates", "visible", "unseen", "floaters")
    return {name: record["stages"]["views"].get(name) for name in names}


def version_notes(folder: SceneFolder, given: str = "") -> Iterator[str]:
    """What the scene that answers does not hold, a rebuild or steps of an edit, and what to do about it.

    Args:
        folder: The scene folder.
        given: How the user named the scene, if not by its folder.
    """
    named = given or ("demo" if folder.is_bundled else str(folder.root))

    def steps(count: int) -> str:
        return "1 step of lexsplat edit" if count == 1 else f"{count:,} steps of lexsplat edit"

    if folder.content != folder.root:
        yield f"this is the scene before a rebuild, which {REBUILD}"
    if count := unsaved_steps(folder):
        yield f"{steps(count)} {'is' if count == 1 else 'are'} not in this scene; {saving(named, count)}"
    if count := outdated_steps(folder):
        yield f"{steps(count)} {discarding(named, count)}"


def scene_facts(folder: SceneFolder) -> dict[str, Any]:
    """The document of ``lexsplat info --json``: facts about a scene folder."""
    record = folder.record
    views = folder.read_cameras()
    splits = [view.split for view in views.values()]
    sizes = sorted({f"{view.camera.width}x{view.camera.height}" for view in views.values()})
    config = record.get("config", {})
    stages = record["stages"]
    language = stages.get("language", {})
    codes = language if "codes" in language else stages.get("codebook", {})  # the stage that found them
    return {
        "scene": str(folder.root),
        "capture": record.get("capture"),
        "chosen_views": _chosen_views(record),
        "views": {
            "training": splits.count("train"),
            "held out": splits.count("test"),
            **(
                {"with features": stages["features"]["views"]}
                if "views" in stages.get("features", {})
                else {}
            ),
        },
        "size": ", ".join(sizes),
        **world_of(record, {name: view.camera for name, view in views.items()}).to_json(),
        "finished": ", ".join(stages) or "nothing yet",
        "seconds": folder.stage_seconds(),
        "gaussians": stages.get("reconstruct", {}).get("gaussians"),
        "codes": codes.get("codes"),
        "codes_used": codes.get("codes_used"),
        "segments": language.get("segments"),
        "language_levels": language.get("levels", 1) if language else None,
        "unseen": language.get("unseen"),
        "method": language.get("method"),
        "clip": config.get("clip"),
        "dino": config.get("dino")
        if stages.get("features", {}).get("dino", "codebook" in stages)
        else "not used",
        "gaussian_bytes": folder.bytes_on_disk(folder.gaussians_path),
        "language_bytes": folder.bytes_on_disk(folder.language_path),
        "code_map_bytes": folder.bytes_on_disk(folder.root / "codes"),
        "edits": record.get("edits", []),
        "unsaved_steps": unsaved_steps(folder),
        "outdated_steps": outdated_steps(folder),
        "rebuilding": folder.content != folder.root,
        "warnings": len(record.get("warnings", [])),
        "lexsplat": record.get("provenance", {}).get("lexsplat"),
    }
