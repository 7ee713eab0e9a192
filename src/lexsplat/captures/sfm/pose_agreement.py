"""Whether photos stand where their matches say.

An incremental mapper places a photo by the few points that it has at that moment, and does not come back to it: a
photo that was placed wrongly stays, with hardly a point, and teaches a reconstruction something that nobody saw.
The matches with its neighbors, verified pair by pair before any photo was placed, tell: they contradict its place.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

MAX_ERROR = 4.0
"""Pixels (Sampson distance) within which a match agrees with two cameras; what pycolmap verifies pairs with."""

MIN_AGREEMENT = 0.5
"""A photo that most of its matches contradict is misplaced. Its neighbors each have many others that agree."""


def agreements(model: pycolmap.Reconstruction, database: pycolmap.Database) -> dict[int, float]:
    """The share of each placed photo's verified matches with other placed photos that agrees with the cameras.

    Args:
        model: The cameras; its images carry the numbers that they have in the database.
        database: Keypoints, and matches that were verified pair by pair.

    Returns:
        The share for each image, 0 to 1, by its number; without those that match no placed photo.
    """
    registered = set(model.reg_image_ids())
    rays = {number: _rays(_camera(model, number), database.read_keypoints(number)) for number in registered}
    agreeing, compared = dict.fromkeys(registered, 0), dict.fromkeys(registered, 0)
    for pair, geometry in zip(*database.read_two_view_geometries()):
        first, second = _images_of(pair)
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
    """First-order distances of matches from the epipolar geometry of two placed photos.

    Args:
        model: The cameras.
        first: Number of one photo.
        second: Number of the other.
        rays: Keypoints of each photo in its normalized image plane ``[n, 2]``, by its number.
        matches: Indices of keypoints in the first and in the second ``[m, 2]``.

    Returns:
        Distances in pixels ``[m]``; infinite where both cameras stand at one point.
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
    """Numbers of the placed photos that most of their matches contradict."""
    shares = agreements(model, database)
    return sorted(number for number, share in shares.items() if share < MIN_AGREEMENT)


def deregister(model: pycolmap.Reconstruction, images: list[int]) -> None:
    """Take photos, and what they say of points, out of a model."""
    for number in images:
        frame = model.image(number).frame_id
        if model.frame(frame).has_pose():
            model.deregister_frame(frame)


def register_again(
    model: pycolmap.Reconstruction,
    images: list[int],
    database: Path,
    photos: Path,
    folder: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """Place photos anew in a model that has all the others; those that are misplaced again are left out of it.

    Args:
        model: The model; the photos are taken out of it.
        images: Numbers of the misplaced photos.
        database: Where features and matches are.
        photos: Folder of the photos.
        folder: For intermediate files; what is there is removed.
        options: Of the mapper.

    Returns:
        The model to go on with: one in which no photo is misplaced.
    """
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    deregister(model, images)
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
    """Keypoints ``[n, 2+]`` in pixels to the normalized image plane ``[n, 2]``, without the lens's distortion."""
    if not len(keypoints):
        return np.empty((0, 2))
    return np.asarray(camera.cam_from_img(np.asarray(keypoints[:, :2], np.float64)))


def _images_of(pair: int) -> tuple[int, int]:
    """The two images of a pair as a COLMAP database numbers it."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    first, second = pycolmap.pair_id_to_image_pair(pair)
    return int(first), int(second)
