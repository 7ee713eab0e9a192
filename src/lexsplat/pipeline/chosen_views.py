"""The training views whose features a build makes, kept for the stages that follow."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path

from lexsplat.captures import View
from lexsplat.language.methods import FitRun, LanguageMethod, TrainingViews
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.folder import SceneFolder

log = logging.getLogger("lexsplat")


def choice_path(folder: SceneFolder) -> Path:
    """The file of the choice."""
    return folder.root / "checkpoints" / "views_to_read.safetensors"


def views_to_read(
    method: LanguageMethod,
    folder: SceneFolder,
    views: Mapping[str, View],
    config: BuildConfig,
    device: str,
    run: FitRun,
) -> TrainingViews:
    """Those of the training views whose features the method needs; a choice is kept in the scene folder.

    Args:
        method: The method.
        folder: The scene folder, with its Gaussians where the method chooses by them.
        views: The training views by name.
        config: Resolved settings.
        device: Device to choose on.
        run: Workers and listener.
    """
    whole = TrainingViews(views)
    if not method.feature_inputs(config):
        return whole
    gaussians = folder.read_gaussians().to(device)
    found = method.views_to_read(gaussians, whole, config, run)
    if found.shares is not None:
        facts = {"views": json.dumps(list(found.views)), "gaussians": _gaussians_of(folder)}
        write_tensors(choice_path(folder), {"shares": found.shares.cpu().half()}, facts)
    if len(found.views) < len(views):
        what = "features of %d of %d training photos, which show everything often enough"
        log.log(NOTE, what, len(found.views), len(views))
    return found


def kept_choice(folder: SceneFolder, views: Mapping[str, View]) -> TrainingViews | None:
    """The choice of an earlier run; None if its file is missing, damaged, or of other views or Gaussians."""
    try:
        tensors, facts = read_tensors(choice_path(folder))
        if facts["gaussians"] != _gaussians_of(folder):
            return None
        names = json.loads(facts["views"])
        return TrainingViews({name: views[name] for name in names}, shares=tensors["shares"].float())
    except (FileFormatError, KeyError, ValueError):
        return None


def _gaussians_of(folder: SceneFolder) -> str:
    """Checksum of the Gaussians, of which other bits may want other views."""
    return str(folder.record.get("checksums", {}).get(folder.gaussians_path.name, "unknown"))
