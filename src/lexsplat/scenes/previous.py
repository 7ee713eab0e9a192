"""What a scene was before it is built again: questions are answered from there until the new one is whole.

A build keeps the files that answer questions in ``SCENE/previous/`` before it changes the first of them, says so in
the record (``building``), and lets go of them when its last stage is finished. They are links to the same data,
which cost nothing: files are never changed in place (`lexsplat.runtime.files`).
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from pathlib import Path

from lexsplat.runtime.errors import SceneFolderError
from lexsplat.scenes.folder import SCENE_FILES, SceneFolder

FOLDER = "previous"
"""Name of the folder within the scene folder."""


def keep_previous(folder: SceneFolder) -> None:
    """Keep a whole scene and mark its record; what an interrupted build has begun is not whole and not kept.

    The caller holds the lock of the folder and saves the record.
    """
    stages = folder.record["stages"]
    whole = {"reconstruct", "language"} <= stages.keys() and all(
        (folder.root / name).is_file() for name in SCENE_FILES
    )
    if whole and not folder.record.get("building"):
        drop_previous(folder)
        made = Path(tempfile.mkdtemp(prefix=".previous.", dir=folder.root))
        # Whoever may read the scene may read what is kept of it; a temporary folder is its owner's alone.
        made.chmod(stat.S_IMODE(folder.root.stat().st_mode))
        for name in SCENE_FILES:
            _link(folder.root / name, made / name)
        os.replace(made, folder.root / FOLDER)
    folder.record["building"] = True


def drop_previous(folder: SceneFolder) -> None:
    """Let go of what was kept. Who is reading it at this moment finds files missing, and the new scene whole."""
    for left in folder.root.glob(".previous.*"):
        shutil.rmtree(left, ignore_errors=True)
    kept = folder.root / FOLDER
    if kept.is_dir():
        gone = Path(tempfile.mkdtemp(prefix=".previous.", dir=folder.root))
        os.replace(kept, gone / FOLDER)
        shutil.rmtree(gone)


def previous_of(folder: SceneFolder) -> SceneFolder | None:
    """The scene that is kept in a folder, if there is one; what is written goes to the folder itself."""
    if not (folder.root / FOLDER / "scene.json").is_file():
        return None
    return SceneFolder(folder.root, content=folder.root / FOLDER)


def require_current(folder: SceneFolder) -> None:
    """Refuse to change, or to measure, a scene that is about to be replaced.

    Raises:
        SceneFolderError: If the folder was opened from what is kept.
    """
    if folder.content != folder.root:
        raise SceneFolderError(
            folder.root,
            expected="a finished build",
            found="one at work, or stopped half way",
            remedy="wait for it, or run the build again",
        )


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)
