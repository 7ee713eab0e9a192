"""Hand-held cameras, tilted around a known up direction."""

from __future__ import annotations

import numpy as np

from lexsplat.geometry.cameras import look_at

UP = np.array([0.0, 0.0, 1.0])


def cameras(up, roll=0.0, count=9):
    rng = np.random.default_rng(0)
    up = np.asarray(up, float) / np.linalg.norm(up)
    found = []
    for _ in range(count):
        position = rng.normal(size=3)
        position = 3 * position / np.linalg.norm(position)
        tilt = up + roll * rng.normal(size=3)
        found.append(look_at(position, np.zeros(3), tilt, 64, 48, 0.8))
    return found
