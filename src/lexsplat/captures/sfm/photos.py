"""Cameras from photos alone: structure from motion by pycolmap.

Photos are taken upright (`lexsplat.captures.sfm.preparation`); those of one size and focal length share a lens, which
starts from the focal length in the EXIF data where there is one. Masked pixels give no features.

What is being worked out is kept in a hidden folder of the output until the model is written, so that a run which was
stopped goes on with the features and matches that it has.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from PIL import Image

from lexsplat.captures.images.reading import image_size
from lexsplat.captures.sfm.feature_budget import check_mapping, extraction_threads, matching_plan
from lexsplat.captures.sfm.pose_agreement import misregistered, register_again
from lexsplat.captures.sfm.preparation import PreparedPhotos, find_photos, photo_folder, prepare_photos
from lexsplat.captures.sfm.triangulation import quiet_pycolmap
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import BackendError, CaptureError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

__all__ = ["PhotoPoses", "PoseConfig", "find_photos", "photo_folder", "poses_from_photos"]

STAGE = "poses"
EXHAUSTIVE_LIMIT = 80
"""Up to so many photos every pair is matched; beyond, photos are taken to follow one another by name."""

SEQUENTIAL_OVERLAP = 12
BATCH = 8
"""Photos whose features are sought in one go: what is lost at most when it is stopped."""

MAX_LEFTOVER_PAIRS = 20_000
"""Pairs that are matched at most to place photos which follow no other."""

_WORK = ".poses"


@dataclass(frozen=True)
class PoseConfig:
    """Settings of structure from motion.

    Args:
        mapper: "incremental" places photo after photo, "global" all at once (GLOMAP): faster on many photos, and
            more easily misled by wrong matches.
        pairs: Which photos are compared. "exhaustive": all with all. "sequential": each with the next ones by
            name, and ones 2, 4, 8, ... further on, for videos and walks. "auto": exhaustive up to 80 photos, then
            sequential, after which photos that found no place are compared with all others.
        max_side: Photos are scaled down to this longest side, in pixels, to seek features.
        max_features: Features sought in a photo.

    Raises:
        ValueError: If a number makes no sense.
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
        """Whether every pair of so many photos is compared."""
        return self.pairs == "exhaustive" or (self.pairs == "auto" and count <= EXHAUSTIVE_LIMIT)


@dataclass(frozen=True)
class PhotoPoses:
    """What structure from motion made of a folder of photos.

    Args:
        root: Folder whose ``sparse/0`` holds the COLMAP model; load it with
            ``load_capture(root, images=images)``.
        images: Folder of the photos the model speaks of: the given one, or upright copies in ``root/images``.
        placed: Names of the photos that have a camera, sorted; relative to ``images``.
        left_out: Names of the photos that could not be placed, sorted.
        points: How many points were triangulated.
        models: How many models there were that did not join; the largest was kept.
        notes: What else people should know, one line each.
    """

    root: Path
    images: Path
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]
    points: int
    models: int
    notes: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """One line for people."""
        total = len(self.registered) + len(self.unregistered)
        line = f"{len(self.registered)} of {total} photos registered, {self.points:,} points"
        if self.models > 1:
            line = f"{line}, the largest of {self.models} models"
        return line if not self.unregistered else f"{line}; left out: {', '.join(self.unregistered)}"


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
        folder: The photos, in subfolders if wanted, or in ``images/``; ``masks/`` are used (see `prepare_photos`).
        output: Where ``sparse/0`` is written, whole or not at all; one that is there is replaced.
        config: Settings.
        seed: Seed for pycolmap.
        memory: Bytes of host memory that may be taken: decides how much is done at once, and no result.
        listener: Hears of stage ``"poses"``: a unit a photo whose features are found, then one for the matches, then
            one a photo that is placed.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, or none can be placed.
        BackendError: If this pycolmap has no global mapper, and it was asked for.
        MemoryBudgetError: If ``memory`` is too little for photos of this size and number.
    """
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
                found=f"{len(names)} photos of which none could be placed",
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
    """The model with the most photos; of equals the one with the most points."""
    return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def _unregistered(names: tuple[str, ...] | list[str], model: pycolmap.Reconstruction | None) -> tuple[str, ...]:
    registered = set() if model is None else {model.image(number).name for number in model.reg_image_ids()}
    return tuple(sorted(set(names) - registered))


def _work_folder(output: Path, photos: PreparedPhotos, config: PoseConfig, seed: int) -> Path:
    """The folder of the unfinished work on exactly these photos; that of other ones is thrown away."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    about: list[object] = [pycolmap.__version__, asdict(config), seed, photos.lenses]
    files = [photos.images / name for name in photos.names]
    files += sorted(photos.masks.rglob("*.png")) if photos.masks else []
    for file in files:
        status = file.stat()
        about.append([file.as_posix(), status.st_size, status.st_mtime_ns])
    key = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:16]
    work = output / _WORK
    note = work / "made_from.txt"
    if not (note.is_file() and note.read_text() == key):
        shutil.rmtree(work, ignore_errors=True)
        with atomic_path(note) as temporary:
            temporary.write_text(key)
    return work


def _discard(work: Path, output: Path) -> None:
    """Forget finished or fruitless work; an output that holds nothing goes too."""
    shutil.rmtree(work, ignore_errors=True)
    with contextlib.suppress(OSError):
        output.rmdir()


def _extract(
    database: Path, photos: PreparedPhotos, config: PoseConfig, memory: int, total: int, listener: Listener
) -> None:
    """SIFT features of all photos, one camera for each lens; what the database has already is kept."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions()
    if photos.masks is not None:
        reader.mask_path = _complete_masks(photos, database.parent / "masks")
    for group in photos.lenses:
        # Importing first gives the images their ids in order; extraction alone numbers them as threads finish.
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
    """A folder with a mask for every photo: white where there is none, for pycolmap leaves such photos out."""
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
    # Quadratic overlap adds photos 2, 4, 8, ... further on, which closes the loops of a walk around.
    pairing = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    if hasattr(pairing, "loop_detection_num_images"):  # not used, but pycolmap keeps features by it
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
    """Compare photos that follow no other with all, or with as many, evenly spread, as is affordable."""
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
        # Lenses whose focal length is a guess are calibrated from the pairs first, as GLOMAP needs it.
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
    """The model with photos registered again, or left out, whose matches contradict their place."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    with pycolmap.Database.open(database) as opened:
        wrong = misregistered(model, opened)
    if not wrong:
        return model
    return register_again(model, wrong, database, photos.images, folder, _mapper_options(seed))


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
