"""Changes of the poses in a COLMAP model."""

from __future__ import annotations

import numpy as np
import pycolmap


def move(model, number) -> None:
    """Rotate and translate the pose of a photo, as if it were mis-registered."""
    frame = model.frame(model.image(number).frame_id)
    turn = pycolmap.Rotation3d(np.array([0.0, np.sin(0.2), 0.0, np.cos(0.2)]))
    frame.rig_from_world = pycolmap.Rigid3d(turn, np.array([0.7, -0.4, 0.2])) * frame.rig_from_world
