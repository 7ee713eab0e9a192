"""A capture small enough to build in tests: ray-traced spheres on a checkered floor, in COLMAP's text layout.

It uses no code of lexsplat, so that it can serve as a reference for cameras, images and masks.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

SPHERES = {  # name: center, radius, color
    "red apple": ((-0.55, 0.1, 0.35), 0.35, (0.75, 0.1, 0.08)),
    "blue ball": ((0.55, -0.1, 0.35), 0.35, (0.1, 0.2, 0.8)),
}
QUICK_BUILD = [
    "--clip", "bundled", "--dino", "bundled", "--device", "cpu", "--iterations", "120",
    "--features.crop-sizes", "0.25", "0.5", "--features.crop-strides", "0.5", "0.5",
    "--features.dino-short-side", "64", "--codebook.num-codes", "16", "--codebook.steps", "20",
    "--trained.iterations", "30",
]  # fmt: skip
"""Options of ``lexsplat build`` that make a small scene of the capture in seconds."""
LIGHT = np.array([0.4, -0.5, 0.77])


def camera_poses(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera rotations and translations (OpenCV axes) on an arc in front of the objects."""
    poses = []
    for i in range(count):
        angle = np.radians(-35 + 70 * i / max(1, count - 1))
        position = np.array([2.6 * np.sin(angle), -2.6 * np.cos(angle), 1.2 + 0.3 * (i % 3)])
        forward = np.array([0.0, 0.0, 0.25]) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append((rotation, -rotation @ position))
    return poses


def trace(
    rotation: np.ndarray, translation: np.ndarray, focal: float, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Color ``[H, W, 3]``, index of the object hit (0 floor, 1.. spheres) and hit point ``[H, W, 3]``."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1) @ rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = -rotation.T @ translation
    with np.errstate(divide="ignore"):
        best = np.where(rays[..., 2] < -1e-6, -origin[2] / rays[..., 2], 20.0)
    best = np.minimum(best, 20.0)
    hit = np.zeros((height, width), np.uint8)
    for number, (center, radius, _) in enumerate(SPHERES.values(), start=1):
        offset = origin - np.array(center)
        b = rays @ offset
        root = b * b - (offset @ offset - radius**2)
        distance = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), np.inf)
        closer = (distance > 0) & (distance < best)
        best, hit = np.where(closer, distance, best), np.where(closer, number, hit)
    points = origin + rays * best[..., None]
    checker = (np.floor(points[..., 0] * 2.5) + np.floor(points[..., 1] * 2.5)) % 2
    color = np.where(checker[..., None] > 0, [0.75, 0.72, 0.66], [0.25, 0.32, 0.24])
    color = np.where((np.linalg.norm(points, axis=-1) > 3.0)[..., None], [0.6, 0.66, 0.72], color)
    for number, (center, radius, tint) in enumerate(SPHERES.values(), start=1):
        normal = (points - np.array(center)) / radius
        shade = 0.45 + 0.55 * np.clip(normal @ LIGHT, 0, 1)
        stripe = 0.85 + 0.15 * np.sign(np.sin(9 * normal[..., 2]) * np.sin(7 * normal[..., 0]))
        color = np.where((hit == number)[..., None], np.array(tint) * (shade * stripe)[..., None], color)
    return np.clip(color, 0, 1), hit, points


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix, by the eigenvector of the largest eigenvalue (Bar-Itzhack)."""
    r = rotation
    k = np.array([
        [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
        [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
        [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()],
    ]) / 3.0  # fmt: skip
    values, vectors = np.linalg.eigh(k)
    q = vectors[[3, 0, 1, 2], np.argmax(values)]
    return -q if q[0] < 0 else q


def write_capture(folder: Path, *, views: int = 12, width: int = 96, height: int = 72) -> Path:
    """Write ``images/``, ``sparse/0/*.txt`` and ``segmentations/`` for every fourth view; returns ``folder``."""
    focal = 1.1 * width
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    lines, points, colors = [], [], []
    rng = np.random.default_rng(0)
    for number, (rotation, translation) in enumerate(camera_poses(views), start=1):
        name = f"view_{number:02d}.png"
        color, hit, where = trace(rotation, translation, focal, width, height)
        Image.fromarray((color * 255).round().astype(np.uint8)).save(folder / "images" / name)
        numbers = " ".join(f"{v:.12g}" for v in (*quaternion(rotation), *translation))
        lines.append(f"{number} {numbers} 1 {name}\n\n")
        if number % 4 == 2:
            for index, prompt in enumerate(SPHERES, start=1):
                mask = folder / "segmentations" / Path(name).stem / f"{prompt}.png"
                mask.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(((hit == index) * 255).astype(np.uint8)).save(mask)
        else:
            near = np.linalg.norm(where, axis=-1) < 4
            chosen = rng.choice(np.flatnonzero(near), 120, replace=False)
            points.append(where.reshape(-1, 3)[chosen])
            colors.append(color.reshape(-1, 3)[chosen])
    sparse = folder / "sparse" / "0"
    sparse.joinpath("cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n"
    )
    sparse.joinpath("images.txt").write_text("".join(lines))
    rows = zip(np.concatenate(points), (np.concatenate(colors) * 255).astype(int))
    sparse.joinpath("points3D.txt").write_text(
        "".join(
            f"{i} {p[0]:.6f} {p[1]:.6f} {p[2]:.6f} {c[0]} {c[1]} {c[2]} 0.5\n"
            for i, (p, c) in enumerate(rows, 1)
        )
    )
    return folder
