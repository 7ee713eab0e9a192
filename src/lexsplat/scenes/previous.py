"""The previous version of a scene, which answers queries while the scene is rebuilt.

Before a build changes the first file that queries read, it keeps these files in ``SCENE/previous/`` and marks the
record (``building``); it removes them when its last stage is finished. They are hard links and take no space, as
files are never changed in place (`lexsplat.runtime.files`).
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from pathlib import Path

from lexsplat.runtime.errors import SceneFolderError
from lexsplat.runtime.files import link_or_copy
from lexsplat.scenes.folder import SCENE_FILES, SceneFolder

FOLDER = "previous"
"""Name of the folder within the scene folder."""

REBUILD = "is at work or was interrupted: wait for it, or run the build again"
"""The state of a scene that its previous version answers for, and what to do."""


def keep_previous(folder: SceneFolder) -> None:
    """Keep a finished scene and mark its record; the unfinished result of an interrupted build is not kept.

    The caller holds the lock of the folder and saves the record.
    """
    stages = folder.record["stages"]
    whole = {"reconstruct", "language"} <= stages.keys() and all(
        (folder.root / name).is_file() for name in SCENE_FILES
    )
    if whole and not folder.record.get("building"):
        drop_previous(folder)
        made = Path(tempfile.mkdtemp(prefix=".previous.", dir=folder.root))
        # A temporary folder is private to its owner; the kept files are as readable as the scene.
        made.chmod(stat.S_IMODE(folder.root.stat().st_mode))
        for name in SCENE_FILES:
            link_or_copy(folder.root / name, made / name)
        os.replace(made, folder.root / FOLDER)
    folder.record["building"] = True


def drop_previous(folder: SceneFolder) -> None:
    """Remove the previous version. A reader that finds files missing meanwhile finds the new scene finished."""
    for left in folder.root.glob(".previous.*"):
        shutil.rmtree(left, ignore_errors=True)
    kept = folder.root / FOLDER
    if kept.is_dir():
        gone = Path(tempfile.mkdtemp(prefix=".previous.", dir=folder.root))
        os.replace(kept, gone / FOLDER)
        shutil.rmtree(gone)


def previous_of(folder: SceneFolder) -> SceneFolder | None:
    """The previous version in a folder, if there is one; it reads from there and writes to the folder itself."""
    if not (folder.root / FOLDER / "scene.json").is_file():
        return None
    return SceneFolder(folder.root, content=folder.root / FOLDER)


def version_that_answers(folder: SceneFolder) -> SceneFolder:
    """The folder itself, or its previous version while a build is at work or after one was interrupted."""
    return (previous_of(folder) if folder.record.get("building") else None) or folder


def require_current(folder: SceneFolder) -> None:
    """Refuse to change or measure a scene that is being rebuilt.

    Raises:
        SceneFolderError: If the folder was opened from its previous version.
    """
    if folder.content != folder.root:
        raise SceneFolderError(
            folder.root,
            expected="a finished build",
            found="a build that is running or was interrupted",
            remedy="wait for it, or run the build again",
        )
