"""Claims about splats made from one photo, and about views that hide most of what can be seen."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from support.splats import solid

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints import choosing
from lexsplat.pipeline.viewpoints.choosing import choose_views
from lexsplat.pipeline.viewpoints.interior import Interior
from lexsplat.pipeline.viewpoints.looking import SMALL
from lexsplat.pipeline.viewpoints.one_photo import find_photo
from lexsplat.runtime.errors import CaptureError

UP = np.array([0.0, 0.0, 1.0])


def one_photo(count: int = 5000) -> np.ndarray:
    """A floor, a back wall and a ball as a camera at the origin sees them: x right, y down, z ahead."""
    rays = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [0.55, 0.42, 0] + [0, 0, 1]
    depths = np.minimum(5.0, 1.4 / np.maximum(rays[:, 1], 1e-9))
    center, radius = np.array([0.3, 0.6, 3.0]), 0.6
    along, square = rays @ center, (rays**2).sum(1)
    inside = along**2 - square * (center @ center - radius**2)
    ball = (along - np.sqrt(np.maximum(inside, 0))) / square
    return rays * np.where(inside > 0, ball, depths)[:, None]


def ball_on_table() -> np.ndarray:
    generator = np.random.default_rng(1)
    directions = generator.normal(size=(1500, 3))
    ball = 0.4 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [0, 0, 0.4]
    return np.concatenate([generator.uniform(-1.5, 1.5, (3000, 3)) * [1, 1, 0.002], ball])


def test_splats_of_one_photo_are_known_in_both_conventions_and_things_before_a_camera_are_none():
    photo = find_photo(solid(one_photo()))
    assert (photo.ahead.tolist(), photo.up.tolist()) == ([0, 0, 1], [0, -1, 0])
    flipped = find_photo(solid(one_photo() * [1, -1, -1]))
    assert (flipped.ahead.tolist(), flipped.up.tolist()) == ([0, 0, -1], [0, 1, 0])
    table = ball_on_table()
    assert find_photo(solid(table)) is None
    ahead = table[:, [0, 2, 1]] * [1, -1, 1] + [0, 0.5, 4]  # y down, 4 ahead of the camera
    assert find_photo(solid(ahead)) is None
    assert find_photo(solid(np.add(one_photo(), (4.0, 0, 0)))) is None


@pytest.mark.slow
def test_splats_of_one_photo_are_looked_at_from_near_it_with_a_warning(caplog, monkeypatch):
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 60)
    with caplog.at_level(logging.WARNING, "lexsplat"):
        chosen = choose_views(solid(one_photo()))
    assert "as splats made from one photo do" in caplog.text
    assert "the up direction is a guess (0,-1,0)" in caplog.text
    assert not chosen.up.reliable
    assert all(camera.viewmat[2, 2] > 0.5 for camera in chosen.cameras)  # none looks back
    assert chosen.unseen < 0.1 * chosen.visible


@pytest.mark.slow
@pytest.mark.parametrize(("share", "refused"), [(0.1, True), (0.5, False)])
def test_few_views_that_hide_most_of_what_can_be_seen_are_refused(monkeypatch, share, refused):
    """Three good views show a share of what all candidates show."""
    gaussians: Gaussians = solid(ball_on_table())
    camera = look_at(np.array([0, -3.0, 1.5]), np.zeros(3), UP, *SMALL, 0.7)
    weights = np.zeros((3, 100), np.float32)
    weights[:, : round(100 * share)] = 1
    room = Interior(9, 1.0, 0.1)
    tried = choosing._Tried(90, [camera] * 3, np.ones(3, np.float32), weights, np.ones(100, bool), room)
    monkeypatch.setattr(choosing, "_good_candidates", lambda *_: tried)
    if not refused:
        assert choose_views(gaussians, up=UP).unseen == pytest.approx(0.5 * len(gaussians), rel=0.01)
        return
    with pytest.raises(CaptureError, match="floaters or haze hide 90% of these Gaussians; remove"):
        choose_views(gaussians, up=UP)
