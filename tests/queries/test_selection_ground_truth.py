"""Exact ground truth in 3D, on balls with known labels, positions and sizes."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from selection_ground_truth import (
    GroundTruthView,
    box_iou,
    lift_labels,
    selection_f1,
    surface_points,
    true_box,
)
from support.language_scene import CENTERS, RADIUS, LanguageScene, make_scene, trace

from lexsplat.geometry.boxes import Box
from lexsplat.geometry.cameras import Camera


def traced(camera: Camera) -> GroundTruthView:
    """Exact labels (1 to 5, 0 for none) and depth of a view of the balls."""
    codes = trace(camera)
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([xs, ys, np.ones_like(xs)], -1) @ np.linalg.inv(camera.K).T  # depth 1 along the axis
    world = rays @ camera.viewmat[:3, :3]
    lengths = np.linalg.norm(world, axis=-1)
    depth = np.zeros(codes.shape)
    for code, center in enumerate(CENTERS):
        here = codes == code
        half = (world / lengths[..., None]) @ (camera.position - center)
        root = half**2 - ((camera.position - center) @ (camera.position - center) - RADIUS**2)
        depth[here] = ((-half - np.sqrt(np.maximum(root, 0))) / lengths)[here]
    return GroundTruthView(camera, np.where(codes == 255, 0, codes + 1), depth)


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=150, width=96, height=72)


@pytest.fixture(scope="module")
def traced_views(balls):
    return [traced(camera) for camera in balls.cameras.values()]


def test_lifted_labels_are_those_of_the_balls(balls, traced_views):
    lifted = lift_labels(balls.gaussians, traced_views, 6)
    seen = lifted.weights > 1
    assert seen.float().mean() > 0.8
    right = lifted.labels[seen].numpy() == balls.labels[seen.numpy()] + 1
    assert right.mean() > 0.95  # Gaussians at a silhouette may lie mostly outside the ball
    assert (lifted.purity[seen] > 0.5).float().mean() > 0.9


def test_gaussians_behind_the_exact_surface_receive_no_label(balls, traced_views):
    inner = balls.gaussians.select(torch.arange(len(balls.labels)))
    ball = balls.labels == 0
    inner.means[ball] = torch.from_numpy(CENTERS[0]).float()  # hidden in the middle of the ball
    lifted = lift_labels(inner, traced_views, 6, tolerance=0.0)
    assert (lifted.weights[torch.from_numpy(ball)] == 0).all()
    assert (lifted.labels[torch.from_numpy(ball)] == 0).all()


def test_exact_points_lie_on_the_balls_and_their_boxes_have_the_balls_size(traced_views):
    for number, center in enumerate(CENTERS, start=1):
        points = surface_points(traced_views, number, stride=1)
        assert np.linalg.norm(points - center, axis=1) == pytest.approx(RADIUS, abs=1e-6)
        box = true_box(points, np.array([0, 0, 1.0]))
        assert box.center[:2] == pytest.approx(center[:2], abs=0.06)
        assert box.half_sizes[:2] == pytest.approx(RADIUS, abs=0.06)


def test_f1_by_hand():
    mask, ground_truth = torch.tensor([1, 1, 1, 0, 0]).bool(), torch.tensor([1, 1, 0, 1, 0]).bool()
    f1, precision, recall = selection_f1(mask, ground_truth, torch.tensor([1.0, 2, 3, 4, 100]))
    assert (precision, recall) == (pytest.approx(3 / 6), pytest.approx(3 / 7))
    assert f1 == pytest.approx(2 * 3 / (6 + 7))
    assert selection_f1(~ground_truth & False, ground_truth, torch.ones(5))[0] == 0


def turned(angle: float, center=(0.0, 0.0, 0.0), halves=(1.0, 0.5, 0.25)) -> Box:
    axes = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return Box(np.array(center, float), axes, np.array(halves, float))


@pytest.mark.slow
@given(st.integers(0, 50))
@settings(max_examples=25)
def test_the_overlap_of_boxes_is_the_share_of_random_points_in_both(seed):
    rng = np.random.default_rng(seed)
    first = turned(rng.uniform(0, 3), rng.uniform(-0.3, 0.3, 3), rng.uniform(0.4, 1.0, 3))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    second = Box(rng.uniform(-0.3, 0.3, 3), rotation, rng.uniform(0.4, 1.0, 3))
    points = rng.uniform(-2.5, 2.5, (200_000, 3))
    a, b = first.contains(points), second.contains(points)
    assert box_iou(first, second) == pytest.approx((a & b).sum() / (a | b).sum(), abs=0.02)


def test_the_overlap_of_boxes_by_hand():
    box = turned(0.0)
    assert box_iou(box, box) == pytest.approx(1.0)
    assert box_iou(box, turned(0.0, center=(1.0, 0, 0))) == pytest.approx(1 / 3)
    assert box_iou(box, turned(0.0, center=(5.0, 0, 0))) == 0.0
    assert box_iou(box, turned(0.0, halves=(1.0, 0.5, 0.0))) == 0.0
