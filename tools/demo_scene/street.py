"""Write a capture of a synthetic street, for measurements of large captures (see README.md); needs numpy and Pillow.

python tools/demo_scene/street.py output/street --length 40 --views 320

Two rows of house fronts, pavements, cars, bins and lamps. A camera walks up one pavement and down the other and looks
across the street and along it. Everything is boxes with procedural patterns. The capture has photos and poses, no
points. The same arguments give the same files.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

EYE = 1.6
HALF_WIDTH = 5.0
"""Meters from the middle of the street to the house fronts."""
PAVEMENT = 3.0
"""Meters from the middle to the curb."""
SKY = np.array([[0.72, 0.80, 0.90], [0.35, 0.52, 0.80]])
SUN = np.array([0.5, 0.3, 0.81])
HEADINGS = np.radians([60.0, 110.0, 85.0, 20.0])
"""Directions of successive views, from the direction of walking towards the other side."""
HOUSE, PLAIN = 1, 0


@dataclass(frozen=True)
class Box:
    """An axis-aligned box with a pattern.

    Args:
        low, high: Corners in meters; x along the street, y across it, z up.
        color: RGB in 0..1.
        seed: Number of its pattern.
        kind: PLAIN, or HOUSE with bricks, windows and doors.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    color: tuple[float, float, float]
    seed: int
    kind: int = PLAIN


def street(length: float, seed: int) -> list[Box]:
    """The boxes of a street from x = 0 to ``length``."""
    rng = np.random.default_rng(seed)
    boxes: list[Box] = []

    def add(low, high, color, kind: int = PLAIN) -> None:
        boxes.append(Box(tuple(low), tuple(high), tuple(np.clip(color, 0.03, 0.97)), len(boxes), kind))

    for side in (-1.0, 1.0):
        x = -12.0
        while x < length + 12.0:
            width, height, back = rng.uniform(4.0, 7.0), rng.uniform(5.0, 9.0), rng.uniform(0.0, 0.6)
            y = np.sort([side * (HALF_WIDTH + back), side * (HALF_WIDTH + 6.0)])
            add((x, y[0], 0.0), (x + width, y[1], height), rng.uniform(0.35, 0.85, 3), HOUSE)
            front = side * (HALF_WIDTH + back)
            for at in (0.25, 0.75):  # a step below the door, a sign above a window
                depth = np.sort([front, front - side * 0.5])
                color, bottom = rng.uniform(0.1, 0.9, 3), rng.choice([0.0, 2.9])
                add(
                    (x + at * width - 0.7, depth[0], bottom),
                    (x + at * width + 0.7, depth[1], bottom + 0.3),
                    color,
                )
            x += width
        for x in np.arange(-6.0, length + 6.0, 5.0) + rng.uniform(-1.0, 1.0):
            color, y = rng.uniform(0.05, 0.95, 3), side * (PAVEMENT - 1.1) + rng.uniform(-0.1, 0.1)
            if rng.random() < 0.6:  # a car
                add((x, y - 0.8, 0.25), (x + 3.4, y + 0.8, 0.9), color)
                add((x + 0.7, y - 0.7, 0.9), (x + 2.6, y + 0.7, 1.45), 0.5 * color)
            y = side * (PAVEMENT + 0.3)
            add((x - 0.9, y - 0.06, 0.0), (x - 0.78, y + 0.06, 4.2), (0.2, 0.22, 0.2))
            add(
                (x - 0.2, y - 0.25, 0.0), (x + 0.3, y + 0.25, rng.uniform(0.7, 1.2)), rng.uniform(0.1, 0.9, 3)
            )
    return boxes


def cameras(length: float, views: int, seed: int) -> list[NDArray[np.float64]]:
    """Camera to world ``[4, 4]`` with OpenGL axes: up one pavement, down the other."""
    rng = np.random.default_rng(seed + 1)
    poses = []
    for number in range(views):
        back = number >= (views + 1) // 2
        along = 2.0 * length * number / views
        place = np.array([2.0 * length - along if back else along, 3.6 if back else -3.6, EYE])
        angle = HEADINGS[number % len(HEADINGS)] + (np.pi if back else 0.0) + rng.normal(0.0, 0.05)
        forward = np.array([np.cos(angle), np.sin(angle), rng.normal(-0.05, 0.03)])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(right, forward), -forward], 1)
        pose[:3, 3] = place + rng.normal(0.0, 0.05, 3)
        poses.append(pose)
    return poses


def _noise(u: NDArray, v: NDArray, seed: int | NDArray) -> NDArray[np.float64]:
    """A number in 0..1 for each cell of the unit grid."""
    a, b = np.floor(u).astype(np.int64).astype(np.uint64), np.floor(v).astype(np.int64).astype(np.uint64)
    mixed = a * np.uint64(0x9E3779B97F4A7C15) ^ b * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed ^= np.asarray(seed).astype(np.uint64) * np.uint64(0x165667B19E3779F9)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return (mixed >> np.uint64(40)).astype(np.float64) / float(1 << 24)


def _spots(u: NDArray, v: NDArray, seed: int | NDArray) -> NDArray[np.float64]:
    """Patches of three sizes around 0, in about -0.5..0.5."""
    return sum(
        (_noise(u / size, v / size, seed) - 0.5) * gain
        for size, gain in ((1.1, 0.3), (0.4, 0.35), (0.16, 0.3))
    )


