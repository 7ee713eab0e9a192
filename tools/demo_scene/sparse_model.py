"""The sparse COLMAP model of rendered images: triangulation with known, fixed poses.

Points come from the images alone: SIFT features of the training views, matched, verified and triangulated
by pycolmap. Held-out views have poses but no observations.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

MIN_TRACK = 3
MAX_ERROR = 0.7
"""What a point must have: views that see it, and mean reprojection error in pixels at most."""


def world_to_camera(camera_to_world: NDArray) -> pycolmap.Rigid3d:
    """From a pose with OpenGL axes (looking along -z, y up) to COLMAP's (along +z, y down)."""
    pose = np.asarray(camera_to_world, float) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return pycolmap.Rigid3d(np.linalg.inv(pose)[:3])


def pinhole(width: int, height: int, K: NDArray) -> pycolmap.Camera:
    parameters = [K[0][0], K[1][1], K[0][2], K[1][2]]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=parameters, camera_id=1)


def empty_model(camera: pycolmap.Camera) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    return model


def triangulate(
    images: Path, train: Sequence[str], camera: pycolmap.Camera, poses: Mapping[str, NDArray], seed: int
) -> pycolmap.Reconstruction:
    """Features, matches and points of the training views; intrinsics and poses stay fixed.

    Args:
        images: Folder of images.
        train: File names of the training views.
        camera: The one camera of all views.
        poses: Camera to world ``[4, 4]``, OpenGL axes, by file name.
        seed: For the random samples of verification and triangulation.
    """
    pycolmap.set_random_seed(seed)
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch) / "database.db"
        reader = pycolmap.ImageReaderOptions(
            camera_model=camera.model_name, camera_params=",".join(map(repr, camera.params.tolist()))
        )
        extraction = pycolmap.FeatureExtractionOptions()
        # Pictures are small and clean: features at twice the resolution, and faint ones too.
        extraction.sift.first_octave, extraction.sift.peak_threshold = -1, 0.003
        pycolmap.extract_features(
            database,
            images,
            list(train),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        verification = pycolmap.TwoViewGeometryOptions(detect_watermark=False)
        verification.ransac.random_seed = seed
        verification.ransac.max_error = 1.0  # pixels; images are free of distortion
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)

        model = empty_model(camera)
        for name, number in image_numbers(database).items():
            image = pycolmap.Image(name=name, camera_id=1, image_id=number)
            model.add_image_with_trivial_frame(image, world_to_camera(poses[name]))
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed)
        options.mapper.filter_max_reproj_error = 2.0
        # Poses are exact, so little is forgiven: bricks and squares repeat, and false matches come close.
        triangulation = options.triangulation
        triangulation.random_seed = seed
        triangulation.create_max_angle_error = triangulation.continue_max_angle_error = 0.3
        triangulation.re_max_angle_error = 0.5
        triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = 2.0
        model = pycolmap.triangulate_points(
            model, database, images, scratch, options=options, refine_intrinsics=False
        )
    model.extract_colors_for_all_images(images)
    return model


def image_numbers(database: Path) -> dict[str, int]:
    """Image numbers by file name, as assigned by feature extraction."""
    with pycolmap.Database.open(database) as opened:
        return {image.name: image.image_id for image in opened.read_all_images()}


def slim_model(
    model: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    poses: Mapping[str, NDArray],
) -> pycolmap.Reconstruction:
    """The good points of a model, only the keypoints that observe them, and every view of ``poses`` with its pose."""
    good = {
        number: point
        for number, point in model.points3D.items()
        if point.track.length() >= MIN_TRACK and point.error <= MAX_ERROR
    }
    seen: dict[str, list[int]] = {name: [] for name in poses}  # keypoints kept, by image
    old_names = {number: image.name for number, image in model.images.items()}
    new_numbers = {name: number for number, name in enumerate(sorted(poses), 1)}
    tracks: dict[int, list[pycolmap.TrackElement]] = {number: [] for number in good}
    for number in sorted(good):
        for element in good[number].track.elements:
            name = old_names[element.image_id]
            tracks[number].append(pycolmap.TrackElement(new_numbers[name], len(seen[name])))
            seen[name].append(element.point2D_idx)

    slim = empty_model(camera)
    by_name = {image.name: image for image in model.images.values()}
    for name, number in new_numbers.items():
        keypoints = np.array([by_name[name].points2D[i].xy for i in seen[name]], float).reshape(-1, 2)
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=number)
        slim.add_image_with_trivial_frame(image, world_to_camera(poses[name]))
    for number in sorted(good):
        slim.add_point3D(good[number].xyz, pycolmap.Track(tracks[number]), good[number].color)
    slim.update_point_3d_errors()
    return slim


def depth_errors(model: pycolmap.Reconstruction, depths: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Relative distance of each point from the rendered surface: |z - depth| / depth, median over its views ``[P]``.

    The nearest depth within two pixels counts: a feature on an outline may lie on either side of it.

    Args:
        model: A sparse model.
        depths: Exact depths ``[H, W]`` along the viewing axis by image name.
    """
    errors = []
    for point in model.points3D.values():
        of_views = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            column, row = np.floor(image.points2D[element.point2D_idx].xy).astype(int)
            z = (image.cam_from_world() * point.xyz)[2]
            around = np.s_[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            depth = depths[image.name][around]
            of_views.append((np.abs(z - depth) / depth).min())
        errors.append(np.median(of_views))
    return np.array(errors)
