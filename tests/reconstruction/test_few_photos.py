"""Few photos: the points that are added to those of structure from motion, and the warning."""

import dataclasses
import logging

import numpy as np
import pytest

from lexsplat.evaluation.metrics import psnr
from lexsplat.reconstruction import (
    LONG_TRAINING,
    ReconstructionConfig,
    Reconstructor,
    few_photos,
    reconstruct,
)
from lexsplat.reconstruction.few_photos import points_between
from lexsplat.rendering import render

SHORT = ReconstructionConfig(iterations=3, sh_degree=1, max_gaussians=3_000)


@pytest.mark.slow
def test_an_added_point_has_the_depth_of_the_nearest_known_point_in_its_photo_and_the_color_of_its_pixel(
    capture, points, monkeypatch
):
    monkeypatch.setattr(few_photos, "PIXELS_A_POINT", 2)
    name = capture.train_names[2]
    camera, photo = capture.views[name].camera, capture.views[name].load_image()
    one = dataclasses.replace(capture, train_names=(name,))
    monkeypatch.setattr(few_photos, "ENOUGH_POINTS", camera.width * camera.height)
    found = points_between(one, points)
    known = len(points.points)
    np.testing.assert_array_equal(found.points[:known], points.points)
    assert len(found.points) == camera.width * camera.height // 2

    def project(point):
        x, y, depth = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
        u, v, _ = camera.K @ [x / depth, y / depth, 1]
        return np.array([u, v]), depth

    shown = [(place, depth) for place, depth in map(project, points.points.astype(np.float64)) if depth > 0]
    shown = [
        (place, depth)
        for place, depth in shown
        if 0 <= place[0] < camera.width and 0 <= place[1] < camera.height
    ]
    places = np.stack([place for place, _ in shown])
    for point, color in zip(found.points[known:].astype(np.float64), found.colors[known:]):
        place, depth = project(point)
        distances = np.linalg.norm(places - place, axis=1)
        assert depth == pytest.approx(shown[int(np.argmin(distances))][1], rel=1e-4)
        u, v = place
        assert color == pytest.approx(photo[int(v), int(u)], abs=0.02) or min(u % 1, v % 1) < 1e-3


def test_no_point_is_added_under_a_mask(capture, points, monkeypatch):
    monkeypatch.setattr(few_photos, "PIXELS_A_POINT", 2)
    half = capture.views[capture.train_names[0]].camera.width // 2

    def right_half(view, size=None):
        valid = np.zeros((view.camera.height, view.camera.width), bool)
        valid[:, half:] = True
        return valid

    monkeypatch.setattr(type(capture.train_views[0]), "load_valid", right_half)
    one = dataclasses.replace(capture, train_names=capture.train_names[:1])
    found, camera = points_between(one, points), one.train_views[0].camera
    added = found.points[len(points.points) :]
    local = added @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    columns = local[:, 0] / local[:, 2] * camera.K[0, 0] + camera.K[0, 2]
    assert len(added) > 0
    assert columns.min() > half - 1e-3


def test_no_point_is_added_where_there_are_enough(capture, points, monkeypatch):
    monkeypatch.setattr(few_photos, "ENOUGH_POINTS", len(points.points))
    np.testing.assert_array_equal(points_between(capture, points).points, points.points)


def test_many_photos_start_from_the_known_points_alone(capture, monkeypatch, caplog):
    def refuse(*_):
        raise AssertionError("points were added")

    monkeypatch.setattr("lexsplat.reconstruction.few_photos.points_between", refuse)
    monkeypatch.setattr(few_photos, "FEW_PHOTOS", len(capture.train_names) - 1)
    reconstruct(capture, SHORT)
    assert not caplog.records
    monkeypatch.setattr(few_photos, "FEW_PHOTOS", len(capture.train_names))
    with pytest.raises(AssertionError, match="points were added"):
        reconstruct(capture, SHORT)


def test_a_warning_states_how_well_held_out_photos_are_rendered(capture, caplog):
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        gaussians = reconstruct(capture, SHORT)
    (record,) = caplog.records
    found = [
        psnr(render(gaussians, view.camera).image.clamp(0, 1).numpy(), view.load_image())
        for view in capture.test_views
    ]
    assert f"{len(found)} held-out photos are rendered at {np.mean(found):.1f} dB" in record.getMessage()
    caplog.clear()
    one = dataclasses.replace(capture, test_names=capture.test_names[:1])
    few_photos.warn_of_few_photos(one, gaussians)
    assert ": 1 held-out photo is rendered at " in caplog.text
    caplog.clear()
    one = dataclasses.replace(capture, test_names=(), train_names=capture.train_names[:1])
    few_photos.warn_of_few_photos(one, gaussians)
    assert "1 training photo is few; " in caplog.text
    caplog.clear()
    reconstruct(dataclasses.replace(capture, test_names=()), SHORT)
    assert "dB" not in caplog.text
    assert "are few" in caplog.text


def test_few_photos_are_regularized_and_their_exposure_is_fitted(capture, points, monkeypatch):
    def settings(config):
        found = Reconstructor(capture, config, points).config
        return found.opacity_weight, found.scale_weight, found.exposure

    assert settings(SHORT) == (0.01, 0.01, True)
    assert settings(dataclasses.replace(SHORT, exposure=False, scale_weight=0.5)) == (0.01, 0.5, False)
    assert settings(dataclasses.replace(SHORT, iterations=LONG_TRAINING)) == (0, 0, False), "as measured"
    monkeypatch.setattr(few_photos, "FEW_PHOTOS", len(capture.train_names) - 1)
    assert settings(SHORT) == (0, 0, False)
    assert settings(dataclasses.replace(SHORT, strategy="mcmc")) == (0.01, 0.01, False)
