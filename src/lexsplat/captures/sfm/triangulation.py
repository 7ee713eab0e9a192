"""Initial points of a reconstruction: those of the capture, triangulated with its poses, or random.

Triangulated points gain several dB over random ones on real photos. A capture with poses but without points gets them
here: SIFT features are matched between views that look at the same place, matches that violate the epipolar geometry
of the known poses are dropped, and the rest is triangulated with fixed poses.
"""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures.capture import Capture, View
from lexsplat.captures.readers.camera_files import MAX_COORDINATE
from lexsplat.captures.sfm.feature_budget import check_mapping
from lexsplat.captures.sfm.photos import MATCHING, SETTLED, SIFT, PoseConfig
from lexsplat.captures.sfm.preparation import PreparedPhotos
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import file_stamp, fingerprint
from lexsplat.runtime.progress import Event, FirstUnits, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

log = logging.getLogger("lexsplat")

STAGE = "triangulate"
ENOUGH_POINTS = 200
"""With fewer triangulated points than this, random ones are the better start."""

FEATURES = PoseConfig(max_side=1000, max_features=4096)
"""Limits of the features: larger images cost time and yield no more points."""

NEIGHBORS = 16
"""Number of other views each view is matched with."""


@dataclass(frozen=True)
class InitialPoints:
    """The points Gaussians are initialized from.

    Args:
        points: Positions ``[P, 3]``, world.
        colors: RGB in 0..1 ``[P, 3]``.
        origin: ``"capture"``, ``"triangulated"`` or ``"random"``.
        note: Summary in one line: number and origin of the points.
    """

    points: NDArray[np.float32]
    colors: NDArray[np.float32]
    origin: str
    note: str


