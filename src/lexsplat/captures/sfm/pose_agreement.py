"""Finds mis-registered photos: those whose verified matches contradict their pose.

An incremental mapper registers a photo from the few points it has at that moment and never revisits it. A
mis-registered photo stays in the model with hardly a point, and the reconstruction then fits a false view. Its
matches with neighboring photos, verified pair by pair before registration, reveal the error.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.sfm.pycolmap_import import pycolmap

MAX_ERROR = 4.0
"""Sampson distance in pixels within which a match agrees with two cameras; pycolmap's threshold for pairs."""

MIN_AGREEMENT = 0.5
"""A photo is mis-registered if fewer than this share of its matches agree. Its neighbors have many others that do."""


def agreements(model: pycolmap.Reconstruction, database: pycolmap.Database) -> dict[int, float]:
    """For each registered photo, the share of its verified matches with registered photos that agrees with the poses.

    Args:
        model: The cameras; image ids are those of the database.
        database: Keypoints, and matches verified pair by pair.

    Returns:
        Shares in 0..1 by image id; photos that match no registered photo are absent.
    """
    registered = set(model.reg_image_ids())
    rays = {number: _rays(_camera(model, number), database.read_keypoints(number)) for number in registered}
    agreeing, compared = dict.fromkeys(registered, 0), dict.fromkeys(registered, 0)
    for pair, geometry in zip(*database.read_two_view_geometries()):
        first, second = map(int, pycolmap.pair_id_to_image_pair(pair))
        matches = geometry.inlier_matches
        if first not in registered or second not in registered or not len(matches):
            continue
        errors = sampson_errors(model, first, second, rays, matches)
        for number in (first, second):
            agreeing[number] += int((errors < MAX_ERROR).sum())
            compared[number] += len(matches)
    return {number: agreeing[number] / count for number, count in compared.items() if count}


def sampson_errors(
    model: pycolmap.Reconstruction,
    first: int,
    second: int,
    rays: Mapping[int, NDArray[np.float64]],
    matches: NDArray[np.integer],
) -> NDArray[np.float64]:
    """First-order distances of matches from the epipolar geometry of two registered photos.

    Args:
        model: The cameras.
        first: Id of one photo.
        second: Id of the other.
        rays: Keypoints of each photo in its normalized image plane ``[n, 2]``, by image id.
        matches: Indices of keypoints in the first and in the second photo ``[m, 2]``.

    Returns:
        Distances in pixels ``[m]``; infinite where both cameras share a position.
    """
    motion = model.image(second).cam_from_world() * model.image(first).cam_from_world().inverse()
    x, y, z = motion.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion.rotation.matrix()
    ones = np.ones((len(matches), 1))
    a = np.hstack([rays[first][matches[:, 0]], ones])
    b = np.hstack([rays[second][matches[:, 1]], ones])
    lines_b, lines_a = a @ essential.T, b @ essential
    gradient = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.abs((b * lines_b).sum(1)) / np.sqrt(gradient)
    focal = (_camera(model, first).mean_focal_length() + _camera(model, second).mean_focal_length()) / 2
    return np.nan_to_num(distances * focal, nan=np.inf)


def misregistered(model: pycolmap.Reconstruction, database: pycolmap.Database) -> list[int]:
    """Ids of the registered photos whose pose most of their matches contradict."""
    shares = agreements(model, database)
    return sorted(number for number, share in shares.items() if share < MIN_AGREEMENT)


def deregister(model: pycolmap.Reconstruction, images: list[int]) -> None:
    """Remove photos and their observations from a model."""
    for number in images:
        frame = model.image(number).frame_id
        if model.frame(frame).has_pose():
            model.deregister_frame(frame)


def register_again(
    model: pycolmap.Reconstruction,
    images: list[int],
    database: Path,
    photos: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """Register photos again in a model of all the others; those that are mis-registered again are removed.

    Args:
        model: The model; the photos are removed from it.
        images: Ids of the mis-registered photos.
        database: Features and matches; intermediate files are written beside it.
        photos: Folder of the photos.
        options: Mapper options.

    Returns:
        A model without mis-registered photos.
    """
    deregister(model, images)
    folder = database.parent / "again"
    shutil.rmtree(folder, ignore_errors=True)
    trusted = folder / "trusted"
    trusted.mkdir(parents=True)
    model.write_binary(trusted)
    found = pycolmap.incremental_mapping(database, photos, folder, options, input_path=trusted)
    again = max(found.values(), key=lambda m: m.num_reg_images(), default=model)
    if again.num_reg_images() < model.num_reg_images():
        return model
    with pycolmap.Database.open(database) as opened:
        deregister(again, misregistered(again, opened))
    return again


def _camera(model: pycolmap.Reconstruction, image: int) -> pycolmap.Camera:
    return model.camera(model.image(image).camera_id)


def _rays(camera: pycolmap.Camera, keypoints: NDArray[np.floating]) -> NDArray[np.float64]:
    """Keypoints ``[n, 2+]`` in pixels as undistorted points ``[n, 2]`` of the normalized image plane."""
    if not len(keypoints):
        return np.empty((0, 2))
    return np.asarray(camera.cam_from_img(np.asarray(keypoints[:, :2], np.float64)))
