"""The capture of a build from splats alone: its views are chosen, rendered and kept in the scene folder."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.captures import Capture, load_capture
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import parse_vector
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.splats import existing_splats, splats_hash
from lexsplat.pipeline.viewpoints.choosing import choose_views
from lexsplat.pipeline.viewpoints.floaters import find_floaters
from lexsplat.pipeline.viewpoints.writing import write_chosen_capture
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.progress import NOTE, Listener, kept_warnings, uncounted, warn_again
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.unsaved import refuse_to_lose_steps

log = logging.getLogger("lexsplat")

_MANY_UNSEEN = 0.1
"""Share of the visible Gaussians above which those in no view are a warning."""
_FLOATERS = "floaters.npy"
"""Indices of the Gaussians of the file that are left out, beside the chosen views."""
_RULES = 6
"""Changes where other views would be chosen, or other Gaussians left out, of the same file."""


def capture_of_splats(
    splats: Path | None, folder: SceneFolder, config: BuildConfig, device: str, listener: Listener
) -> Capture:
    """The capture of chosen views in ``poses/`` of a scene folder, chosen unless it is up to date.

    All views are training views: renders are no ground truth.

    Args:
        splats: File of Gaussians.
        folder: The scene folder.
        config: Settings of the build, of which the up direction, the seed, and those of the views are read.
        device: Device to render on.
        listener: Receives events of the stages "splats" (reading), "floaters", "floater views" and those
            of `choose_views`.

    Raises:
        FileFormatError: If the file is missing or damaged.
        CaptureError: If no views can be chosen.
    """
    splats, poses = existing_splats(splats), folder.root / "poses"
    settings = (config.up, config.seed, config.keep_floaters, config.views_from)
    key = fingerprint(_RULES, splats_hash(splats), *settings)
    complete = (poses / "transforms.json").is_file() and (poses / _FLOATERS).is_file()
    if not (complete and folder.is_finished("views", key)):
        refuse_to_lose_steps(folder)
        start = time.perf_counter()
        folder.reopen("views")
        with kept_warnings() as warnings:
            facts = _choose(splats, poses, config, device, listener)
        folder.finish("views", key, time.perf_counter() - start, **facts, warnings=warnings)
    else:
        warn_again(folder.record["stages"]["views"])
    folder.record["images"] = "poses/images"
    folder.record["capture"] = None
    return load_capture(poses, test_every=0)


def _choose(
    splats: Path, poses: Path, config: BuildConfig, device: str, listener: Listener
) -> dict[str, Any]:
    """Choose views and write their capture; returns facts for the record of the stage."""
    with uncounted(listener, "splats", splats.resolve()):
        gaussians = read_splats(splats).to(device)
    up = None if config.up is None else np.array(parse_vector(config.up))
    floaters = np.zeros(0, np.int64)
    if not config.keep_floaters:
        with uncounted(listener, "floaters", splats.resolve()):
            floaters = find_floaters(gaussians, splats, up=up, seed=config.seed, listener=listener)
    gaussians = _without(gaussians, floaters)
    chosen = choose_views(
        gaussians, up=up, side=config.views_from, subject=splats, seed=config.seed, listener=listener
    )
    write_chosen_capture(gaussians, chosen, poses, listener)
    with atomic_path(poses / _FLOATERS) as path, open(path, "wb") as file:
        np.save(file, floaters)
    few = chosen.unseen <= _MANY_UNSEEN * chosen.visible
    log.log(NOTE if few else logging.WARNING, "%s: %s", splats, chosen.note)
    return {
        "splats": str(splats.resolve()),
        "up": chosen.up,
        "views": len(chosen.cameras),
        "candidates": chosen.candidates,
        "showed_no_surfaces": chosen.left_out,
        "visible": chosen.visible,
        "unseen": chosen.unseen,
        "floaters": len(floaters),
    }


def splats_of_capture(splats: Path, capture: Capture, folder: SceneFolder) -> Gaussians:
    """The Gaussians of a file that a scene takes: without floaters if its views were chosen, else all.

    The photos of a user show all Gaussians.

    Raises:
        FileFormatError: If the file is missing or damaged.
    """
    gaussians, poses = read_splats(splats), folder.root / "poses"
    if capture.root != poses:
        return gaussians
    return _without(gaussians, np.load(poses / _FLOATERS, allow_pickle=False))


def _without(gaussians: Gaussians, indices: NDArray[np.int64]) -> Gaussians:
    if not len(indices):
        return gaussians
    kept = np.delete(np.arange(len(gaussians)), indices)
    return gaussians.select(torch.from_numpy(kept).to(gaussians.device))
