"""Exact ground truth in 3D: pixel labels of each view, lifted to labels of Gaussians and to boxes.

A Gaussian receives the label with the largest share of its visible weight (alpha T over all pixels of all views),
counted only where the exact depth agrees with its own: weight through a hole of a nearer object or from behind a
surface does not identify the Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from torch import Tensor

from lexsplat.geometry.boxes import Box, trimmed_box
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import back_project


@dataclass(frozen=True)
class GroundTruthView:
    """Exact labels and depth of a view.

    Args:
        camera: Camera with the size of the maps.
        labels: Label of each pixel ``[H, W]``, 0 for background.
        depth: Depth along the viewing axis ``[H, W]`` in world units; not positive for background.
    """

    camera: Camera
    labels: NDArray[np.integer]
    depth: NDArray[np.floating]


@dataclass(frozen=True)
class GaussianLabels:
    """Labels of Gaussians.

    Args:
        labels: Label of each Gaussian ``[N]`` int64, 0 for none.
        weights: Visible weight over all views ``[N]``, in pixels.
        purity: Share of the weight on the label ``[N]`` in 0..1.
    """

    labels: Tensor
    weights: Tensor
    purity: Tensor


@torch.no_grad()
def lift_labels(
    gaussians: Gaussians, views: Iterable[GroundTruthView], num_labels: int, *, tolerance: float = 0.02
) -> GaussianLabels:
    """Labels of Gaussians from labels of pixels.

    Args:
        gaussians: The scene.
        views: Exact views that show every object from all sides.
        num_labels: Number of labels, including 0.
        tolerance: Permitted distance behind the exact surface as a share of the depth, in addition to three standard
            deviations of the Gaussian.
    """
    totals = torch.zeros(len(gaussians), num_labels)
    for view in views:
        camera = view.camera
        at_surface = _near_surface(gaussians, view, tolerance)
        one_hot = torch.nn.functional.one_hot(torch.from_numpy(view.labels.astype(np.int64)), num_labels)
        weights = back_project(gaussians, camera, one_hot.float().to(gaussians.device))
        totals += weights.cpu() * at_surface[:, None]
    weights = totals.sum(1)
    best, labels = totals.max(1)
    purity = best / weights.clamp_min(1e-12)
    labels = torch.where(weights > 0, labels, 0)
    return GaussianLabels(labels, weights, torch.where(weights > 0, purity, 0.0))


def surface_points(views: Iterable[GroundTruthView], label: int, *, stride: int = 2) -> NDArray[np.float64]:
    """Exact world points of a label ``[M, 3]``, from the depth of every ``stride``-th pixel."""
    found = []
    for view in views:
        rows, columns = np.nonzero((view.labels == label) & (view.depth > 0))
        kept = (rows % stride == 0) & (columns % stride == 0)
        rows, columns = rows[kept], columns[kept]
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
        local = pixels @ np.linalg.inv(view.camera.K).T * view.depth[rows, columns, None]
        found.append((local - view.camera.viewmat[:3, 3]) @ view.camera.viewmat[:3, :3])
    return np.concatenate(found) if found else np.zeros((0, 3))


def true_box(points: NDArray[np.float64], up: NDArray[np.float64]) -> Box:
    """The upright box of exact points, trimmed by a thousandth at each end (edges of masks)."""
    return trimmed_box(points, up, 0.001)


def selection_f1(mask: Tensor, ground_truth: Tensor, weights: Tensor) -> tuple[float, float, float]:
    """F1, precision and recall of a selection; Gaussians are weighted by their visible weight.

    Args:
        mask: Selected Gaussians ``[N]`` bool.
        ground_truth: Gaussians of the object ``[N]`` bool.
        weights: Visible weights ``[N]``, not negative.
    """
    mask, ground_truth, weights = mask.cpu(), ground_truth.cpu(), weights.cpu().double()
    hit = float(weights[mask & ground_truth].sum())
    precision = hit / max(float(weights[mask].sum()), 1e-12)
    recall = hit / max(float(weights[ground_truth].sum()), 1e-12)
    return 2 * precision * recall / max(precision + recall, 1e-12), precision, recall


def _near_surface(gaussians: Gaussians, view: GroundTruthView, tolerance: float) -> Tensor:
    """Whether a Gaussian lies at the exact surface at the pixel of its center: ``[N]`` of 0 or 1."""
    means = gaussians.means.detach().cpu().double().numpy()
    local = means @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    pixels = local @ view.camera.K.T / depth[:, None]
    height, width = view.depth.shape
    column, row = (np.floor(pixels[:, i]).astype(int) for i in (0, 1))
    inside = (local[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    exact = view.depth[row.clip(0, height - 1), column.clip(0, width - 1)]
    reach = tolerance * depth + 3 * gaussians.scales.detach().cpu().double().numpy().min(1)
    # Just outside a silhouette the pixel of the center shows a surface far behind, which does not contradict a
    # Gaussian in front of it. Only Gaussians clearly behind the exact surface are excluded.
    return torch.from_numpy(inside & (exact > 0) & (depth <= exact + reach)).float()


def box_iou(first: Box, second: Box) -> float:
    """Intersection over union of two oriented boxes by volume, in 0..1; exact."""
    if min(first.volume, second.volume) <= 0:
        return 0.0
    faces = []
    for box in (first, second):
        for axis, half in zip(box.axes, box.half_sizes):
            middle = float(axis @ box.center)
            faces += [[*axis, -middle - half], [*(-axis), middle - half]]
    halfspaces = np.array(faces)
    # The middle of the largest ball inside all faces: a point that is surely inside, if any is.
    scale = float(max(first.half_sizes.max(), second.half_sizes.max()))
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.hstack([halfspaces[:, :3], np.ones((len(faces), 1))]),
        b_ub=-halfspaces[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if not found.success or found.x[3] <= 1e-9 * scale:
        return 0.0
    try:
        inside = HalfspaceIntersection(halfspaces, found.x[:3])
        shared = float(ConvexHull(inside.intersections).volume)
    except QhullError:  # too thin: Qhull treats it as a plane
        return 0.0
    return min(1.0, shared / (first.volume + second.volume - shared))
