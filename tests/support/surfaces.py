"""Points on surfaces: balls on a table, rooms, boxes."""

from __future__ import annotations

import numpy as np


def on_sphere(center, radius: float, count: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(center) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_table(seed: int = 0) -> np.ndarray:
    """Three balls on a square table top at z = 0."""
    floor = np.random.default_rng(seed).uniform(-1, 1, (2400, 3)) * [1.5, 1.5, 0.002]
    balls = [
        on_sphere((x, y, r), r, 700, seed + 1)
        for x, y, r in ((0, 0, 0.4), (0.8, 0.3, 0.3), (-0.7, 0.5, 0.35))
    ]
    return np.concatenate([floor, *balls])


def sides_of_box(low, high, count: int, seed: int) -> np.ndarray:
    """Points on the six sides of a box."""
    generator = np.random.default_rng(seed)
    sizes = np.subtract(high, low)
    areas = np.prod(sizes) / sizes
    axis = generator.choice(3, count, p=areas / areas.sum())
    points = generator.uniform(0, 1, (count, 3))
    points[np.arange(count), axis] = generator.integers(0, 2, count)
    return np.asarray(low) + points * sizes


def furnished(dense: float = 1.0) -> np.ndarray:
    """A closed room of 5 x 4 x 2.5 with a table, a wardrobe, a sofa and a ball on the table."""

    def box(low, high, count: int, seed: int) -> np.ndarray:
        return sides_of_box(low, high, round(dense * count), seed)

    return np.concatenate([
        box((0, 0, 0), (5, 4, 2.5), 14000, 0), box((1.5, 1.2, 0.7), (3, 2.2, 0.76), 1500, 1),
        *(box((x, y, 0), (x + 0.06, y + 0.06, 0.7), 80, 2) for x in (1.5, 2.9) for y in (1.2, 2.1)),
        box((0, 3.4, 0), (1.8, 4, 1.9), 1800, 3), box((3.6, 0, 0), (5, 0.9, 0.45), 1500, 4),
        box((3.6, 0, 0.45), (5, 0.25, 0.9), 700, 5), on_sphere((2.2, 1.7, 0.9), 0.13, round(dense * 300), 6),
    ])  # fmt: skip
