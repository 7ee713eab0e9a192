"""Reading a scene folder as a whole, even while a build is changing it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lexsplat.features.hub import content_hash, model_folder, present_name
from lexsplat.features.same_encoder import check_encoder
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField, field_from_tensors
from lexsplat.queries.relevancy import QueryConfig
from lexsplat.rendering.backends import choose_rasterizer
from lexsplat.runtime.errors import FileFormatError, SceneFolderError
from lexsplat.runtime.files import read_tensors
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import version_that_answers
from lexsplat.scenes.views import StoredView

_ATTEMPTS = 5
"""How often reading is tried again because a build has changed the folder in the meantime."""


@dataclass(frozen=True)
class SceneContent:
    """One version of a scene."""

    folder: SceneFolder
    views: dict[str, StoredView]
    gaussians: Gaussians
    field: LanguageField

    @property
    def query(self) -> QueryConfig:
        """The default settings of queries: as in the paper if it was built so."""
        if self.folder.record.get("config", {}).get("as_in_paper"):
            return QueryConfig(form="feature", fixed=True)
        return QueryConfig()

    def encoder(self, given: str | None = None) -> str:
        """Name or folder of the text encoder. With the files of the bundled one, it is the bundled one.

        Args:
            given: One to take, if it is the encoder of the build; None takes it from where the build found it.

        Raises:
            ModelError: If the given one cannot be found, or is another one.
        """
        built_with = present_name(self.folder.record.get("config", {}).get("clip", "bundled"))
        name = present_name(given or built_with)
        needed = self.folder.record["stages"].get("features", {}).get("clip_hash")
        if needed is None or name == built_with == "bundled":
            return name
        if name != built_with:  # known words would be answered without the encoder
            check_encoder(name, content_hash(model_folder(name, "clip"), "clip"), needed)
        return name if needed != content_hash(model_folder("bundled", "clip"), "clip") else "bundled"


def read_scene(path: Path, device: str) -> SceneContent:
    """The scene in a folder, or its previous version while it is being rebuilt.

    Args:
        path: The folder.
        device: "auto", "cpu" or "cuda" (`choose_rasterizer`).

    Raises:
        BackendError: If "cuda" is asked for and cannot be used.
        ValueError: If the device is not one of the three.
        SceneFolderError: If there is neither, or builds change it faster than it is read.
        FileFormatError: If a file is damaged.
    """
    device, attempts, failed = choose_rasterizer(device), 0, ""
    while True:
        folder = SceneFolder.open(path)
        attempts += 1
        try:
            return _read_content(version_that_answers(folder), device)
        except (SceneFolderError, FileFormatError) as error:
            still = _state(SceneFolder.open(path)) == _state(folder)
            if still and str(error) == failed:  # what is damaged is damaged when it is read again
                if folder.record.get("edits"):  # a build is refused there
                    raise error.with_remedy(
                        "restore it from a copy, or edit and save the original again"
                    ) from error
                raise
            failed = str(error) if still else ""
            if attempts == _ATTEMPTS:  # a build in progress explains what is missing
                raise SceneFolderError(
                    path,
                    expected="a scene that does not change while it is read",
                    found=f"builds that changed it {_ATTEMPTS} times",
                    remedy="ask again when they are done",
                ) from error


def _state(folder: SceneFolder) -> tuple[Any, Any]:
    """The part of the record that a build changes before it touches a file."""
    return folder.record["stages"], folder.record.get("building")


def _read_content(folder: SceneFolder, device: str) -> SceneContent:
    """One version of a scene."""
    if "language" not in folder.record["stages"] or not folder.language_path.exists():
        finished = ", ".join(folder.record["stages"]) or "none"
        lost = "language" in folder.record["stages"]
        raise SceneFolderError(
            folder.root,
            expected="a scene with language",
            found=f"no {folder.language_path.name}" if lost else f"finished stages: {finished}",
            remedy="run the build again to finish it",
        )
    views, gaussians = folder.read_cameras(), folder.read_gaussians()
    tensors, metadata = read_tensors(folder.language_path)
    # A build removes a stage from the record before it touches its files: if the record is unchanged, all files are
    # of one build.
    changed = _state(SceneFolder(folder.root, folder.content)) != _state(folder)
    try:
        field = field_from_tensors({name: tensor.to(device) for name, tensor in tensors.items()}, metadata)
    except ValueError as error:
        raise FileFormatError(
            folder.language_path,
            expected="a language field",
            found=str(error)[:200],
            remedy="run the build again",
        ) from error
    reconstruction = folder.record["stages"].get("reconstruct", {}).get("fingerprint")
    if changed:
        raise SceneFolderError(
            folder.root,
            expected="files that do not change",
            found="a build at work",
            remedy="another process is rebuilding the scene: try again when it is finished",
        )
    if metadata.get("reconstruction") != reconstruction or len(field.uncertainties) != len(gaussians):
        raise SceneFolderError(
            folder.root,
            expected="language made for these Gaussians",
            found="language of an earlier reconstruction",
            remedy="run the build again to finish it",
        )
    return SceneContent(folder, views, gaussians.to(device), field)
