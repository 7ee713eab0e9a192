"""Splats that were made from one photo: they fill the image of a camera at the origin, and have no backs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.viewpoints.candidates import FOV_Y, around
from lexsplat.pipeline.viewpoints.surroundings import SOLID, Surroundings, Target
from lexsplat.rendering import measure_weights
from lexsplat.rendering.compositing import NEAR

_WIDEST = math.tan(math.radians(60))
"""Half of the image of the widest lens, in distances from it."""
_CELLS = 8
"""Cells along either side of the image, in which Gaussians are counted."""
_FILLED = 0.75
"""Least share of cells with a fourth of the mean number. Things are islands in the image; a photo fills it."""
_CENTERED = 0.1
"""Largest distance of the middle of that image from the optical axis, relative to its size."""
_SEEN = 0.6
"""Least share of the Gaussians that the camera sees; of a scene from all around it sees the front side."""
_LEAST_WEIGHT = 0.1
_HEIGHT = 480
"""Height in pixels of the image that is drawn."""
_ASIDE = ((0, 0), (0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1))
"""Places around that of the photo, relative to the middle depth."""
_OBLIQUE = math.cos(math.radians(40))
"""Cosine of the angle at a target, between the photo and a view, beyond which holes behind things are seen."""

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Photo:
    """The photo that splats were made from, taken at the origin.

    Args:
        ahead: Its viewing direction ``[3]``: +z of the OpenCV convention, -z of the OpenGL one.
        up: The up direction of the image ``[3]``.
    """

    ahead: Points
    up: Points

    def candidates(self, found: Surroundings, size: tuple[int, int]) -> list[tuple[Camera, Target]]:
        """Cameras near that of the photo, and those around the scene that see about the same sides of things."""
        across = np.cross(self.ahead, self.up)
        depth = float(np.median(found.tree.data @ self.ahead))
        near = [
            (look_at(depth * (x * across + y * self.up), target.center, self.up, *size, FOV_Y), target)
            for x, y in _ASIDE
            for target in (found.whole, *found.targets)
        ]
        return near + [
            (camera, target) for camera, target in around(found, size) if _is_shown(camera, target.center)
        ]


def _is_shown(camera: Camera, target: Points) -> bool:
    """Whether a camera looks at a target from about the side that a camera at the origin sees."""
    away = target - camera.position
    return bool(target @ away > _OBLIQUE * np.linalg.norm(target) * np.linalg.norm(away))


@torch.no_grad()
def find_photo(gaussians: Gaussians) -> Photo | None:
    """The photo that splats were made from, if they look like it.

    They are in front of the origin, fill a rectangle around the axis as seen from there evenly, and hardly any is
    hidden from there.
    """
    solid = (gaussians.opacities > SOLID).cpu().numpy()
    points = gaussians.means.detach().cpu().double().numpy()[solid]
    for sign in (1.0, -1.0):
        depths = sign * points[:, 2]
        if not len(points) or np.quantile(depths, 0.005) <= NEAR:
            continue
        front = depths > NEAR
        image = points[front, :2] / depths[front, None]
        low, high = np.quantile(image, [0.005, 0.995], axis=0)
        size = high - low
        if (np.abs([low, high]) > _WIDEST).any() or (np.abs(low + high) > 2 * _CENTERED * size).any():
            continue
        counts, *_ = np.histogram2d(
            image[:, 0], image[:, 1], bins=_CELLS, range=[[low[0], high[0]], [low[1], high[1]]]
        )
        if (counts > counts.mean() / 4).mean() < _FILLED:
            continue
        photo = Photo(np.array([0, 0, sign]), np.array([0, -sign, 0]))
        camera = look_at(
            np.zeros(3), photo.ahead, photo.up,
            max(1, round(_HEIGHT * float(size[0] / max(size[1], 1e-9)))), _HEIGHT, 2 * math.atan(float(size[1]) / 2),
        )  # fmt: skip
        weights = measure_weights(gaussians, camera).cpu().numpy()[solid]
        if (weights > _LEAST_WEIGHT).mean() >= _SEEN:
            return photo
    return None
