"""Estimates cameras from photos alone: structure from motion with pycolmap.

Photos are processed upright (`lexsplat.captures.sfm.preparation`). Photos of the same size and focal length share a
lens, initialized from the EXIF focal length where there is one. Masked pixels yield no features.

Intermediate results live in a hidden folder of the output until the model is written, so an interrupted run resumes
with the features and matches it already has.
"""

from __future__ import annotations

import contextlib
import itertools
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lexsplat.captures.sfm.feature_budget import check_mapping
from lexsplat.captures.sfm.preparation import PreparedPhotos, photo_folder, prepare_photos
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import write_file
from lexsplat.runtime.fingerprints import file_stamp, fingerprint
from lexsplat.runtime.progress import Event, FirstUnits, Listener, silent, uncounted

if TYPE_CHECKING:
    from lexsplat.captures.sfm.mapping import Attempt, Mapper


STAGE, SIFT, MATCHING, MAPPING = "poses", "SIFT features", "matching", "mapping"
EXHAUSTIVE_LIMIT = 80
"""Up to this many photos every pair is matched; beyond it, photos are assumed to follow one another by name."""

_WORK = ".poses"
SETTLED = 10.0
"""Seconds of matching before its forecast: the first pairs take two to three times as long as later ones."""
_TOLD_AT = 0.25
"""Share of photos registered before the forecast: .85 to 1.25 of it is taken, .63 to 1.58 of one at a tenth."""


