"""Gaussians of another program that a build takes instead of reconstructing."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lexsplat.captures import View
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import render
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import refuse_pickle
from lexsplat.runtime.fingerprints import file_hash, fingerprint
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.formats.reading import reader_of, splat_file
from lexsplat.scenes.formats.sog import META
from lexsplat.scenes.formats.sog_streamed import LOD_META
from lexsplat.scenes.formats.splat import WITHOUT_MIP_FLAG

log = logging.getLogger("lexsplat")

CHECKED_VIEWS = 8
"""Number of views in which the Gaussians are looked for."""

MIN_COVERAGE = 0.1
"""Least mean coverage of these views."""

MIN_AGREEMENT = 0.25
"""Least median correlation of renders with photos in these views."""


_COMPARED_VIEWS = 4
"""Number of views that are rendered at full size with and without the mip filter."""


def existing_splats(path: Path | None) -> Path:
    """The path, if it is a file, or the file that names the parts of a SOG in a folder.

    Raises:
        FileFormatError: If there is no such file, or its ending is that of no format that is read.
    """
    if path is None or not splat_file(path).is_file():
        is_folder = path is not None and path.is_dir()
        found = f"a folder without {META} and {LOD_META}" if is_folder else "no such file"
        raise FileFormatError(path, expected="a file of Gaussians", found=found, remedy="check the path")
    file = splat_file(path)
    refuse_pickle(file)
    reader_of(file)
    return file


def splats_hash(path: Path | None) -> str:
    """Hash of the content of the file; of the parts of a SOG in a folder, of all files that they may be.

    Raises:
        FileFormatError: If there is no such file.
    """
    file = existing_splats(path)
    if file.name not in (META, LOD_META):
        return file_hash(file)
    parts = sorted(part for part in file.parent.rglob("*") if part.suffix in (".json", ".webp", ".sog"))
    return fingerprint({part.relative_to(file.parent).as_posix(): file_hash(part) for part in parts})


def check_agreement(gaussians: Gaussians, views: list[View], subject: Path) -> None:
    """Refuse Gaussians whose renders do not agree with the photos: they have other cameras, axes, units or places.

    Renders and photos are compared without their smooth parts, which exposure changes: their correlation is .98 for
    the bundled scene, .21 with cameras turned by 2 degrees, and about 0 with photos of another place.

    Raises:
        CaptureError: If they cover less than `MIN_COVERAGE` of the views, or their median correlation with the photos
            is below `MIN_AGREEMENT`.
    """
    shares, agreements = [], []
    for view in evenly(views, CHECKED_VIEWS):
        camera = view.camera.within(96)
        with torch.no_grad():
            found = render(gaussians, camera, color=True)
        alpha = found.alpha.cpu().numpy()
        shares.append(float(alpha.mean()))
        photo = view.load_image((camera.width, camera.height)).mean(-1)
        details = [_details(image)[alpha > 0.5] for image in (found.image.cpu().numpy().mean(-1), photo)]
        if all(len(part) and part.std() > 0 for part in details):
            agreements.append(float(np.asarray(np.corrcoef(np.stack(details)))[0, 1]))
    if np.mean(shares) < MIN_COVERAGE:
        raise CaptureError(
            subject,
            expected="Gaussians in the axes and units of the cameras",
            found=f"Gaussians that cover {np.mean(shares):.0%} of the views",
            remedy="use the poses with which the Gaussians were trained",
        )
    if agreements and np.median(agreements) < MIN_AGREEMENT:
        raise CaptureError(
            subject,
            expected="Gaussians of the place in the photos, in the axes and units of the cameras",
            found=f"renders that correlate with the photos by {np.median(agreements):.2f}",
            remedy="use the photos and poses with which the Gaussians were trained",
        )


def with_filter_of_photos(gaussians: Gaussians, views: list[View], subject: Path) -> Gaussians:
    """The Gaussians with the mip filter, or without, whichever renders the photos better.

    Only for files of `WITHOUT_MIP_FLAG`; the other formats say it. A note names what is taken instead of the default.
    """
    if not str(subject).lower().endswith(WITHOUT_MIP_FLAG):
        return gaussians
    plain, filtered = (replace(gaussians, antialiased=needed) for needed in (False, True))
    errors = np.zeros(2)
    for view in evenly(views, _COMPARED_VIEWS):
        photo = view.load_image((view.camera.width, view.camera.height))
        with torch.no_grad():
            renders = [
                render(each, view.camera, color=True).image.cpu().numpy() for each in (plain, filtered)
            ]
        errors += [float(np.square(image - photo).mean()) for image in renders]
    if errors[1] >= errors[0]:
        return plain
    before, after = -10 * np.log10(np.maximum(errors / min(len(views), _COMPARED_VIEWS), 1e-12))
    told = "%s: read as trained with the mip filter, which the format cannot say: PSNR to photos %.2f dB, else %.2f"
    log.log(NOTE, told, subject, after, before)
    return filtered


def _details(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """An image ``[H, W]`` without noise and without its smooth part."""
    return gaussian_filter(image, 1) - gaussian_filter(image, 4)