def _ground(x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Colors ``[R, 3]`` of asphalt, a dashed middle line, and the slabs of the pavements."""
    paved = np.abs(y) > PAVEMENT
    slab = _noise(x / 0.8, y / 0.5, 7)
    gray = np.where(paved, 0.5 + 0.25 * slab, 0.27) + 0.22 * _spots(x, y, 5)
    gray = np.where(~paved & (np.abs(y) < 0.08) & (np.mod(x, 2.0) < 1.1), 0.9, gray)
    return gray[:, None] * np.array([1.0, 0.98, 0.94])


def _side(box: Box, u: NDArray, v: NDArray) -> NDArray[np.float64]:
    """Colors ``[R, 3]`` at ``u`` meters along a side of a box and ``v`` meters above its lower end."""
    shade = 1.0 + 0.5 * _spots(u, v, box.seed)
    color = np.array(box.color) * shade[:, None]
    if box.kind != HOUSE:
        return color
    row = np.floor(v / 0.3)
    tint = _noise((u + 0.35 * np.mod(row, 2.0)) / 0.7, v / 0.3, box.seed + 31)
    color = color * (0.75 + 0.5 * tint)[:, None]
    column, floor = np.floor(u / 1.6), np.floor(v / 2.8)
    du, dv = np.mod(u, 1.6), np.mod(v, 2.8)
    door = (floor == 0) & (_noise(column, floor, box.seed + 77) < 0.4)
    opening = (np.abs(du - 0.8) < 0.5) & np.where(door, dv < 2.2, (dv > 0.9) & (dv < 2.3))
    frame = opening & ((np.abs(du - 0.8) > 0.42) | (np.abs(dv - 1.6) < 0.05))
    pane = np.stack([_noise(column + shift, floor, box.seed + 5) for shift in (0, 50, 100)], -1)
    pane = 0.15 + 0.5 * pane * (0.6 + 0.8 * _noise(u / 0.35, v / 0.35, box.seed + 9))[:, None]
    return np.where(frame[:, None], 0.9, np.where(opening[:, None], pane, color))


def _in_view(box: Box, pose: NDArray, focal: float, size: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of a ``size`` = (width, height) image outside of which a box is not seen."""
    corners = np.stack(np.meshgrid(*zip(box.low, box.high)), -1).reshape(8, 3)
    x, y, z = ((corners - pose[:3, 3]) @ pose[:3, :3]).T
    if (z >= -0.05).all():
        return slice(0), slice(0)
    if (z >= -0.05).any():
        return slice(None), slice(None)
    columns, rows = size[0] / 2 - focal * x / z, size[1] / 2 + focal * y / z
    return tuple(slice(max(0, int(at.min())), max(0, int(at.max()) + 2)) for at in (rows, columns))


def photo(
    boxes: list[Box], pose: NDArray, size: tuple[int, int], focal: float, samples: int
) -> NDArray[np.uint8]:
    """A photo ``[H, W, 3]`` of ``size`` = (width, height) with ``samples`` squared rays a pixel."""
    width, height, focal = size[0] * samples, size[1] * samples, focal * samples
    x, y = np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2
    grid = np.stack(np.broadcast_arrays(x[None] / focal, -y[:, None] / focal, -1.0), -1)
    origin, rays = pose[:3, 3], grid @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        inverse = 1.0 / rays
    nearest = np.where(rays[..., 2] < -1e-9, -origin[2] * inverse[..., 2], np.inf)
    hit, axis = np.where(np.isfinite(nearest), -1, -2), np.full(nearest.shape, 2)
    for number, box in enumerate(boxes):
        part = _in_view(box, pose, focal, (width, height))
        first, second = (
            (np.array(box.low) - origin) * inverse[part],
            (np.array(box.high) - origin) * inverse[part],
        )
        entry = np.minimum(first, second)
        enters, leaves = entry.max(-1), np.maximum(first, second).min(-1)
        closer = (enters < leaves) & (enters > 1e-6) & (enters < nearest[part])
        nearest[part][closer], hit[part][closer] = enters[closer], number
        axis[part][closer] = entry[closer].argmax(-1)
    up = np.clip(rays[..., 2] / np.linalg.norm(rays, axis=-1), 0.0, 1.0)
    colors = SKY[0] + np.sqrt(up)[..., None] * (SKY[1] - SKY[0])
    places = origin + np.where(np.isfinite(nearest), nearest, 0.0)[..., None] * rays
    on = hit == -1
    colors[on] = _ground(places[on][:, 0], places[on][:, 1])
    for number in np.unique(hit[hit >= 0]):
        box, on = boxes[number], hit == number
        local, across = places[on] - np.array(box.low), axis[on]
        u = np.where(across == 0, local[:, 1], local[:, 0])
        v = np.where(across == 2, local[:, 1], local[:, 2])
        facing = -np.sign(np.take_along_axis(rays[on], across[:, None], 1)[:, 0]) * SUN[across]
        colors[on] = _side(box, u, v) * (0.75 + 0.35 * facing)[:, None]
    image = colors.clip(0.0, 1.0).reshape(size[1], samples, size[0], samples, 3).mean((1, 3))
    return np.round(255 * image).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--length", type=float, default=40.0, help="meters")
    parser.add_argument("--views", type=int, default=320)
    parser.add_argument("--size", type=int, nargs=2, default=(240, 160), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--samples", type=int, default=2, help="rays a pixel, a side")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    (width, height), focal = given.size, 0.75 * given.size[0]
    boxes, frames = street(given.length, given.seed), []
    (given.output / "images").mkdir(parents=True, exist_ok=True)
    for number, pose in enumerate(cameras(given.length, given.views, given.seed)):
        name = f"images/view_{number:04d}.png"
        made = photo(boxes, pose, (width, height), focal, given.samples)
        Image.fromarray(made).save(given.output / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        if sys.stderr.isatty():
            print(f"\r{number + 1} of {given.views} views", end="", file=sys.stderr)
    document = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    (given.output / "transforms.json").write_text(json.dumps({**document, "frames": frames}, indent=1) + "\n")


if __name__ == "__main__":
    main()
