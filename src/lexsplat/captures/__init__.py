"""Captures: from photos and camera files to views with pinhole cameras, keyed by image name.

The path of a photo, file by file:

- `sfm/`: cameras for photos that have none; `readers/video.py`: photos from a video.
- `readers/`: camera files to `CameraFiles`; `loading.py`: those to a `Capture`, with the split of `splits.py`.
- `capture.py`: `Capture` and `View`, which every other package uses.
- `images/`: reading, masking and undistorting the pixels of a view; `ground_truth/`: annotations for evaluation.

To add a reader of camera files: write ``readers/FORMAT.py`` with ``find_FORMAT(root) -> Path | None`` and
``read_FORMAT(path) -> CameraFiles`` (take names, lenses and poses through `checked_name`, `checked_lens` and
`checked_pose`), call both in ``loading._read_camera_files`` and ``loading._has_cameras``, and add a valid file to
``tests/support/hostile``.
To add a layout of ground truth, see ``ground_truth/layouts.py``.
"""

from typing import TYPE_CHECKING

from lexsplat.runtime.lazy import at_first_use

if TYPE_CHECKING:
    from lexsplat.captures.capture import Capture, View, stem_of
    from lexsplat.captures.ground_truth.layouts import (
        Annotations,
        check_ground_truth_options,
        load_annotations,
    )
    from lexsplat.captures.images.undistortion import Lens
    from lexsplat.captures.loading import is_photo_folder, load_capture
    from lexsplat.captures.sfm.photos import PhotoPoses, PoseConfig, poses_from_photos
    from lexsplat.captures.sfm.triangulation import (
        InitialPoints,
        initial_points,
        random_points_in_frusta,
        triangulate,
    )

__all__ = [
    "Annotations",
    "Capture",
    "InitialPoints",
    "Lens",
    "PhotoPoses",
    "PoseConfig",
    "View",
    "check_ground_truth_options",
    "initial_points",
    "is_photo_folder",
    "load_annotations",
    "load_capture",
    "poses_from_photos",
    "random_points_in_frusta",
    "stem_of",
    "triangulate",
]

__getattr__ = at_first_use(
    "lexsplat.captures",
    {
        "capture": ("Capture", "View", "stem_of"),
        "ground_truth.layouts": ("Annotations", "check_ground_truth_options", "load_annotations"),
        "images.undistortion": ("Lens",),
        "loading": ("is_photo_folder", "load_capture"),
        "sfm.photos": ("PhotoPoses", "PoseConfig", "poses_from_photos"),
        "sfm.triangulation": ("InitialPoints", "initial_points", "random_points_in_frusta", "triangulate"),
    },
)