def initial_points(
    capture: Capture,
    *,
    count: int = 20_000,
    seed: int = 0,
    cache_dir: Path | None = None,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> InitialPoints:
    """The best available initial points.

    These are the points of the capture where there are enough, else points triangulated with the known poses, else
    ``count`` random points that several cameras see, with a warning.

    Args:
        capture: The capture.
        count: Number of random points.
        seed: Seed for pycolmap and the random points.
        cache_dir: Folder that caches triangulated points; None disables the cache.
        memory: Bytes of host memory available to the triangulation.
        listener: Receives progress events of the triangulation.

    Raises:
        CaptureError: If an image cannot be read.
    """
    if len(capture.points) >= ENOUGH_POINTS:
        note = f"{len(capture.points):,} points of the capture"
        return InitialPoints(capture.points, capture.point_colors, "capture", note)
    points, colors = triangulate(capture, cache_dir=cache_dir, seed=seed, memory=memory, listener=listener)
    if len(points) >= ENOUGH_POINTS:
        return InitialPoints(points, colors, "triangulated", f"{len(points):,} points triangulated")
    found = len(points)
    points, colors = random_points_in_frusta(capture, count, np.random.default_rng(seed))
    note = f"{len(points):,} random points (only {found} could be triangulated)"
    log.warning(
        "the training starts from %s, which costs several dB: %d are needed; take photos that overlap by 60 to 80"
        " percent and show texture, and check that given poses belong to them",
        note,
        ENOUGH_POINTS,
    )
    return InitialPoints(points, colors, "random", note)


def triangulate(
    capture: Capture,
    *,
    cache_dir: Path | None = None,
    seed: int = 0,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points matched between training views and triangulated with their poses.

    Held-out views are not used.

    Args:
        capture: The capture.
        cache_dir: Folder that caches the result by photos, cameras and settings; None disables the cache.
        seed: Seed for pycolmap.
        memory: Bytes of host memory available. Determines threads and batches, never the result.
        listener: Receives events of stage ``"triangulate"``: two units per image, written and with features, then
            matching and triangulation; and of stage ``"matching"``, one unit per pair of images.

    Returns:
        Points ``[P, 3]`` float32, world, and their colors ``[P, 3]`` float32 in 0..1; P may be 0.

    Raises:
        CaptureError: If an image cannot be read, or the disk has too little free space.
    """
    views = capture.train_views
    empty = np.zeros((0, 3), np.float32)
    if len(views) < 2:
        return empty, empty
    cached = (
        None if cache_dir is None else Path(cache_dir) / f"triangulated-{_cache_key(views, seed)}.safetensors"
    )
    if cached is not None and (known := _read_cache(cached)) is not None:
        return known
    from lexsplat.captures.sfm.pycolmap_import import quiet_pycolmap

    with tempfile.TemporaryDirectory(prefix="lexsplat-") as temporary, quiet_pycolmap(seed):
        points, colors = _run_pycolmap(views, Path(temporary), seed, memory, listener)
    total = 2 * len(views) + 3
    listener(Event(STAGE, total, total, {"points": len(points)}))
    if cached is not None:
        _write_cache(cached, points, colors)
    return points, colors


def random_points_in_frusta(
    capture: Capture, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Random points inside the view frusta, colored by the photos.

    Every point lies on a ray through a random pixel of a random training view, at 0.2 to 2 times the distance
    at which the cameras' optical axes meet. Of ten candidates, the one that most views see is kept, which
    concentrates points where views overlap.

    Args:
        capture: The capture.
        count: Number of points.
        rng: Random generator.

    Returns:
        Points ``[count, 3]`` float32, world, and colors ``[count, 3]`` float32 in 0..1.

    Raises:
        CaptureError: If an image cannot be read.
    """
    views = capture.train_views
    owners = np.sort(rng.integers(0, len(views), count))
    pixels = rng.random((count, 10, 2))
    fractions = rng.uniform(0.2, 2.0, (count, 10))
    distance = _focus_distance(views, capture.extent)
    points = np.zeros((count, 3))
    colors = np.zeros((count, 3))
    for index, view in enumerate(views):
        mine = np.flatnonzero(owners == index)
        if not len(mine):
            continue
        camera = view.camera
        size = np.array([camera.width, camera.height])
        rays = np.ones((len(mine), 10, 3))
        rays[..., :2] = (pixels[mine] * size - camera.K[:2, 2]) / [camera.K[0, 0], camera.K[1, 1]]
        rays *= (fractions[mine] * distance)[..., None]
        candidates = camera.world(rays)
        best = _views_that_see(views, candidates.reshape(-1, 3)).reshape(-1, 10).argmax(1)
        rows = np.arange(len(mine))
        points[mine] = candidates[rows, best]
        small = view.load_image((min(camera.width, 256), min(camera.height, 256)))
        where = (pixels[mine][rows, best] * [small.shape[1], small.shape[0]]).astype(int)
        colors[mine] = small[where[:, 1], where[:, 0]]
    return points.astype(np.float32), colors.astype(np.float32)


def _focus_distance(views: tuple[View, ...], extent: float) -> float:
    """Median distance of the cameras to the point nearest to all optical axes, in world units.

    Three times the extent where the axes do not meet in front of the cameras (a corridor, a single view).
    """
    origins = np.stack([view.camera.position for view in views])
    axes = np.stack([view.camera.forward for view in views])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(across.sum(0), (across @ origins[..., None]).sum(0)[:, 0], rcond=1e-3)[0]
    depth = ((focus - origins) * axes).sum(1)
    in_front = np.median(depth)
    return float(in_front) if in_front > 0.1 * extent and (depth > 0).mean() > 0.8 else 3.0 * extent


def _views_that_see(views: tuple[View, ...], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of views ``[P]`` in whose image each point ``[P, 3]`` falls."""
    return sum((view.camera.project(points)[2] for view in views), np.zeros(len(points), np.int64))


def matching_pairs(views: tuple[View, ...]) -> list[tuple[int, int]]:
    """Pairs of views to match: each view with the `NEIGHBORS` most similar ones by pose.

    The cost of a pair is the distance of the cameras relative to the focus distance, plus twice the angle between
    their axes in radians. Pairs whose axes differ by more than 90 degrees are excluded.

    Returns:
        Pairs of indices, the lower first, sorted.
    """
    origins = np.stack([view.camera.position for view in views])
    axes = np.stack([view.camera.forward for view in views])
    extent = float(np.linalg.norm(origins - origins.mean(0), axis=1).max()) or 1.0
    apart = np.linalg.norm(origins[:, None] - origins[None], axis=2) / _focus_distance(views, extent)
    angles = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    cost = apart + 2.0 * angles
    cost[angles > np.pi / 2] = np.inf
    np.fill_diagonal(cost, np.inf)
    pairs = set()
    for index in range(len(views)):
        nearest = np.argsort(cost[index], kind="stable")[:NEIGHBORS]
        pairs |= {(min(index, int(j)), max(index, int(j))) for j in nearest if np.isfinite(cost[index, j])}
    return sorted(pairs)


def _file_name(index: int) -> str:
    return f"{index:06d}.png"


def _working_size(view: View) -> tuple[int, int]:
    """Width and height of the undistorted photo for feature extraction."""
    width, height = view.capture_size
    shrink = max(1.0, max(width, height) / FEATURES.max_side)
    return max(1, round(width / shrink)), max(1, round(height / shrink))


def _write_photo(view: View, folder: Path, name: str) -> None:
    """Write the undistorted photo and its mask, if it has one, for pycolmap."""
    size = _working_size(view)
    valid = view.load_valid(size)
    images = {"images": (view.load_image(size) * 255.0).round().astype(np.uint8)}
    if valid is not None:
        images["masks"] = valid.astype(np.uint8) * 255
    for kind, pixels in images.items():
        (folder / kind).mkdir(exist_ok=True)
        Image.fromarray(pixels).save(
            folder / kind / (name if kind == "images" else f"{name}.png"), compress_level=1
        )


def _run_pycolmap(
    views: tuple[View, ...], folder: Path, seed: int, memory: int, listener: Listener
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Extract and match features, verify matches with the known poses, triangulate."""
    from lexsplat.captures.sfm import mapping
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    def report(done: int) -> None:
        listener(Event(STAGE, done, 2 * len(views) + 3))

    tell_features, tell_pairs = FirstUnits(SIFT, "images"), FirstUnits(MATCHING, "pairs", SETTLED)

    def report_features(done: int) -> None:
        report(len(views) + done)
        tell_features(done, len(views))

    def report_pairs(done: int, pairs: int) -> None:
        listener(Event(MATCHING, done, pairs))
        tell_pairs(done, pairs)

    names = tuple(_file_name(index) for index in range(len(views)))
    for done, (view, name) in enumerate(zip(views, names)):
        report(done)
        _write_photo(view, folder, name)
    report_features(0)
    database, images, masks = folder / "database.db", folder / "images", folder / "masks"
    largest = max(map(_working_size, views), key=lambda size: size[0] * size[1])
    lenses = tuple((name,) for name in names)
    photos = PreparedPhotos(images, names, lenses, masks if masks.is_dir() else None, largest)
    mapping.extract_features(database, photos, FEATURES, memory, report_features, camera_model="PINHOLE")
    known = _known_reconstruction(database, views)
    report(2 * len(views))
    pairs = [(names[first], names[second]) for first, second in matching_pairs(views)]
    mapping.match_pairs(database, pairs, memory, None, report_pairs)
    report(2 * len(views) + 1)
    # Drops matches that violate the epipolar geometry of the known poses; estimates nothing.
    pycolmap.guided_geometric_verification(known, database)
    check_mapping(database, memory)
    report(2 * len(views) + 2)
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed)
    (folder / "model").mkdir()
    try:
        result = pycolmap.triangulate_points(known, database, images, folder / "model", options=options)
    except ValueError as error:
        raise CaptureError(
            views[0].image_path.parent,
            expected="images that can be matched",
            found=str(error),
            remedy="check that the poses belong to these photos",
        ) from error
    return _points_of(result)


def _known_reconstruction(database_path: Path, views: tuple[View, ...]) -> pycolmap.Reconstruction:
    """The views' cameras and poses with the ids of the database, whose cameras are updated to match."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    known = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        entries = {entry.name: entry for entry in database.read_all_images()}
        for index, view in enumerate(views):
            entry, (width, height) = entries[_file_name(index)], _working_size(view)
            K = view.camera.resized(width, height).K
            camera = pycolmap.Camera(
                camera_id=entry.camera_id,
                model="PINHOLE",
                width=width,
                height=height,
                params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
                has_prior_focal_length=True,
            )
            database.update_camera(camera)
            known.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(name=entry.name, camera_id=entry.camera_id, image_id=entry.image_id)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.camera.viewmat[:3]))
    return known


def _points_of(model: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Finite points of a pycolmap reconstruction in order of their ids, and their colors."""
    ordered = [model.points3D[key] for key in sorted(model.points3D)]
    points = np.array([point.xyz for point in ordered], dtype=np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in ordered], dtype=np.float64).reshape(-1, 3) / 255.0
    keep = np.isfinite(points).all(1) & (np.abs(points) < MAX_COORDINATE).all(1)
    return points[keep].astype(np.float32), colors[keep].astype(np.float32)


def _cache_key(views: tuple[View, ...], seed: int) -> str:
    """Fingerprint of everything the points depend on."""
    inputs = [
        [
            view.name,
            file_stamp(view.image_path),
            view.lens,
            view.background,
            None if view.ignore_path is None else file_stamp(view.ignore_path),
            view.camera.viewmat.tolist(),
            *(["transparent"] if view.ignores_transparent else []),
        ]
        for view in views
    ]
    return fingerprint(FEATURES.max_side, FEATURES.max_features, NEIGHBORS, seed, inputs)


def _read_cache(file: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Cached points and colors; None where there are none or the file is damaged."""
    try:
        tensors, _ = read_tensors(file)
        return tensors["points"].numpy(), tensors["colors"].numpy()
    except (FileFormatError, KeyError):  # the points are triangulated again
        return None


def _write_cache(file: Path, points: NDArray[np.float32], colors: NDArray[np.float32]) -> None:
    write_tensors(file, {"points": torch.from_numpy(points), "colors": torch.from_numpy(colors)}, {})
