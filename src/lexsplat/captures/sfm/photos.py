"""Estimates cameras from photos alone: structure from motion with pycolmap.

Photos are processed upright (`lexsplat.captures.sfm.preparation`). Photos of the same size and focal length share a
lens, initialized from the EXIF focal length where there is one. Masked pixels yield no features.

Intermediate results live in a hidden folder of the output until the model is written, so an interrupted run resumes
with the features and matches it already has.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from PIL import Image

from lexsplat.captures.images.reading import image_size
from lexsplat.captures.sfm.feature_budget import check_mapping, extraction_threads, matching_plan
from lexsplat.captures.sfm.pose_agreement import misregistered, register_again
from lexsplat.captures.sfm.preparation import PreparedPhotos, find_photos, photo_folder, prepare_photos
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import BackendError, CaptureError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.fingerprints import file_stamp, fingerprint
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

__all__ = ["PhotoPoses", "PoseConfig", "find_photos", "photo_folder", "poses_from_photos"]

STAGE = "poses"
EXHAUSTIVE_LIMIT = 80
"""Up to this many photos every pair is matched; beyond it, photos are assumed to follow one another by name."""

SEQUENTIAL_OVERLAP = 12
BATCH = 8
"""Photos per call of SIFT extraction: the most work that an interruption can lose."""

MAX_LEFTOVER_PAIRS = 20_000
"""Most pairs that are matched to register photos which sequential matching left unregistered."""

_WORK = ".poses"


@dataclass(frozen=True)
class PoseConfig:
    """Settings of structure from motion.

    Args:
        mapper: "incremental" registers one photo after the other. "global" (GLOMAP) registers all at once: it is
            faster on many photos, and more sensitive to wrong matches.
        pairs: Which pairs of photos are matched. "exhaustive": all. "sequential": each photo with the next ones by
            name, and with those 2, 4, 8, ... further on, for videos and walks. "auto": exhaustive up to 80 photos;
            beyond, sequential, and then all pairs of the unregistered photos.
        max_side: Photos are scaled down to this longest side, in pixels, for feature extraction.
        max_features: Most features per photo.

    Raises:
        ValueError: If ``max_side`` or ``max_features`` is too small.
    """

    mapper: Literal["incremental", "global"] = "incremental"
    pairs: Literal["auto", "exhaustive", "sequential"] = "auto"
    max_side: int = 1600
    max_features: int = 8192

    def __post_init__(self) -> None:
        if self.max_side < 64 or self.max_features < 100:
            raise ValueError(
                "max_side must be at least 64 and max_features at least 100, "
                f"got {self.max_side} and {self.max_features}"
            )

    def compares_all(self, count: int) -> bool:
        """Whether every pair of ``count`` photos is matched."""
        return self.pairs == "exhaustive" or (self.pairs == "auto" and count <= EXHAUSTIVE_LIMIT)


@dataclass(frozen=True)
class PhotoPoses:
    """Result of structure from motion on a folder of photos.

    Args:
        root: Folder whose ``sparse/0`` holds the COLMAP model; load it with
            ``load_capture(root, images=images)``.
        images: Folder of the photos that the model refers to: the given one, or upright copies in ``root/images``.
        registered: Names of the photos with a pose, sorted; relative to ``images``.
        unregistered: Names of the photos without a pose, sorted.
        points: Number of triangulated points.
        models: Number of models that could not be joined; the largest is kept.
        notes: Remarks for the user, one line each.
    """

    root: Path
    images: Path
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]
    points: int
    models: int
    notes: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether every photo is registered in a single model."""
        return not self.unregistered and self.models == 1

    @property
    def note(self) -> str:
        """Summary in one line."""
        total = len(self.registered) + len(self.unregistered)
        line = f"{len(self.registered)} of {total} photos registered, {self.points:,} points"
        if self.models > 1:
            line = f"{line}, the largest of {self.models} models"
        return line if not self.unregistered else f"{line}; unregistered: {', '.join(self.unregistered)}"


