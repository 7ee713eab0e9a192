"""Structure from motion on prepared photos with pycolmap: features, matches and models.

Everything here runs inside `quiet_pycolmap`. Memory determines threads and batches, never a result.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from PIL import Image

from lexsplat.captures.images.reading import image_size
from lexsplat.captures.sfm.counting import counted_pairs
from lexsplat.captures.sfm.feature_budget import check_space, extraction_threads, matching_plan
from lexsplat.captures.sfm.pose_agreement import misregistered, register_again
from lexsplat.captures.sfm.pycolmap_import import pycolmap
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import BackendError
from lexsplat.runtime.files import atomic_path

if TYPE_CHECKING:
    from lexsplat.captures.sfm.photos import PoseConfig
    from lexsplat.captures.sfm.preparation import PreparedPhotos

SEQUENTIAL_OVERLAP = 12
_BATCH = 8
_PARTS = 4

MAX_LEFTOVER_PAIRS = 20_000
"""Most pairs that are matched to register photos which sequential matching left unregistered."""

SMALL_ANGLE = 4.0
"""Smallest triangulation angle of the first pair of "small angles", in degrees; pycolmap's default is 16.
Forward-facing photos rarely reach that."""

MIN_MATCHES = 15
"""Fewest verified matches of a pair, and fewest inliers of a photo in "small angles" (pycolmap: 30)."""

HAS_GLOBAL = hasattr(pycolmap, "global_mapping")

Pairs = Callable[[int, int], None]
"""Receives the number of matched pairs, and of all."""

Mapper = Literal["incremental", "small angles", "global"]
"""How models are found: photo by photo, the same from pairs with small angles, or all photos at once (GLOMAP)."""


def require_global() -> None:
    """Check that this pycolmap has the global mapper.

    Raises:
        BackendError: If it has none.
    """
    if not HAS_GLOBAL:
        raise BackendError(
            "the global mapper",
            expected="pycolmap 4 or later",
            found=pycolmap.__version__,
            remedy="pip install --upgrade pycolmap, or use the incremental mapper",
        )


@dataclass(frozen=True)
class Attempt:
    """The largest model that a mapper finds.

    Args:
        mapper: The mapper.
        model: The model, without mis-registered photos.
        models: Number of models that could not be joined.
        all_pairs: Whether photos that stayed unregistered after sequential matching had been matched with all others.
    """

    mapper: Mapper
    model: pycolmap.Reconstruction
    models: int
    all_pairs: bool = False

    @property
    def rank(self) -> tuple[int, float]:
        """Larger is better: the number of registered photos, then a small reprojection error."""
        return self.model.num_reg_images(), -self.model.compute_mean_reprojection_error()


def extract_features(
    database: Path,
    photos: PreparedPhotos,
    config: PoseConfig,
    memory: int,
    listener: Callable[[int], None],
    camera_model: str = "SIMPLE_RADIAL",
) -> None:
    """Extract SIFT features of all photos, one camera per lens; features already in the database are kept.

    Args:
        database: pycolmap's database; it is created if it does not exist.
        photos: The photos, grouped by lens.
        config: Limits of the features.
        memory: Bytes of host memory available.
        listener: Receives the number of finished photos.
        camera_model: Model of the lenses.

    Raises:
        CaptureError: If the disk has too little free space.
        MemoryBudgetError: If ``memory`` is too little for photos of this size.
    """
    check_space(database, len(photos.names), photos.largest, config.max_side, config.max_features)
    masked = photos.masks is not None
    threads = extraction_threads(photos.largest, config.max_side, config.max_features, memory, masked=masked)
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    if photos.masks is not None:
        reader.mask_path = _complete_masks(photos, photos.masks, database.parent / "all-masks")
    for group in photos.lenses:
        # Importing first assigns image ids in order; extraction alone assigns them as threads finish.
        pycolmap.import_images(database, photos.images, pycolmap.CameraMode.SINGLE, list(group), reader)
    options = pycolmap.FeatureExtractionOptions(max_image_size=config.max_side, num_threads=threads)
    options.sift.max_num_features = config.max_features
    size = batch_size(len(photos.names), threads)
    for start in range(0, len(photos.names), size):
        batch = list(photos.names[start : start + size])
        pycolmap.extract_features(
            database,
            photos.images,
            batch,
            camera_mode=pycolmap.CameraMode.PER_IMAGE,  # as imported; others skip what another lens took
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        listener(start + len(batch))


def batch_size(photos: int, threads: int) -> int:
    """Photos per call of SIFT extraction: the most work that an interruption can lose.

    All threads have a photo. Beyond that, there are calls enough for a forecast after the first of them.
    """
    wanted = min(_BATCH, photos / _PARTS)
    return threads * max(1, round(wanted / threads))


def _complete_masks(photos: PreparedPhotos, masks: Path, folder: Path) -> Path:
    """A folder with a mask for every photo, white where the user gave none: pycolmap skips photos without a mask."""
    for name in photos.names:
        target, source = folder / f"{name}.png", masks / f"{name}.png"
        if target.is_file():
            continue
        with atomic_path(target) as temporary:
            if source.is_file():
                shutil.copyfile(source, temporary)
            else:
                Image.new("L", image_size(photos.images / name), 255).save(temporary, format="PNG")
    return folder


def match_photos(
    database: Path, count: int, config: PoseConfig, seed: int, memory: int, listener: Pairs
) -> None:
    """Match ``count`` photos, all pairs or each with the next ones, and verify the matches."""
    if config.compares_all(count):
        matching, held = matching_plan(database, memory, least=2 * budget.CACHED_BLOCKS)
        every = pycolmap.ExhaustivePairingOptions(block_size=min(50, held // budget.CACHED_BLOCKS))
        pairs = count * (count - 1) // 2
        _match(pycolmap.match_exhaustive, database, matching, every, pairs, seed, listener)
        return
    # Quadratic overlap adds photos 2, 4, 8, ... further on, which closes loops.
    pairing = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    if hasattr(pairing, "loop_detection_num_images"):  # unused, but pycolmap sizes its feature cache by it
        pairing.loop_detection_num_images = 1
    matching, _ = matching_plan(database, memory, least=budget.SEQUENTIAL_BLOCKS * SEQUENTIAL_OVERLAP)
    pairs = sum(max(0, count - (1 << power)) for power in range(SEQUENTIAL_OVERLAP))
    _match(pycolmap.match_sequential, database, matching, pairing, pairs, seed, listener)


def match_leftover(
    database: Path,
    names: tuple[str, ...],
    leftover: tuple[str, ...],
    seed: int,
    memory: int,
    listener: Pairs,
) -> None:
    """Match unregistered photos with all others, or with every n-th so that `MAX_LEFTOVER_PAIRS` is not exceeded."""
    step = max(1, -(-len(leftover) * len(names) // MAX_LEFTOVER_PAIRS))
    pairs = {(min(a, b), max(a, b)) for a in leftover for b in names[::step] if a != b}
    match_pairs(database, pairs, memory, seed, listener)


def match_pairs(
    database: Path, pairs: Collection[tuple[str, str]], memory: int, seed: int | None, listener: Pairs
) -> None:
    """Match pairs of photos by name, and verify the matches with a seed; None leaves them unverified."""
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{first} {second}\n" for first, second in sorted(pairs)), encoding="utf-8")
    matching, held = matching_plan(database, memory)
    matching.skip_geometric_verification = seed is None
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=held)
    _match(pycolmap.match_image_pairs, database, matching, pairing, len(pairs), seed or 0, listener)


def _match(
    run: Callable[..., None], database: Path, plan: Any, pairing: Any, pairs: int, seed: int, listener: Pairs
) -> None:
    """Match by a function of pycolmap, and verify the matches."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    with counted_pairs(database, pairs, listener):
        run(
            database,
            matching_options=plan,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def map_photos(
    database: Path, photos: PreparedPhotos, mapper: Mapper, seed: int, another: Callable[[], None]
) -> Attempt | None:
    """The largest model of all verified matches, or None if no photo can be registered.

    Args:
        database: Features and matches.
        photos: The photos.
        mapper: Mapper that finds the models.
        seed: Seed for pycolmap.
        another: Called for each registered photo.
    """
    models = database.parent / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    if mapper == "global":
        # GLOMAP needs focal lengths: those that are guesses are calibrated from the pairs first, in a copy.
        calibrated = Path(shutil.copyfile(database, database.with_name("calibrated.db")))
        pycolmap.calibrate_view_graph(calibrated, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
        options = pycolmap.GlobalPipelineOptions(random_seed=seed, min_model_size=3)
        found = pycolmap.global_mapping(calibrated, photos.images, models, options)
    else:
        found = pycolmap.incremental_mapping(
            database,
            photos.images,
            models,
            _mapper_options(mapper, seed),
            initial_image_pair_callback=another,
            next_image_callback=another,
        )
    ordered = [found[key] for key in sorted(found)]
    if not ordered:
        return None
    largest = max(ordered, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    with pycolmap.Database.open(database) as opened:
        wrong = misregistered(largest, opened)
    if wrong:
        again = _mapper_options(mapper, seed)
        largest = register_again(largest, wrong, database, photos.images, again)
    return Attempt(mapper, largest, len(found))


def _mapper_options(mapper: Mapper, seed: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, min_model_size=3)
    if mapper == "small angles":
        options.mapper.init_min_tri_angle = SMALL_ANGLE
        options.mapper.abs_pose_min_num_inliers = MIN_MATCHES
    return options


def unregistered(names: Iterable[str], attempt: Attempt | None) -> tuple[str, ...]:
    """Names of the photos without a pose, sorted."""
    model = None if attempt is None else attempt.model
    registered = set() if model is None else {model.image(number).name for number in model.reg_image_ids()}
    return tuple(sorted(set(names) - registered))


def matched(database: Path) -> set[str]:
    """Names of the photos with verified matches with another photo: no mapper can register the others."""
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs = zip(*opened.read_two_view_geometries())
        kept = [pair for pair, geometry in pairs if len(geometry.inlier_matches) >= MIN_MATCHES]
    return {names[number] for pair in kept for number in pycolmap.pair_id_to_image_pair(pair)}


def why_unregistered(database: Path, names: Collection[str], blank: Mapping[str, str]) -> dict[str, str]:
    """The reason why each photo has no pose; ``blank`` has those of photos of which nothing is left."""
    with_matches = matched(database)
    with pycolmap.Database.open(database) as opened:
        counts = {
            each.name: opened.num_keypoints_for_image(each.image_id) for each in opened.read_all_images()
        }

    def reason(name: str) -> str:
        if name in blank:
            return blank[name]
        if counts.get(name, 0) < MIN_MATCHES:
            return "has nothing to match: blurred, dark or without texture"
        return "fits no model of the others" if name in with_matches else "matches no other photo"

    return {name: reason(name) for name in names}


def write_model(model: pycolmap.Reconstruction, output: Path) -> None:
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
