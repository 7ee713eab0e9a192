"""Clicks: the point is where a ray meets a ball, and the selection is that ball."""

import numpy as np
import pytest
import torch
from support.language_scene import CENTERS, RADIUS, LanguageScene, make_scene

from lexsplat.geometry.cameras import look_at
from lexsplat.language.fields import CodeField
from lexsplat.queries.picking import Hit, point_at, select_hit, similarity_to, surface_at
from lexsplat.runtime.errors import QueryError


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    made = make_scene(per_ball=900)
    made.gaussians.log_scales += 0.7  # no holes to look through
    return made


@pytest.fixture(scope="module")
def field(balls) -> CodeField:
    codes = torch.from_numpy(balls.labels.astype(np.uint8))[:, None]
    count = len(balls.labels)
    return CodeField(balls.codebook, codes, torch.ones(count, 1), torch.zeros(count))


def click(balls, number) -> tuple[Hit, np.ndarray]:
    """A click on the middle of a ball, seen from outside, and where the ray meets the ball."""
    center = CENTERS[number]
    position = center * 4 / np.linalg.norm(center) + np.array([0.0, 0.3, 0.0])
    camera = look_at(position, center, np.array([0.1, 0.2, 1.0]), 80, 60, 0.6)
    hit = surface_at(balls.gaussians, camera, 40.0, 30.0)
    return hit, center + (position - center) / np.linalg.norm(position - center) * RADIUS


@pytest.mark.parametrize("number", range(5))
def test_a_click_selects_the_ball_that_is_seen_there(balls, field, number):
    hit, expected = click(balls, number)
    assert np.linalg.norm(hit.point - expected) < 0.15
    assert set(balls.labels[hit.indices.numpy()]) == {number}
    chosen = select_hit(hit, balls.gaussians, field, balls.cameras)
    assert np.array_equal(chosen.mask.numpy(), balls.labels == number)


def test_the_clicked_position_selects_among_objects_of_one_meaning(balls):
    codes = torch.from_numpy(np.where(balls.labels == 1, 0, balls.labels).astype(np.uint8))[:, None]
    same = CodeField(balls.codebook, codes, torch.ones(len(codes), 1), torch.zeros(len(codes)))
    chosen = select_hit(click(balls, 1)[0], balls.gaussians, same, balls.cameras)
    assert np.array_equal(chosen.mask.numpy(), balls.labels == 1)


def test_similarity_is_the_cosine_of_features(balls, field):
    features = torch.nn.functional.normalize(balls.codebook.clip, dim=-1)[balls.labels]
    expected = (features @ features[balls.labels == 2][0]).clamp(0, 1)
    assert torch.allclose(similarity_to(click(balls, 2)[0], field), expected, atol=1e-5)


def test_the_point_of_a_pixel_is_where_its_ray_meets_the_ball_and_none_beside_it(balls):
    center = CENTERS[0]
    camera = look_at(center - np.array([0.0, 4.0, 0.0]), center, np.array([0.0, 0.0, 1.0]), 80, 60, 0.6)
    point = point_at(balls.gaussians, camera, 40.0, 30.0)
    assert point == pytest.approx(center - np.array([0.0, RADIUS, 0.0]), abs=0.15)
    pixels, _, _ = camera.project(point[None])
    assert pixels[0] == pytest.approx([40.0, 30.0], abs=1e-6), "on the ray of the pixel"
    sky = look_at([0.0, -6.0, 6.0], [0.0, 0.0, 8.0], np.array([0.0, 0, 1]), 40, 30, 0.5)
    assert point_at(balls.gaussians, sky, 20.0, 15.0) is None
    with pytest.raises(QueryError, match="outside"):
        point_at(balls.gaussians, camera, 80.0, 30.0)


def test_a_click_that_hits_nothing_is_refused(balls):
    camera = look_at([0.0, -6.0, 6.0], [0.0, 0.0, 8.0], np.array([0.0, 0, 1]), 40, 30, 0.5)
    with pytest.raises(QueryError, match="expected a surface, found nothing"):
        surface_at(balls.gaussians, camera, 20.0, 15.0)
    with pytest.raises(QueryError, match="outside"):
        surface_at(balls.gaussians, camera, 41.0, 15.0)
    for pixel in (("20", 15.0), (20.0, None), (np.nan, 15.0)):
        with pytest.raises(QueryError, match="a pixel of a 40x30 image"):
            surface_at(balls.gaussians, camera, *pixel)
