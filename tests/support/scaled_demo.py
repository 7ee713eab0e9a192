"""The scene that ships, with a known scale."""

import shutil
from pathlib import Path

from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.scale import store_world

METERS = 0.25
"""Meters in a unit of the scene."""


def scaled_demo(folder: Path) -> str:
    """Copy the scene to a new folder and set its scale."""
    shutil.copytree(BUNDLED_SCENE, folder)
    store_world(SceneFolder.open(folder), meters_per_unit=METERS)
    return str(folder)
