"""Fits pycolmap's extraction, matching and mapping into a memory budget: number of threads, photos held at once.

These choices never affect a result: image ids are assigned beforehand, and every pair is matched and verified by
itself with its own seed.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import free_bytes

if TYPE_CHECKING:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

HELD_AT_MOST = 1225
"""Most photos whose features are held at once: pycolmap's own limit."""

_STAGE = "structure from motion"
_STORED_BYTES = 152
"""Bytes of a feature in the database: 128 of its descriptor, and six numbers of its keypoint."""
_PIXELS_OF_A_FEATURE = 64
"""Pixels for each feature, at least; photos of 320 to 1,600 pixels were found to have 60 to 160."""


def extraction_threads(
    photo: tuple[int, int], max_side: int, max_features: int, memory: int, *, masked: bool = False
) -> int:
    """Number of SIFT extraction threads that fit into the memory budget.

    Raises:
        MemoryBudgetError: If not even one thread fits.
    """

    def need_of(side: int, threads: int) -> int:
        return budget.extraction_bytes(photo, side, max_features, threads, masked=masked)

    need = {threads: need_of(max_side, threads) for threads in range(1, _cores() + 1)}
    sides = range(min(max_side, max(photo)), 63, -32)
    fitting = next((side for side in sides if need_of(side, 1) <= memory), None)
    remedy = "scale the photos down first" if fitting is None else _option("max-side", fitting)
    budget.require(_STAGE, need[1], memory, f"features of photos of {photo[0]}x{photo[1]} pixels", remedy)
    return budget.most_within(memory, need)


def check_space(database: Path, photos: int, size: tuple[int, int], max_side: int, max_features: int) -> None:
    """Refuse a disk without room for the features: pycolmap ends the process where it cannot write.

    Args:
        database: pycolmap's database; what an earlier run has written counts.
        photos: Number of photos.
        size: Width and height of the largest photo.
        max_side: Longest side to which photos are reduced first.
        max_features: Maximum number of features per photo.

    Raises:
        CaptureError: If there is too little free space.
    """
    pixels = size[0] * size[1] * min(1.0, max_side / max(size)) ** 2
    written = database.stat().st_size if database.exists() else 0
    need = int(photos * min(max_features, pixels / _PIXELS_OF_A_FEATURE) * _STORED_BYTES) - written
    free = free_bytes(database.parent)
    if free < need:
        raise CaptureError(
            database.parent,
            expected=f"{need / 1e6:,.1f} MB of free space for the features of {photos:,} photos",
            found=f"{free / 1e6:,.1f} MB",
            remedy="free some space there and run the same command again, "
            f"or give a smaller {_option('max-features')}",
        )


def matching_plan(
    database: Path, memory: int, *, least: int = 2
) -> tuple[pycolmap.FeatureMatchingOptions, int]:
    """Matching options with a number of threads that fits, and how many photos are held at once.

    Args:
        database: pycolmap's database, with features.
        memory: Bytes available.
        least: Fewest photos that must be held.

    Raises:
        MemoryBudgetError: If ``least`` photos do not fit even with one thread.
    """
    most, _, photos, _ = _counts(database)
    least = min(least, max(2, photos))
    need = budget.matching_bytes(most, least, 1)
    fewer = max(100, most * memory // max(need, 1) // 100 * 100)
    what, remedy = f"matching photos of {most:,} features", _option("max-features", fewer)
    budget.require(_STAGE, need, memory, what, remedy)
    threads = budget.most_within(
        memory, {count: budget.matching_bytes(most, least, count) for count in range(1, _cores() + 1)}
    )
    held = (memory - budget.matching_bytes(most, 0, threads)) // max(1, most * budget.FEATURE_BYTES)
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    return pycolmap.FeatureMatchingOptions(num_threads=threads), max(2, least, min(HELD_AT_MOST, held))


def check_mapping(database: Path, memory: int) -> None:
    """Check that a model of all verified matches fits.

    Raises:
        MemoryBudgetError: If it does not; states the memory it needs.
    """
    _, features, photos, matches = _counts(database)
    need = budget.mapping_bytes(features, matches)
    what = f"{photos:,} photos with {features:,} features and {matches:,} matches"
    budget.require(_STAGE, need, memory, what, f"fewer photos, or a smaller {_option('max-features')}")


def _counts(database: Path) -> tuple[int, int, int, int]:
    """Most features of one photo, features in total, photos, and verified matches in a database."""
    with closing(sqlite3.connect(database)) as connection:
        most, features, photos = connection.execute(
            "SELECT COALESCE(MAX(rows), 0), COALESCE(SUM(rows), 0), COUNT(*) FROM keypoints"
        ).fetchone()
        (matches,) = connection.execute("SELECT COALESCE(SUM(rows), 0) FROM two_view_geometries").fetchone()
    return int(most), int(features), int(photos), int(matches)


def _option(name: str, value: int | None = None) -> str:
    """The option of a setting of structure from motion, with a value: that of ``build``, and of ``poses``."""
    return f"--poses.{name}{'' if value is None else f' {value}'} (lexsplat poses: --{name})"


def _cores() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
