"""Cameras from photos alone: structure from motion by pycolmap.

Photos are taken as their pixels are stored, without turning them by their EXIF orientation: photos of one
camera then share one lens, and :func:`lexsplat.scenes.load_scene` reads the same pixels. COLMAP starts from
the focal length in the EXIF data.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lexsplat.errors import CaptureError
from lexsplat.progress import Event, Listener, silent
from lexsplat.scenes.images import IMAGE_SUFFIXES, image_size
from lexsplat.scenes.triangulation import quiet_pycolmap

if TYPE_CHECKING:
    import pycolmap

STAGE = "poses"
EXHAUSTIVE_LIMIT = 80
"""Up to so many photos every pair is matched; beyond, photos are taken to follow one another by name."""

SEQUENTIAL_OVERLAP = 12
MAX_SIDE = 1600
MAX_FEATURES = 8192


@dataclass(frozen=True)
class PhotoPoses:
    """What structure from motion made of a folder of photos.

    Args:
        root: Folder whose ``sparse/0`` holds the COLMAP model; load it with
            ``load_scene(root, images=folder)``.
        placed: Names of the photos that have a camera, sorted; relative to the photos' folder.
        left_out: Names of the photos that could not be placed, sorted.
        points: How many points were triangulated.
        models: How many models there were that did not join; the largest was kept.
    """

    root: Path
    placed: tuple[str, ...]
    left_out: tuple[str, ...]
    points: int
    models: int

    @property
    def note(self) -> str:
        """One line for people."""
        total = len(self.placed) + len(self.left_out)
        line = f"{len(self.placed)} of {total} photos placed, {self.points:,} points"
        return line if not self.left_out else f"{line}; left out: {', '.join(self.left_out)}"


def find_photos(folder: Path) -> list[str]:
    """Names of all photos below a folder, relative to it, with "/", sorted."""
    return sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()
    )


def poses_from_photos(
    folder: Path, output: Path, *, seed: int = 0, max_side: int = MAX_SIDE, listener: Listener = silent
) -> PhotoPoses:
    """Estimate the cameras of a folder of photos and write them as a COLMAP model.

    Args:
        folder: The photos, in subfolders if wanted.
        output: Where ``sparse/0`` is written, whole or not at all; one that is there is replaced.
        seed: Seed for pycolmap.
        max_side: Photos are scaled down to this longest side, in pixels, to seek features.
        listener: Hears of stage ``"poses"``: features, matches, then one unit a photo that is placed.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, or none can be placed.
    """
    folder, output = Path(folder), Path(output)
    names = _checked_photos(folder)
    total = len(names) + 2
    with tempfile.TemporaryDirectory(prefix="lexsplat-") as temporary, quiet_pycolmap(seed):
        database = Path(temporary) / "database.db"
        listener(Event(STAGE, 0, total))
        _extract(database, folder, names, max_side)
        listener(Event(STAGE, 1, total))
        _match(database, len(names), seed)
        listener(Event(STAGE, 2, total))
        models = _map(database, folder, Path(temporary) / "models", seed, total, listener)
        if not models:
            raise CaptureError(
                folder,
                expected="photos that overlap",
                found=f"{len(names)} photos of which none could be placed",
                remedy="take more photos with 60 to 80 percent overlap, moving the camera between them",
            )
        best = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
        placed = sorted(best.image(number).name for number in best.reg_image_ids())
        _write_model(best, output)
    listener(Event(STAGE, total, total, {"placed": len(placed), "photos": len(names)}))
    left_out = tuple(name for name in names if name not in set(placed))
    return PhotoPoses(output, tuple(placed), left_out, best.num_points3D(), len(models))


def _checked_photos(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise CaptureError(
            folder, expected="a folder of photos", found="no such folder", remedy="check the path"
        )
    names = find_photos(folder)
    if len(names) < 3:
        raise CaptureError(
            folder,
            expected="at least 3 photos",
            found=str(len(names)),
            remedy="take 30 or more photos around the place",
        )
    for name in names:
        image_size(folder / name)
    return names


def _extract(database: Path, folder: Path, names: list[str], max_side: int) -> None:
    """SIFT features of all photos; photos of one size in one folder are taken to share a lens."""
    import pycolmap

    sizes = {image_size(folder / name) for name in names}
    mode = pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.AUTO
    pycolmap.Database.open(database).close()
    # Importing first gives the images their ids in order; extraction alone numbers them as threads finish.
    pycolmap.import_images(database, folder, mode, names)
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_side)
    options.sift.max_num_features = MAX_FEATURES
    pycolmap.extract_features(
        database, folder, names, camera_mode=mode, extraction_options=options, device=pycolmap.Device.cpu
    )


def _match(database: Path, count: int, seed: int) -> None:
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    if count <= EXHAUSTIVE_LIMIT:
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
        return
    # Quadratic overlap adds photos 2, 4, 8, ... further on, which closes the loops of a walk around.
    pairing = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    pycolmap.match_sequential(
        database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
    )


def _map(
    database: Path, folder: Path, models: Path, seed: int, total: int, listener: Listener
) -> list[pycolmap.Reconstruction]:
    import pycolmap

    placed = 2

    def another() -> None:
        nonlocal placed
        placed = min(placed + 1, total)
        listener(Event(STAGE, placed, total))

    models.mkdir()
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, min_model_size=3)
    found = pycolmap.incremental_mapping(
        database, folder, models, options, initial_image_pair_callback=another, next_image_callback=another
    )
    return [found[key] for key in sorted(found)]


def _write_model(model: pycolmap.Reconstruction, output: Path) -> None:
    """Write ``sparse/0`` beside its place and then exchange it, so that no half model is ever found."""
    final = output / "sparse" / "0"
    final.parent.mkdir(parents=True, exist_ok=True)
    temporary = final.with_name(f".0.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        model.write_binary(temporary)
        if final.exists():
            shutil.rmtree(final)
        os.replace(temporary, final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
