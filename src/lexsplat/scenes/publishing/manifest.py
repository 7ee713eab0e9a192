"""``manifest.json``, the first file that a page reads."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lexsplat import __version__
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.kinds import KIND_PHRASES, is_of_kind
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import SURFACES
from lexsplat.scenes.pixels import object_colors, seen_colors
from lexsplat.scenes.publishing.grammar import page_grammar
from lexsplat.scenes.publishing.rules import selection_rule
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.words import likely_nouns

FORMAT, FORMAT_VERSION = "lexsplat-page", 8
DRAWN_SPLATS = 1_000_000
"""Maximum number of Gaussians that a page draws at once; it chooses those that cover most of the image."""
MOST_OBJECTS = 200
"""Entries of the list of objects, at most."""


def scene_manifest(
    scene: Scene,
    gaussians: Gaussians,
    file: str,
    rotation: tuple[float, float, float, float],
    title: str,
    budget: int,
) -> dict[str, Any]:
    """The facts of a scene that every page contains.

    Args:
        scene: The scene.
        gaussians: Those of its Gaussians that the page draws, in the order of the file.
        file: Name of their file.
        rotation: xyzw from the axes of the file to those of the scene.
        title: Title of the page; empty takes the name of the scene folder.
        budget: Maximum number of Gaussians that the page draws at once.
    """
    record = scene.folder.record if scene.folder else {}
    built_with = {key: record.get("provenance", {}).get(key) for key in ("lexsplat", "versions", "seed")}
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "lexsplat": __version__,
        "title": one_line(title) or _name(scene),
        "description": "",
        "scene": {
            "file": file,
            "gaussians": len(gaussians),
            "of": len(scene.gaussians),
            "budget": budget,
            "rotation": rotation,
            "antialiased": gaussians.antialiased,
            "up": [round(float(value), 6) + 0.0 for value in scene.world.up.direction],
            "meters_per_unit": scene.world.meters_per_unit,
            "start_view": min(scene.views, default=""),
        },
        "selection_rule": selection_rule(),
        "server": None,
        "language": None,
        "words": {"phrases": "words.txt", "table": None, "count": 0, "english": None},
        "text": None,
        "objects": None,
        "kinds": None,
        "grammar": page_grammar(scene.clip),
        "views": view_entries(scene),
        "licenses": {"page.js": "Apache-2.0 and those of LICENSES.txt"},
        "provenance": {**scene.encoder_identity(), "built_with": built_with},
    }


def _name(scene: Scene) -> str:
    if scene.folder is None:
        return "scene"
    return "demo" if scene.folder.is_bundled else scene.folder.root.resolve().name


def object_entries(objects: Sequence[Selection]) -> list[dict[str, Any]]:
    """Name, center and size of objects, in world units, and in meters where the scale is known."""
    entries = []
    for found in objects:
        meters = found.size_meters
        known = {} if meters is None else {"size_meters": meters.round(4).tolist()}
        size = found.size.round(4).tolist()
        entries.append(
            {"name": found.phrase, "center": found.center.round(4).tolist(), "size": size, **known}
        )
    return entries


def colored_entries(scene: Scene, objects: Sequence[Selection]) -> list[dict[str, Any]]:
    """`object_entries` with "colors" (the most frequent first), "seen_colors" and "nouns" (of likely names)."""
    return [
        {
            **entry,
            "colors": object_colors(scene, each),
            "seen_colors": seen_colors(scene, each),
            "nouns": sorted(likely_nouns(each)),
        }
        for entry, each in zip(object_entries(objects), objects)
    ]


def kind_entries(objects: Sequence[Selection]) -> dict[str, list[int]]:
    """Indices of the objects of each kind, keyed by every name of the kind; "" is any thing."""
    found = {
        text: [place for place, each in enumerate(objects) if is_of_kind(each.phrase, text)]
        for text in KIND_PHRASES
    }
    found[""] = [place for place, each in enumerate(objects) if each.phrase not in SURFACES]
    return {text: places for text, places in found.items() if places}


def one_line(text: str) -> str:
    """A text without line breaks, at most 500 characters."""
    return " ".join(text.split())[:500]


def checksums(content: bytes) -> dict[str, Any]:
    """The entry of a file in the manifest."""
    return {
        "bytes": len(content),
        "crc32": zlib.crc32(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def view_entries(scene: Scene) -> list[dict[str, Any]]:
    """The cameras of the views for the page, in the order of their names."""
    return [
        {
            "name": name,
            "width": view.camera.width,
            "height": view.camera.height,
            "focal": [round(float(view.camera.K[axis, axis]), 4) for axis in (0, 1)],
            "viewmat": [round(float(value), 6) for value in np.asarray(view.camera.viewmat).ravel()],
        }
        for name, view in sorted(scene.views.items())
    ]
