"""A sheet of thumbnails of the objects of a scene: each in the view that shows it best, what is around it dimmed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image, ImageDraw

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.selection import Selection
from lexsplat.rendering import render
from lexsplat.rendering.first_drawing import compile_drawing
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.progress import Event

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene

_TILE = (240, 180)
_LINE = 18
_COLUMNS = 5
_MARGIN = 0.2
"""Space around an object at each side of its thumbnail, as a share of its size."""
_CLOSEST = 4.0
"""Largest magnification of a photo's pixels: a thing of a few pixels has nothing to show."""
_AROUND = 0.45
"""Brightness of what is not the object."""


def write_sheet(scene: Scene, things: Sequence[Selection], path: Path) -> None:
    """Write a PNG with a thumbnail of each object, and its number and name below."""
    width, height = _TILE[0], _TILE[1] + _LINE
    columns = max(1, min(_COLUMNS, len(things)))
    size = columns * width, max(1, math.ceil(len(things) / columns)) * height
    sheet = Image.new("RGB", size, (30, 30, 34))
    draw = ImageDraw.Draw(sheet)
    if things:
        compile_drawing(scene.gaussians.device, scene.listener)
    for number, thing in enumerate(things):
        scene.listener(Event("pictures", number, len(things)))
        left, top = number % columns * width, number // columns * height
        tile = _thumbnail(scene, thing)
        sheet.paste(tile, (left + (_TILE[0] - tile.width) // 2, top + (_TILE[1] - tile.height) // 2))
        label = f"{number + 1}. {thing.phrase}".encode("latin-1", "replace").decode("latin-1")[:36]
        draw.text((left + 4, top + _TILE[1] + 3), label, fill="white")  # the built-in font has latin-1 alone
    scene.listener(Event("pictures", len(things), len(things)))
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="PNG")


def _thumbnail(scene: Scene, thing: Selection) -> Image.Image:
    """An object in its best view, with the pixels that it does not show at `_AROUND` of their brightness."""
    camera = scene.cameras.get(thing.best_view)
    if camera is None:
        return Image.new("RGB", _TILE)
    view = _around(camera, camera.project(thing.box.corners)[0])
    member = thing.mask.to(scene.gaussians.means)[:, None]
    with torch.no_grad():
        drawn = render(scene.gaussians, view, features=member)
    light = _AROUND + (1 - _AROUND) * drawn.features.clamp(0, 1)
    return Image.fromarray((drawn.image.clamp(0, 1) * light * 255).round().to(torch.uint8).cpu().numpy())


def _around(camera: Camera, pixels: np.ndarray) -> Camera:
    """The part of a view around some pixels ``[P, 2]``, of a tile's size; smaller where the picture ends before."""
    low, high = pixels.min(0), pixels.max(0)
    tile, whole = np.array(_TILE, float), np.array([camera.width, camera.height], float)
    wanted = ((1 + 2 * _MARGIN) * (high - low) / tile).max()  # pixels of the photo for one of the tile
    scale = max(min(wanted, (whole / tile).max()), 1 / _CLOSEST)
    size = np.clip(whole / scale, 1, tile).astype(int)
    first = np.clip((low + high) / 2 - scale * size / 2, 0, np.maximum(whole - scale * size, 0))
    K = (
        np.diag([1 / scale, 1 / scale, 1.0])
        @ np.array([[1, 0, -first[0]], [0, 1, -first[1]], [0, 0, 1]])
        @ camera.K
    )
    return Camera(int(size[0]), int(size[1]), K, camera.viewmat)
