"""The views of a scene as its folder stores them, and their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.undistortion import MAX_SIDE
from lexsplat.captures.readers.camera_files import MAX_COORDINATE, checked_name
from lexsplat.captures.splits import match_stem
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import QueryError


@dataclasses.dataclass(frozen=True)
class StoredView:
    """A view as the scene folder stores it: enough to render, without the photo."""

    name: str
    camera: Camera
    split: str


def view_named(views: Mapping[str, StoredView], name: str) -> StoredView:
    """The view called ``name``, with or without its folder and its suffix.

    Raises:
        QueryError: If there is none, or several match.
    """
    if not isinstance(name, str):
        expected = "the name of a view, a StoredView or a Camera"
        raise QueryError("view", expected=expected, found=repr(name)[:60])
    # A suffix may be given where the views are stored without theirs.
    matches = match_stem(name, views) or match_stem(
        stem_of(name), (each for each in views if stem_of(each) == each)
    )
    if len(matches) != 1:
        known = ", ".join(list(views)[:5])
        raise QueryError(
            f"view {name[:60]!r}",
            expected="the name of a view",
            found="no match" if not matches else f"{len(matches)} matches",
            remedy=f"the scene has {len(views)} views, such as {known}",
        )
    return views[matches[0]]


def stored_view(entry: Any, path: Path) -> StoredView:
    """A view of ``cameras.json``.

    Raises:
        CaptureError: If its name leads out of the folder.
        KeyError, TypeError, ValueError, OverflowError: If an entry is missing or invalid.
    """
    name, split, width, height = entry["name"], entry["split"], entry["width"], entry["height"]
    if not isinstance(name, str) or split not in ("train", "test"):
        raise ValueError(f"view {name!r} of split {split!r}"[:100])
    if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in (width, height)):
        raise ValueError(f"size {width!r} x {height!r}"[:100])
    camera = Camera(width, height, np.array(entry["K"], float), np.array(entry["viewmat"], float))
    if np.abs(camera.viewmat).max() > MAX_COORDINATE:
        raise ValueError(f"the pose of {name!r} is too far from the origin"[:100])
    return StoredView(checked_name(name, path), camera, split)
