"""A street of views for tests of blocks."""

import dataclasses

import numpy as np

from lexsplat.geometry.cameras import Camera


def street(capture, length: float = 40.0):
    """Views every two meters along x that look sideways, and points on the house fronts three meters away."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    some, views = next(iter(capture.views.values())), {}
    K = np.array([[50.0, 0, 48], [0, 50.0, 36], [0, 0, 1]])
    for x in np.arange(0.0, length, 2.0):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array([x, 0.0, 1.5])
        name = f"{x:04.1f}"
        views[name] = dataclasses.replace(some, name=name, camera=Camera(96, 72, K, pose))
    rng = np.random.default_rng(0)
    places = np.column_stack(
        [rng.uniform(0, length, 4000), rng.uniform(2.9, 3.1, 4000), rng.uniform(0, 3, 4000)]
    )
    return dataclasses.replace(capture, views=views, train_names=tuple(views), test_names=()), places.astype(
        np.float32
    )
