"""Moved bodies: what a moved camera sees of a moved body is what it saw before."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.splats import make

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import multiply_quaternions, quaternion_from_matrix
from lexsplat.rendering import render
from lexsplat.scenes.transforms import rotated_harmonics, transformed


def cloud(degree: int = 3, count: int = 80) -> Gaussians:
    g = make(count, degree)
    return Gaussians(
        g.means * 0.4, g.quats, g.log_scales * 0.4 - 2.2, g.opacity_logits + 1, g.sh0, g.shN * 0.3
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_camera_transformed_with_the_scene_renders_the_same_image(degree):
    g = cloud(degree)
    rotation = Rotation.random(random_state=degree).as_matrix()
    scale, shift, center = 1.7, np.array([0.3, -2.0, 1.0]), np.array([0.1, 0.2, -0.3])
    camera = look_at([0.5, -3.0, 1.0], [0.0, 0.0, 0.0], np.array([0, 0, 1.0]), 64, 48, 0.8)
    before = render(g, camera).image
    after = transformed(g, rotation=rotation, scale=scale, translation=shift, center=center)
    # The camera makes the same move; its frame has no scale, so its place moves and its axes turn.
    position = scale * rotation @ (camera.position - center) + center + shift
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ rotation.T
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    seen = render(after, Camera(64, 48, camera.K, viewmat)).image
    assert float(before.std()) > 0.05
    assert torch.allclose(seen, before, atol=2e-3)


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_two_rotations_equal_their_product(seed):
    first, second = (Rotation.random(random_state=seed + k).as_matrix() for k in (0, 5000))
    shN = make(3, 3).shN
    twice = rotated_harmonics(rotated_harmonics(shN, first), second)
    assert torch.allclose(twice, rotated_harmonics(shN, second @ first), atol=1e-4)
    assert torch.allclose(twice.norm(dim=1), shN.norm(dim=1), rtol=1e-4)


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_quaternion_products_equal_scipys(seed):
    a, b = (Rotation.random(random_state=seed + k) for k in (0, 5000))
    product = multiply_quaternions(*(torch.from_numpy(quaternion_from_matrix(r.as_matrix())) for r in (a, b)))
    expected = (a * b).as_quat()[[3, 0, 1, 2]]
    assert abs(float(product @ torch.from_numpy(expected))) == pytest.approx(1)


def test_only_similarity_transforms_are_accepted():
    with pytest.raises(ValueError, match="proper rotation"):
        transformed(cloud(0), rotation=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="scale"):
        transformed(cloud(0), scale=0.0)
    with pytest.raises(ValueError, match="finite"):
        transformed(cloud(0), translation=np.array([0, 0, np.nan]))