@dataclass(frozen=True)
class PoseConfig:
    """Settings of structure from motion.

    Args:
        mapper: The mapper that runs first. "incremental" registers one photo after the other. "global" (GLOMAP)
            registers all at once: it is faster on many photos, and more sensitive to wrong matches. Where photos
            remain unregistered, other mappers follow, and the model with the most photos is kept.
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
        mapper: Mapper that found the model.
        all_pairs: Whether photos that sequential matching left unregistered were matched with all others for it.
        notes: Remarks for the user, one line each.
        reasons: Why each of the unregistered photos has no pose, by name.
    """

    root: Path
    images: Path
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]
    points: int
    models: int
    mapper: Mapper = "incremental"
    all_pairs: bool = False
    notes: tuple[str, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)

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
        line = f'{line}, found by the mapper "{self.mapper}"'
        if self.all_pairs:
            line = f"{line} after all pairs of the unregistered photos were matched"
        of_reason = [(self.reasons.get(name, ""), name) for name in self.unregistered]
        told = []
        for reason, group in itertools.groupby(sorted(of_reason), lambda each: each[0]):
            told.append(", ".join(name for _, name in group) + (f" ({reason})" if reason else ""))
        return f"{line}; unregistered: {'; '.join(told)}" if told else line


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
        output: Folder of ``sparse/0``, written atomically; an existing model is replaced.
        config: Settings.
        seed: Seed for pycolmap.
        memory: Bytes of host memory available. Determines threads and batches, never the result.
        listener: Receives events of stage ``"poses"``: one unit per photo with features, one for matching, one per
            registered photo; of stage ``"matching"``, one unit per pair of photos; of stage ``"mapping"``, one unit
            per registered photo, anew for each mapper; and of stage ``"global mapper"``, which cannot be counted. The
            time of features, matching and mapping is logged after their first units.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, none can be registered, or the disk has
            too little free space.
        BackendError: If the global mapper is requested and this pycolmap has none.
        MemoryBudgetError: If ``memory`` is too little for photos of this size and number.
    """
    from lexsplat.captures.sfm import mapping
    from lexsplat.captures.sfm.pycolmap_import import quiet_pycolmap

    folder, output, config = photo_folder(Path(folder)), Path(output), config or PoseConfig()
    if config.mapper == "global":
        mapping.require_global()
    photos = prepare_photos(folder, output, memory=memory, listener=listener)
    names, total = photos.names, 2 * len(photos.names) + 1
    work = _work_folder(output, photos, config, seed)
    database = work / "database.db"
    is_new = not database.exists()  # what an earlier run has done took no time in this one
    tell_features = FirstUnits(SIFT, "photos")
    tell_pairs = FirstUnits(MATCHING, "pairs", SETTLED)

    def report(done: int) -> None:
        _report(listener, photos, done)
        if is_new:
            tell_features(done, len(names))

    def report_pairs(done: int, pairs: int) -> None:
        listener(Event(MATCHING, done, pairs))
        if is_new:
            tell_pairs(done, pairs)

    with quiet_pycolmap(seed):
        report(0)
        mapping.extract_features(database, photos, config, memory, report)
        mapping.match_photos(database, len(names), config, seed, memory, report_pairs)
        _report(listener, photos, len(names) + 1)
        best = _best_attempt(database, photos, config, seed, memory, listener, report_pairs)
        if best is None:
            _discard(work, output)
            raise _none_registered(folder, len(names))
        reasons = mapping.why_unregistered(database, mapping.unregistered(names, best), photos.blank)
        mapping.write_model(best.model, output)
    _discard(work, output)
    found = _found(output, photos, best, reasons)
    listener(Event(STAGE, total, total, {"registered": len(found.registered), "photos": len(names)}))
    return found


def _found(output: Path, photos: PreparedPhotos, best: Attempt, reasons: Mapping[str, str]) -> PhotoPoses:
    """The poses of the best attempt, and why each of the other photos has none."""
    return PhotoPoses(
        output,
        photos.images,
        tuple(sorted(set(photos.names) - set(reasons))),
        tuple(reasons),
        best.model.num_points3D(),
        best.models,
        best.mapper,
        best.all_pairs,
        photos.notes,
        reasons,
    )


def _none_registered(folder: Path, photos: int) -> CaptureError:
    return CaptureError(
        folder,
        expected="photos that overlap",
        found=f"{photos} photos, none of which could be registered",
        remedy="take more photos with 60 to 80 percent overlap, moving the camera between them",
    )


# Database, photos, settings, seed, memory and progress belong to no common value.
def _best_attempt(
    database: Path,
    photos: PreparedPhotos,
    config: PoseConfig,
    seed: int,
    memory: int,
    listener: Listener,
    report_pairs: Callable[[int, int], None],
) -> Attempt | None:
    """The mapper that registers the most photos, with the least error on a tie.

    The mappers run one after the other, from the strictest to the most lenient, until every photo that has matches is
    registered. All photos at once are mapped only where more than a tenth is missing, because that takes long and is
    sensitive to wrong matches. Photos that sequential matching left unregistered are matched with all others.
    """
    from lexsplat.captures.sfm import mapping

    names, best, leftover = photos.names, None, False
    every_pair = config.pairs != "auto" or config.compares_all(len(names))
    mappers: tuple[mapping.Mapper, ...] = ("incremental", "small angles", "global")
    for mapper in sorted(mappers, key=lambda name: name != config.mapper):
        missing = mapping.unregistered(names, best)
        if mapper == "global" != config.mapper and (
            len(missing) <= len(names) / 10 or not mapping.HAS_GLOBAL
        ):
            continue
        check_mapping(database, memory)
        found = _attempt(database, photos, mapper, seed, listener, all_pairs=leftover)
        missing = mapping.unregistered(names, found)
        if missing and not every_pair:
            every_pair = leftover = True
            mapping.match_leftover(database, names, missing, seed, memory, report_pairs)
            check_mapping(database, memory)
            found = _attempt(database, photos, mapper, seed, listener, all_pairs=True) or found
        best = max(filter(None, (best, found)), key=lambda attempt: attempt.rank, default=None)
        if mapping.matched(database).isdisjoint(mapping.unregistered(names, best)):
            break
    return best


def _attempt(
    database: Path,
    photos: PreparedPhotos,
    mapper: Mapper,
    seed: int,
    listener: Listener,
    *,
    all_pairs: bool,
) -> Attempt | None:
    from lexsplat.captures.sfm.mapping import map_photos

    if mapper == "global":  # it reports nothing
        with uncounted(listener, "global mapper", f"{len(photos.names)} photos"):
            found = map_photos(database, photos, mapper, seed, lambda: None)
        return None if found is None else replace(found, all_pairs=all_pairs)
    count, registered = len(photos.names), itertools.count(2)  # a model starts with two photos
    tell_photos = FirstUnits(MAPPING, "photos", share=_TOLD_AT)

    def report(done: int) -> None:
        listener(Event(MAPPING, done, count))
        tell_photos(done, count)
        _report(listener, photos, count + 1 + done)

    report(0)
    # Photos that one model leaves out are tried again in the next.
    found = map_photos(database, photos, mapper, seed, lambda: report(min(next(registered), count - 1)))
    listener(Event(MAPPING, count, count))
    return None if found is None else replace(found, all_pairs=all_pairs)


def _report(listener: Listener, photos: PreparedPhotos, done: int) -> None:
    """Send an event of stage "poses" that is not its last one."""
    total = 2 * len(photos.names) + 1
    listener(Event(STAGE, min(done, total - 1), total))


def _work_folder(output: Path, photos: PreparedPhotos, config: PoseConfig, seed: int) -> Path:
    """The work folder for exactly these photos and settings; one for anything else is deleted."""
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    files = [photos.images / name for name in photos.names]
    files += sorted(photos.masks.rglob("*.png")) if photos.masks else []
    stamps = [[file.as_posix(), *file_stamp(file)] for file in files]
    key = fingerprint(pycolmap.__version__, config, seed, photos.lenses, stamps)
    work = output / _WORK
    note = work / "source.txt"
    if not (note.is_file() and note.read_text() == key):
        shutil.rmtree(work, ignore_errors=True)
        write_file(note, key)
    return work


def _discard(work: Path, output: Path) -> None:
    """Delete the work folder, and the output if it is empty."""
    shutil.rmtree(work, ignore_errors=True)
    with contextlib.suppress(OSError):
        output.rmdir()
