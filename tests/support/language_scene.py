"""A small scene of known language: balls with one code each, and a ring of cameras.

Index maps are ray-traced and therefore independent of the renderer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points

CENTERS = np.array([[-0.9, 0.0, 0.0], [0.9, 0.0, 0.1], [0.0, 0.9, -0.1], [0.0, -0.9, 0.0], [0.0, 0.0, 0.9]])
RADIUS = 0.42
IGNORED = 255


@dataclass
class LanguageScene:
    gaussians: Gaussians
    labels: np.ndarray  # [N] code of each Gaussian
    cameras: dict[str, Camera]
    code_maps: dict[str, np.ndarray]  # [H, W] uint8, 255 outside the balls
    codebook: Codebook


def make_codebook(num_codes: int, dim: int = 12, seed: int = 0) -> Codebook:
    generator = torch.Generator().manual_seed(seed)
    clip = torch.randn(num_codes, dim, generator=generator)
    dino = torch.randn(num_codes, dim - 2, generator=generator)
    return Codebook(torch.nn.functional.normalize(clip, dim=-1), torch.nn.functional.normalize(dino, dim=-1))


def make_scene(
    per_ball: int = 60, views: int = 8, width: int = 32, height: int = 24, num_codes: int = 5
) -> LanguageScene:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(len(CENTERS), per_ball, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    points = (CENTERS[:, None] + RADIUS * 0.95 * directions).reshape(-1, 3)
    labels = np.repeat(np.arange(len(CENTERS)), per_ball)
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5), sh_degree=0, opacity=0.9)
    gaussians.log_scales -= 0.7  # Gaussians as wide as their spacing would extend beyond the balls
    cameras, code_maps = {}, {}
    for view in range(views):
        angle = 2 * np.pi * view / views
        position = 4 * np.array([np.cos(angle), np.sin(angle), 0.35 * np.cos(3 * angle)])
        camera = look_at(position, np.zeros(3), np.array([0, 0, 1.0]), width, height, 0.75)
        cameras[f"view{view}"] = camera
        code_maps[f"view{view}"] = trace(camera)
    return LanguageScene(gaussians, labels, cameras, code_maps, make_codebook(num_codes))


def trace(camera: Camera) -> np.ndarray:
    """Index of the first ball on each pixel's ray, 255 if there is none."""
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([xs, ys, np.ones_like(xs)], -1) @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest = np.full(rays.shape[:2], np.inf)
    codes = np.full(rays.shape[:2], IGNORED, np.uint8)
    for code, center in enumerate(CENTERS):
        offset = camera.position - center
        half = rays @ offset
        discriminant = half**2 - (offset @ offset - RADIUS**2)
        distance = np.where(discriminant > 0, -half - np.sqrt(np.maximum(discriminant, 0)), np.inf)
        closer = distance < nearest
        nearest[closer], codes[closer] = distance[closer], code
    return codes


def label_accuracy(field, scene: LanguageScene, names=None) -> float:
    """Fraction of ball pixels, excluding silhouettes, whose most probable code is correct."""
    right = total = 0
    for name in names or scene.cameras:
        ground_truth = scene.code_maps[name]
        found = field.render_code_probabilities(scene.gaussians, scene.cameras[name]).argmax(-1).numpy()
        inside = (ground_truth != IGNORED) & (
            minimum_filter(ground_truth, 3) == maximum_filter(ground_truth, 3)
        )
        right += (found == ground_truth)[inside].sum()
        total += inside.sum()
    return right / total
