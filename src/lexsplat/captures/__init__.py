"""Captures: photos with cameras in, views with pinhole cameras out, everything keyed by image name."""

from lexsplat.captures.capture import Capture, View, stem_of
from lexsplat.captures.ground_truth.layouts import Annotations, check_ground_truth_options, load_annotations
from lexsplat.captures.ground_truth.masks import load_mask, load_masks
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
    "load_mask",
    "load_masks",
    "poses_from_photos",
    "random_points_in_frusta",
    "stem_of",
    "triangulate",
]