def poses_from_photos(
    folder: Path,
    output: Path,
    config: PoseConfig | None = None,
    *,
    seed: int = 0,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> PhotoPoses:
    """Estimate the cameras of a folder of photos and write them as a COLMAP model.

    Args:
        folder: The photos, in subfolders or in ``images/``; ``masks/`` are used (see `prepare_photos`).
        output: Where ``sparse/0`` is written, atomically; an existing model is replaced.
        config: Settings.
        seed: Seed for pycolmap.
        memory: Bytes of host memory available. Determines threads and batches, never the result.
        listener: Receives events of stage ``"poses"``: one unit per photo with features, one for matching, one per
            registered photo.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, or none can be registered.
        BackendError: If the global mapper is requested and this pycolmap has none.
        MemoryBudgetError: If ``memory`` is too little for photos of this size and number.
    """
    from lexsplat.captures.sfm.pycolmap_import import quiet_pycolmap

    folder, output, config = photo_folder(Path(folder)), Path(output), config or PoseConfig()
    _check_mapper(config)
    photos = prepare_photos(folder, output, memory=memory, listener=listener)
    names, total = photos.names, 2 * len(photos.names) + 1
    work = _work_folder(output, photos, config, seed)
    with quiet_pycolmap(seed):
        database = work / "database.db"
        listener(Event(STAGE, 0, total))
        _extract(database, photos, config, memory, total, listener)
        _match(database, len(names), config, seed, memory)
        listener(Event(STAGE, len(names) + 1, total))
        check_mapping(database, memory)
        models = _map(database, photos, work / "models", config, seed, listener)
        best = _best(models)
        leftover = _unregistered(names, best)
        if leftover and config.pairs == "auto" and not config.compares_all(len(names)):
            _match_leftover(database, names, leftover, work, seed, memory)
            check_mapping(database, memory)
            models = _map(database, photos, work / "models", config, seed, listener) or models
            best = _best(models)
        if best is None:
            _discard(work, output)
            raise CaptureError(
                folder,
                expected="photos that overlap",
                found=f"{len(names)} photos, none of which could be registered",
                remedy="take more photos with 60 to 80 percent overlap, moving the camera between them",
            )
        best = _without_misregistered(best, database, photos, work / "again", seed)
        unregistered = _unregistered(names, best)
        _write_model(best, output)
    _discard(work, output)
    registered = tuple(sorted(set(names) - set(unregistered)))
    listener(Event(STAGE, total, total, {"registered": len(registered), "photos": len(names)}))
    return PhotoPoses(
        output, photos.images, registered, unregistered, best.num_points3D(), len(models), photos.notes
    )


def _check_mapper(config: PoseConfig) -> None:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    if config.mapper == "global" and not hasattr(pycolmap, "global_mapping"):
        raise BackendError(
            "the global mapper",
            expected="pycolmap 4 or later",
            found=pycolmap.__version__,
            remedy="pip install --upgrade pycolmap, or use the incremental mapper",
        )


def _best(models: list[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """The model with the most photos; on a tie, the one with the most points."""
    return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def _unregistered(
    names: tuple[str, ...] | list[str], model: pycolmap.Reconstruction | None
) -> tuple[str, ...]:
    registered = set() if model is None else {model.image(number).name for number in model.reg_image_ids()}
    return tuple(sorted(set(names) - registered))


def _work_folder(output: Path, photos: PreparedPhotos, config: PoseConfig, seed: int) -> Path:
    """The work folder for exactly these photos and settings; one for anything else is deleted."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    files = [photos.images / name for name in photos.names]
    files += sorted(photos.masks.rglob("*.png")) if photos.masks else []
    stamps = [[file.as_posix(), *file_stamp(file)] for file in files]
    key = fingerprint(pycolmap.__version__, config, seed, photos.lenses, stamps)
    work = output / _WORK
    note = work / "made_from.txt"
    if not (note.is_file() and note.read_text() == key):
        shutil.rmtree(work, ignore_errors=True)
        with atomic_path(note) as temporary:
            temporary.write_text(key)
    return work


def _discard(work: Path, output: Path) -> None:
    """Delete the work folder, and the output if it is empty."""
    shutil.rmtree(work, ignore_errors=True)
    with contextlib.suppress(OSError):
        output.rmdir()


def _extract(
    database: Path, photos: PreparedPhotos, config: PoseConfig, memory: int, total: int, listener: Listener
) -> None:
    """Extract SIFT features of all photos, one camera per lens; features already in the database are kept."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions()
    if photos.masks is not None:
        reader.mask_path = _complete_masks(photos, database.parent / "masks")
    for group in photos.lenses:
        # Importing first assigns image ids in order; extraction alone assigns them as threads finish.
        single = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, photos.images, single, list(group), reader)
    masked = photos.masks is not None
    threads = extraction_threads(photos.largest, config.max_side, config.max_features, memory, masked=masked)
    options = pycolmap.FeatureExtractionOptions(max_image_size=config.max_side, num_threads=threads)
    options.sift.max_num_features = config.max_features
    for start in range(0, len(photos.names), BATCH):
        batch = list(photos.names[start : start + BATCH])
        pycolmap.extract_features(
            database,
            photos.images,
            batch,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        listener(Event(STAGE, start + len(batch), total))


def _complete_masks(photos: PreparedPhotos, folder: Path) -> Path:
    """A folder with a mask for every photo, white where the user gave none: pycolmap skips photos without a mask."""
    for name in photos.names:
        target = folder / f"{name}.png"
        if target.is_file() or photos.masks is None:
            continue
        source = photos.masks / f"{name}.png"
        with atomic_path(target) as temporary:
            if source.is_file():
                shutil.copyfile(source, temporary)
            else:
                Image.new("L", image_size(photos.images / name), 255).save(temporary, format="PNG")
    return folder


def _match(database: Path, count: int, config: PoseConfig, seed: int, memory: int) -> None:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    if config.compares_all(count):
        matching, held = matching_plan(database, memory, least=2 * budget.CACHED_BLOCKS)
        pycolmap.match_exhaustive(
            database,
            matching_options=matching,
            pairing_options=pycolmap.ExhaustivePairingOptions(
                block_size=min(50, held // budget.CACHED_BLOCKS)
            ),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        return
    # Quadratic overlap adds photos 2, 4, 8, ... further on, which closes loops.
    pairing = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    if hasattr(pairing, "loop_detection_num_images"):  # unused, but pycolmap sizes its feature cache by it
        pairing.loop_detection_num_images = 1
    matching, _ = matching_plan(database, memory, least=budget.SEQUENTIAL_BLOCKS * SEQUENTIAL_OVERLAP)
    pycolmap.match_sequential(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _match_leftover(
    database: Path, names: tuple[str, ...], leftover: tuple[str, ...], work: Path, seed: int, memory: int
) -> None:
    """Match unregistered photos with all others, or with every n-th so that `MAX_LEFTOVER_PAIRS` is not exceeded."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    step = max(1, -(-len(leftover) * len(names) // MAX_LEFTOVER_PAIRS))
    others = names[::step]
    pairs = {tuple(sorted((name, other))) for name in leftover for other in others if name != other}
    listed = work / "pairs.txt"
    listed.write_text("".join(f"{first} {second}\n" for first, second in sorted(pairs)), encoding="utf-8")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    matching, held = matching_plan(database, memory)
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=held),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _map(
    database: Path,
    photos: PreparedPhotos,
    models: Path,
    config: PoseConfig,
    seed: int,
    listener: Listener,
) -> list[pycolmap.Reconstruction]:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    if config.mapper == "global":
        # GLOMAP needs focal lengths: those that are guesses are calibrated from the pairs first.
        pycolmap.calibrate_view_graph(database, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
        options = pycolmap.GlobalPipelineOptions(random_seed=seed, min_model_size=3)
        found = pycolmap.global_mapping(database, photos.images, models, options)
        return [found[key] for key in sorted(found)]
    registered, total = len(photos.names) + 1, 2 * len(photos.names) + 1

    def another() -> None:
        nonlocal registered
        registered = min(registered + 1, total - 1)
        listener(Event(STAGE, registered, total))

    found = pycolmap.incremental_mapping(
        database,
        photos.images,
        models,
        _mapper_options(seed),
        initial_image_pair_callback=another,
        next_image_callback=another,
    )
    return [found[key] for key in sorted(found)]


def _mapper_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    return pycolmap.IncrementalPipelineOptions(random_seed=seed, min_model_size=3)


def _without_misregistered(
    model: pycolmap.Reconstruction, database: Path, photos: PreparedPhotos, folder: Path, seed: int
) -> pycolmap.Reconstruction:
    """The model with its mis-registered photos registered again, or removed."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    with pycolmap.Database.open(database) as opened:
        wrong = misregistered(model, opened)
    if not wrong:
        return model
    return register_again(model, wrong, database, photos.images, folder, _mapper_options(seed))


def _write_model(model: pycolmap.Reconstruction, output: Path) -> None:
    """Write the model beside ``sparse/0`` and then swap it in, so that no partial model is ever visible."""
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
