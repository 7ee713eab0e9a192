"""A frame and labels for tests of the training of the bundled encoders; they need the fixture `training_tools`."""

from __future__ import annotations

import numpy as np
from PIL import Image


def frames_with_a_handle(scale=1):
    """A red mug with a handle of three by five pixels, times ``scale``, on a blue table."""
    from crops import Frame, Frames
    from words import Label

    frames = object.__new__(Frames)
    frames.labels = [Label("mug", "red"), Label("mug", "red", part="handle"), Label("table", "blue")]
    codes = np.full((60, 80), 2, np.int32)
    codes[20:40, 30:50] = 0
    codes[27:32, 50:53] = 1
    codes = codes.repeat(scale, 0).repeat(scale, 1)
    things = np.where(codes == 2, 2, 1).astype(np.uint8)
    frames.frames = [Frame("scene", Image.new("RGB", codes.shape[::-1]), codes, things)]
    return frames


def labels():
    """Every kind in every color, whole and in parts."""
    from vocabulary import COLORS, NAMES, OWNERS
    from words import Label

    finishes = {"table": "wooden", "wall": "brick", "cloth": "checkered", "floor": "tiled"}
    parts = {kind: [None] + [part for part, owners in OWNERS.items() if kind in owners] for kind in NAMES}
    return [
        Label(kind, color, finishes.get(kind), part)
        for kind in NAMES
        for color in COLORS
        for part in parts[kind]
    ]
