"""Chosen views as a capture: renders, cameras and a contact sheet."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lexsplat.geometry.cameras import OPENGL_TO_OPENCV
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.choosing import ChosenViews
from lexsplat.rendering import render
from lexsplat.runtime.files import atomic_path, write_json
from lexsplat.runtime.progress import Event, Listener, silent

CONTACT_SHEET = "contact_sheet.jpg"
_THUMBNAIL = (240, 180)


@torch.no_grad()
def write_chosen_capture(
    gaussians: Gaussians, chosen: ChosenViews, folder: Path, listener: Listener = silent
) -> None:
    """Render the views into ``images/``, and write ``transforms.json`` last, which makes the folder a capture.

    Args:
        gaussians: The scene.
        chosen: Its views.
        folder: Folder to make; what an earlier choice left there is removed.
        listener: Receives events of stage "pictures".
    """
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").unlink(missing_ok=True)
    for old in images.glob("view_*.jpg"):
        old.unlink()
    columns = math.ceil(math.sqrt(len(chosen.cameras)))
    rows = math.ceil(len(chosen.cameras) / columns)
    sheet = Image.new("RGB", (columns * _THUMBNAIL[0], rows * _THUMBNAIL[1]))
    frames = []
    for number, camera in enumerate(chosen.cameras):
        listener(Event("pictures", number, len(chosen.cameras)))
        rendered = render(gaussians, camera).image.clamp(0, 1).cpu().numpy()
        picture = Image.fromarray(_bytes(rendered))
        name = f"images/view_{number:03}.jpg"
        picture.save(folder / name, quality=95)
        place = (number % columns * _THUMBNAIL[0], number // columns * _THUMBNAIL[1])
        sheet.paste(picture.resize(_THUMBNAIL, Image.Resampling.LANCZOS), place)
        pose = np.linalg.inv(OPENGL_TO_OPENCV @ camera.viewmat)
        lens = {
            "w": camera.width, "h": camera.height, "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2], "cy": camera.K[1, 2],
        }  # fmt: skip
        frames.append({"file_path": name, "transform_matrix": pose.tolist(), **lens})
    with atomic_path(folder / CONTACT_SHEET) as path:
        sheet.save(path, format="JPEG", quality=85)
    write_json(folder / "transforms.json", {"camera_model": "PINHOLE", "frames": frames})
    listener(Event("pictures", len(chosen.cameras), len(chosen.cameras)))


def _bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(image * 255).astype(np.uint8)
