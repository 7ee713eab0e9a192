"""Clicks: the point is where a ray meets a ball, and the selection is that ball."""

import numpy as np
import pytest
import torch
from support.language_scene import CENTERS, RADIUS, make_scene

from lexsplat.geometry.cameras import look_at
from lexsplat.language.fields import CodeField
from lexsplat.queries.picking import Hit, select_hit, similarity_to, surface_at
from lexsplat.runtime.errors import QueryError


@pytest.fixture(scope="module")
def scene():
    made = make_scene(per_ball=900)
    made.gaussians.log_scales += 0.7  # no holes to look through
    return made


@pytest.fixture(scope="module")
def field(scene):
    codes = torch.from_numpy(scene.labels.astype(np.uint8))[:, None]
    count = len(scene.labels)
    return CodeField(scene.codebook, codes, torch.ones(count, 1), torch.zeros(count))


def click(scene, number) -> tuple[Hit, np.ndarray]:
    """A click on the middle of a ball, seen from outside, and where the ray meets the ball."""
    center = CENTERS[number]
    position = center * 4 / np.linalg.norm(center) + np.array([0.0, 0.3, 0.0])
    camera = look_at(position, center, np.array([0.1, 0.2, 1.0]), 80, 60, 0.6)
    hit = surface_at(scene.gaussians, camera, 40.0, 30.0)
    return hit, center + (position - center) / np.linalg.norm(position - center) * RADIUS


@pytest.mark.parametrize("number", range(5))
def test_a_click_selects_the_ball_that_is_seen_there(scene, field, number):
    hit, expected = click(scene, number)
    assert np.linalg.norm(hit.point - expected) < 0.15
    assert set(scene.labels[hit.indices.numpy()]) == {number}
    chosen = select_hit(hit, scene.gaussians, field, scene.cameras)
    assert np.array_equal(chosen.mask.numpy(), scene.labels == number)


def test_the_clicked_position_selects_among_objects_of_one_meaning(scene):
    codes = torch.from_numpy(np.where(scene.labels == 1, 0, scene.labels).astype(np.uint8))[:, None]
    same = CodeField(scene.codebook, codes, torch.ones(len(codes), 1), torch.zeros(len(codes)))
    chosen = select_hit(click(scene, 1)[0], scene.gaussians, same, scene.cameras)
    assert np.array_equal(chosen.mask.numpy(), scene.labels == 1)


def test_similarity_is_the_cosine_of_features(scene, field):
    features = torch.nn.functional.normalize(scene.codebook.clip, dim=-1)[scene.labels]
    expected = (features @ features[scene.labels == 2][0]).clamp(0, 1)
    assert torch.allclose(similarity_to(click(scene, 2)[0], field), expected, atol=1e-5)


def test_a_click_that_hits_nothing_is_refused(scene):
    camera = look_at([0.0, -6.0, 6.0], [0.0, 0.0, 8.0], np.array([0.0, 0, 1]), 40, 30, 0.5)
    with pytest.raises(QueryError, match="expected a surface, found nothing"):
        surface_at(scene.gaussians, camera, 20.0, 15.0)
    with pytest.raises(QueryError, match="outside"):
        surface_at(scene.gaussians, camera, 41.0, 15.0)
