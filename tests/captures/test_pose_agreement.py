"""Mis-registered photos are found, and registered again or removed."""

from __future__ import annotations

import copy

import numpy as np
import pycolmap
import pytest
from support.poses import move

from lexsplat.captures.sfm.pose_agreement import agreements, misregistered, register_again, sampson_errors
from lexsplat.captures.sfm.pycolmap_import import quiet_pycolmap

WRONG = 4


@pytest.fixture
def registered(tmp_path):
    """Ten photos of a hundred points with exact matches (pycolmap's synthetic data), and their database."""
    path = tmp_path / "database.db"
    options = pycolmap.SyntheticDatasetOptions(num_points3D=100, camera_params=[1280.0, 512.0, 384.0, 0.05])
    pycolmap.set_random_seed(0)
    with quiet_pycolmap(0), pycolmap.Database.open(path) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return model, path


def center(model, number) -> np.ndarray:
    return model.image(number).projection_center()


def test_correctly_registered_photos_agree_with_all_their_matches(registered):
    model, path = registered
    with pycolmap.Database.open(path) as database:
        shares = agreements(model, database)
        assert misregistered(model, database) == []
    assert set(shares) == set(model.reg_image_ids())
    assert min(shares.values()) == 1.0


def test_only_the_photo_that_was_moved_is_mis_registered(registered):
    model, path = registered
    move(model, WRONG)
    with pycolmap.Database.open(path) as database:
        shares = agreements(model, database)
        assert misregistered(model, database) == [WRONG]
    # Each of the other nine has eight neighbors that agree, with equally many matches.
    assert all(share >= 8 / 9 for number, share in shares.items() if number != WRONG)


def test_errors_of_matches_are_distances_in_pixels():
    """A point d pixels from its epipolar line has an error of d / sqrt(2) if both lines have equal weight."""
    camera = pycolmap.Camera(model="PINHOLE", width=1000, height=1000, params=[500.0, 500.0, 500.0, 500.0])
    views = pycolmap.Reconstruction()
    camera.camera_id = 1
    views.add_camera_with_trivial_rig(camera)
    for number, x in ((1, 0.0), (2, 1.0)):
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.0, 0.0]))
        image = pycolmap.Image(name=f"{number}", camera_id=1, image_id=number)
        views.add_image_with_trivial_frame(image, motion)
    # For cameras side by side, epipolar lines are rows: the second match is off by 3 pixels.
    rays = {1: np.array([[0.1, 0.2], [0.1, 0.2]]), 2: np.array([[-0.3, 0.2], [-0.3, 0.2 + 3 / 500]])}
    errors = sampson_errors(views, 1, 2, rays, np.array([[0, 0], [1, 1]]))
    np.testing.assert_allclose(errors, [0, 3 / np.sqrt(2)], atol=1e-9)


def test_a_mis_registered_photo_is_registered_again_correctly(registered, tmp_path):
    model, path = registered
    ground_truth = {number: center(model, number) for number in model.reg_image_ids()}
    move(model, WRONG)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, min_model_size=3)
    with quiet_pycolmap(0):
        again = register_again(model, [WRONG], path, tmp_path, options)
    assert set(again.reg_image_ids()) == set(ground_truth)
    # The mapper may apply a similarity transform: ratios of distances between photos are preserved.
    others = sorted(set(ground_truth) - {WRONG})
    expected = np.array([np.linalg.norm(ground_truth[WRONG] - ground_truth[other]) for other in others])
    found = np.array([np.linalg.norm(center(again, WRONG) - center(again, other)) for other in others])
    unit = [
        np.linalg.norm(c[others[0]] - c[others[-1]])
        for c in (ground_truth, {n: center(again, n) for n in ground_truth})
    ]
    np.testing.assert_allclose(found / unit[1], expected / unit[0], rtol=0.01)
    with pycolmap.Database.open(path) as database:
        assert misregistered(again, database) == []


def test_a_photo_that_is_mis_registered_again_is_removed(registered, tmp_path, monkeypatch):
    model, path = registered
    everyone = set(model.reg_image_ids())
    move(model, WRONG)
    misled = copy.deepcopy(model)
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *args, **options: {0: misled})
    with quiet_pycolmap(0):
        again = register_again(model, [WRONG], path, tmp_path, None)
    assert set(again.reg_image_ids()) == everyone - {WRONG}
