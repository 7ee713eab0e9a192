"""Gaussians of another program that a build takes instead of reconstructing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import render
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.sampling import evenly

CHECKED_VIEWS = 8
"""Number of views in which the Gaussians are looked for."""

MIN_COVERAGE = 0.1
"""Least mean coverage of these views."""


def existing_splats(path: Path | None) -> Path:
    """The path, if it is a file.

    Raises:
        FileFormatError: If there is no such file.
    """
    if path is None or not path.is_file():
        raise FileFormatError(path, expected="a file of Gaussians", found="no such file")
    return path


def check_in_view(gaussians: Gaussians, cameras: list[Camera], subject: Path) -> None:
    """Refuse Gaussians that the cameras do not see: they belong to other cameras, axes or units.

    Raises:
        CaptureError: If they cover less than `MIN_COVERAGE` of the views.
    """
    shares = []
    with torch.no_grad():
        for camera in evenly(cameras, CHECKED_VIEWS):
            small = camera.downscaled(max(1.0, max(camera.width, camera.height) / 96))
            shares.append(float(render(gaussians, small, color=True).alpha.mean()))
    if np.mean(shares) < MIN_COVERAGE:
        raise CaptureError(
            subject,
            expected="Gaussians in the axes and units of the cameras",
            found=f"Gaussians that cover {np.mean(shares):.0%} of the views",
            remedy="use the poses with which the Gaussians were trained",
        )
