"""Images for a language model: a view with heat and a legend."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.heatmaps import overlay_heatmap
from lexsplat.queries.phrases import Thing
from lexsplat.queries.scoring import render_gaussian_scores
from lexsplat.scenes.asked import certainty
from lexsplat.scenes.scene import Scene

_WIDTH = 640
"""Width of an image with one phrase or none; the images of several phrases share twice this width."""
_LINE = 18


def picture(scene: Scene, view: str, phrases: Sequence[str]) -> tuple[list[dict[str, Any]], bytes]:
    """A view in color, or one heatmap a phrase side by side, as PNG, and facts about the heatmaps.

    Args:
        scene: The scene.
        view: Name of a view.
        phrases: Phrases of the heatmaps, understood as by `Scene.find`.

    Raises:
        QueryError: If the view is unknown or a phrase is empty.
    """
    camera = scene.camera(view)
    width = _WIDTH if len(phrases) < 2 else 2 * _WIDTH // len(phrases)
    camera = camera.downscaled(max(1.0, camera.width / width))
    image = scene.render(camera).image.clamp(0, 1).cpu().numpy()
    if not phrases:
        return [], _png([((image * 255).round().astype(np.uint8), view)])
    drawn = [_heat(scene, camera, phrase) for phrase in phrases]
    tiles = [
        (overlay_heatmap(image, heat), f"{entry['phrase'][:60]}: {entry['present']}, peak {entry['peak']}")
        for entry, heat in drawn
    ]
    return [entry for entry, _ in drawn], _png(tiles)


def _heat(scene: Scene, camera: Camera, phrase: str) -> tuple[dict[str, Any], np.ndarray]:
    """Facts about the heat of a phrase, and the heat ``[H, W]`` in 0..1: relevancy, or the scores of the answer."""
    understood, found = scene.understand(phrase), scene.find(phrase)
    if isinstance(understood.phrase, Thing):
        heat = scene.relevancy(understood.phrase.text, camera)[0]
    else:  # a text with relations has no relevancy of its own
        heat = render_gaussian_scores(
            scene.gaussians, camera, torch.where(found.mask, found.scores, 0)[None]
        )[0]
    entry = {
        "phrase": phrase,
        "understood": str(understood.phrase),
        "note": understood.note,
        **certainty(found),
        "peak": round(float(heat.max()), 3),
    }
    return entry, heat.cpu().numpy()


def _png(tiles: Sequence[tuple[np.ndarray, str]]) -> bytes:
    """Tiles side by side, each with a line of text below."""
    height, width = tiles[0][0].shape[:2]
    sheet = Image.new("RGB", (width * len(tiles), height + _LINE), "black")
    draw = ImageDraw.Draw(sheet)
    for number, (pixels, text) in enumerate(tiles):
        sheet.paste(Image.fromarray(pixels), (number * width, 0))
        shown = text.encode("latin-1", "replace").decode("latin-1")  # the built-in font has no other letters
        draw.text((number * width + 4, height + 3), shown, fill="white")
    file = io.BytesIO()
    sheet.save(file, format="PNG")
    return file.getvalue()
