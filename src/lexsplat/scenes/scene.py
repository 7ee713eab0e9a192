"""A finished scene, open for questions: the Python face of lexsplat.

import lexsplat
scene = lexsplat.open_scene("output/demo")
relevancy = scene.relevancy(["red apple"], view="frame_0005.jpg")  # [1, H, W]
scores = scene.scores(["red apple"])  # [1, N], one for each Gaussian
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from lexsplat.features.text import TextCache, encode_each
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import World, world_of
from lexsplat.language.fields import LanguageField, field_from_tensors
from lexsplat.queries.phrases import parse
from lexsplat.queries.picking import select_hit, surface_at
from lexsplat.queries.presence import REFERENCE_PHRASES, PresenceClassifier, found_thresholds
from lexsplat.queries.relations import answer
from lexsplat.queries.relevancy import (
    CANONICAL_PHRASES,
    QueryConfig,
    check_prompts,
    embed_prompts,
    gaussian_relevancy,
    render_relevancy,
)
from lexsplat.queries.selection import Selection
from lexsplat.rendering import Rendering, render
from lexsplat.runtime.errors import FileFormatError, ModelError, QueryError, SceneFolderError
from lexsplat.runtime.files import read_tensors
from lexsplat.scenes.folder import SceneFolder, StoredView
from lexsplat.scenes.previous import previous_of

if TYPE_CHECKING:
    from lexsplat.features.encoders import ImageTextEncoder


class Scene:
    """Gaussians, their language and the views they were made from.

    Args:
        gaussians: Geometry and appearance.
        field: Their language.
        views: The views by name.
        clip: Name or folder of the encoder the language was made with.
        query: How questions are answered.
        folder: Where the scene was opened from, if from disk.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        field: LanguageField,
        views: Mapping[str, StoredView],
        clip: str,
        query: QueryConfig | None = None,
        folder: SceneFolder | None = None,
    ) -> None:
        self.gaussians, self.field, self.views = gaussians, field, dict(views)
        self.clip, self.query, self.folder = clip, query or QueryConfig(), folder
        self._encoder: ImageTextEncoder | None = None
        self._cache: TextCache | None = None
        self._texts: dict[str, Tensor] = {}
        self._judge: PresenceClassifier | None = None
        self._world: World | None = None

    def with_content(self, gaussians: Gaussians, field: LanguageField) -> Scene:
        """The same views and encoder with other Gaussians and their language, as after an edit."""
        other = Scene(gaussians, field, self.views, self.clip, self.query, self.folder)
        other._encoder, other._cache, other._texts = self._encoder, self._cache, self._texts
        return other

    # -- text

    def embed(self, prompts: Sequence[str]) -> Tensor:
        """Unit text embeddings ``[P, D]``; each prompt is encoded once.

        Raises:
            QueryError: If there is no prompt or one is empty.
            ModelError: If the text encoder cannot be loaded.
        """
        import torch

        if not prompts:
            raise QueryError("query", expected="at least one prompt", found="none")
        new = [prompt for prompt in dict.fromkeys(prompts) if prompt not in self._texts]
        if new:  # by one call: the cache on disk is written once
            self._texts.update(zip(new, embed_prompts(new, self.encode_text, self.query.templates)))
        return torch.stack([self._texts[prompt] for prompt in prompts])

    def encode_text(self, texts: list[str]) -> Tensor:
        """Embeddings ``[T, D]`` of whole sentences, by the encoder the language was made with.

        They are kept in the scene folder, so that a question asked twice loads no model.

        Raises:
            ModelError: If the encoder cannot be loaded, or is not the one the language was made with.
        """
        known = self.folder.record["stages"].get("features", {}).get("clip_hash") if self.folder else None
        writable = self.folder and not self.folder.is_bundled and os.access(self.folder.root, os.W_OK)
        if self.folder is None or known is None or not writable:
            return encode_each(self._load_encoder(known), texts)
        if self._cache is None:
            self._cache = TextCache(self.folder.root / "checkpoints" / "texts")
        return self._cache.encode(known, texts, lambda: self._load_encoder(known))

    def encoder_identity(self) -> dict[str, str]:
        """Name and content hash (where known) of the encoder of the texts, for files of other programs."""
        known = self.folder.record["stages"].get("features", {}).get("clip_hash") if self.folder else None
        return {"encoder": self.clip, **({"encoder_hash": known} if known else {})}

    def preload(self) -> None:
        """Load the text encoder now, so that the first question need not wait for it.

        Raises:
            ModelError: If it cannot be loaded.
        """
        self._load_encoder(self.encoder_identity().get("encoder_hash"))

    def _load_encoder(self, known: str | None) -> ImageTextEncoder:
        from lexsplat.features.encoders import load_clip

        if self._encoder is None:
            self._encoder = load_clip(self.clip, str(self.gaussians.device))
        if known is not None and self._encoder.content_hash != known:
            raise ModelError(
                self.clip,
                expected="the encoder the scene was made with",
                found="another one",
                remedy="name the right one with --clip, or build the scene again with this one",
            )
        return self._encoder

    def _negatives(self) -> Tensor:
        return self.embed(list(self.query.negatives or CANONICAL_PHRASES))

    # -- answers

    def relevancy(self, prompts: Sequence[str], view: str | Camera) -> Tensor:
        """Relevancy maps ``[P, H, W]`` in 0..1 of the prompts in a view (a name or any camera)."""
        camera = view if isinstance(view, Camera) else self.view(view).camera
        positives = self.embed(prompts)
        return render_relevancy(self.field, self.gaussians, camera, positives, self._negatives(), self.query)

    def scores(self, prompts: Sequence[str]) -> Tensor:
        """Relevancy ``[P, N]`` in 0..1 of every Gaussian for the prompts."""
        return gaussian_relevancy(self.field, self.embed(prompts), self._negatives(), self.query)

    def thresholds(self, prompts: Sequence[str]) -> Tensor:
        """An automatic threshold ``[P]`` for each prompt, from the scene alone; 0.5 for what is not there."""
        return found_thresholds(self.presence_classifier, self.gaussians, self._threshold_cameras(),
                                self.embed(prompts), self._negatives(), self.query)  # fmt: skip

    def select(self, phrase: str, threshold: float | None = None) -> Selection:
        """The Gaussians that answer to a phrase, as a set with instances, boxes and a best view.

        Args:
            phrase: What to look for.
            threshold: Score from which a Gaussian belongs to it; none chooses one from the scene, and leaves out
                instances that answer far worse than the best one (`Selection.convincing`).

        Raises:
            QueryError: If the phrase is empty.
        """
        (phrase,) = check_prompts([phrase])
        scores = self.scores([phrase])[0]
        limit = float(self.thresholds([phrase])[0]) if threshold is None else float(threshold)
        present = self.presence_classifier.judge(scores)
        chosen = Selection(
            self.gaussians, self.cameras, scores >= limit, scores, limit, present, phrase, self.world
        )
        chosen = chosen.without_specks()
        return chosen.convincing() if threshold is None else chosen

    @property
    def presence_classifier(self) -> PresenceClassifier:
        """What decides whether a phrase is in the scene at all; made when it is first needed."""
        if self._judge is None:
            references = self.embed(list(REFERENCE_PHRASES))
            self._judge = PresenceClassifier(
                self.gaussians, self.field, references, self._negatives(), self.query.temperature
            )
        return self._judge

    def find(
        self, phrase: str, view: str | Camera | None = None, *, threshold: float | None = None
    ) -> Selection:
        """What a phrase with relations asks for, such as "mug on the cloth" (`lexsplat.queries.phrases`).

        Args:
            phrase: What to look for.
            view: Whose left and right are meant; none takes the view that shows best what they refer to.
            threshold: See `select`.

        Raises:
            QueryError: If the phrase has an empty part.
        """
        chosen = view if view is None or isinstance(view, Camera) else self.view(view).camera

        def viewer(reference: Selection) -> Camera | None:
            return chosen or self.cameras.get(reference.best_view)

        return answer(parse(phrase), lambda text: self.select(text, threshold), viewer)

    def click(self, view: str | Camera, x: float, y: float, *, similarity: float | None = None) -> Selection:
        """What a click on a picture hits: the surface there and what is joined to it and says the same.

        Args:
            view: Name of a view, or any camera.
            x: Pixels from the left, 0.5 being the middle of the first.
            y: Pixels from the top.
            likeness: How alike in language a Gaussian must be, in 0..1; none finds a limit in the scene.

        Raises:
            QueryError: If the pixel lies outside the picture or shows nothing.
        """
        camera = view if isinstance(view, Camera) else self.view(view).camera
        hit = surface_at(self.gaussians, camera, x, y)
        return select_hit(hit, self.gaussians, self.field, self.cameras, similarity, self.world)

    @property
    def world(self) -> World:
        """Which way is up, and what a unit is in meters, where that is known (``lexsplat scale``)."""
        if self._world is None:
            self._world = world_of(self.folder.record if self.folder else {}, self.cameras)
        return self._world

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of all views by name."""
        return {name: view.camera for name, view in self.views.items()}

    def render(self, view: str | Camera) -> Rendering:
        """The scene in color."""
        import torch

        camera = view if isinstance(view, Camera) else self.view(view).camera
        with torch.no_grad():
            return render(self.gaussians, camera)

    def view(self, name: str) -> StoredView:
        """The view called ``name``, with or without its suffix.

        Raises:
            QueryError: If there is none.
        """
        if name in self.views:
            return self.views[name]
        matches = [view for key, view in self.views.items() if Path(key).stem == Path(name).stem]
        if len(matches) != 1:
            known = ", ".join(list(self.views)[:5])
            raise QueryError(
                f"view {name!r}",
                expected="the name of a view",
                found="none such" if not matches else f"{len(matches)} such",
                remedy=f"the scene has {len(self.views)} views, such as {known}",
            )
        return matches[0]

    def _threshold_cameras(self) -> list[Camera]:
        """Up to eight training cameras, spread over the capture."""
        cameras = [view.camera for view in self.views.values() if view.split == "train"]
        step = max(1, len(cameras) // 8)
        return cameras[::step][:8]


def open_scene(path: str | Path, *, device: str = "auto", clip: str | None = None) -> Scene:
    """Open a scene folder for questions.

    Args:
        path: A folder that ``lexsplat build`` or ``lexsplat demo`` made, or the word ``demo`` for the scene that
            ships with the package.
        device: "auto", "cpu" or "cuda".
        clip: Name or folder of the text encoder, if it is not where the build found it.

    Raises:
        SceneFolderError: If the folder is not a finished scene.
        FileFormatError: If one of its files is damaged.
    """
    from lexsplat.runtime.device import choose_device

    place = choose_device(device)
    folder, cameras, gaussians, field = _read_whole(Path(path), place)
    clip = clip or folder.record.get("config", {}).get("clip", "bundled")
    return Scene(gaussians, field, cameras, clip, folder=folder)


_Content = tuple[SceneFolder, dict[str, StoredView], Gaussians, LanguageField]
_ATTEMPTS = 5
"""A build may end, and the next begin, while a scene is read; more often than this it is no coincidence."""


def _read_whole(path: Path, device: str) -> _Content:
    """The scene in a folder, or while that is built again, the scene before.

    Raises:
        SceneFolderError: If there is neither.
        FileFormatError: If a file is damaged.
    """
    attempts = 0
    while True:
        folder = SceneFolder.open(path)
        attempts += 1
        try:
            kept = previous_of(folder) if folder.record.get("building") else None
            return _read_content(kept or folder, device)
        except (SceneFolderError, FileFormatError):
            if attempts == _ATTEMPTS or _state(SceneFolder.open(path)) == _state(folder):
                raise


def _state(folder: SceneFolder) -> tuple[Any, Any]:
    """What a build changes in the record before it touches a file."""
    return folder.record["stages"], folder.record.get("building")


def _read_content(folder: SceneFolder, device: str) -> _Content:
    """One version of a scene.

    Raises:
        SceneFolderError: If it is not whole.
        FileFormatError: If a file is damaged.
    """
    if "language" not in folder.record["stages"] or not folder.language_path.exists():
        finished = ", ".join(folder.record["stages"]) or "none"
        raise SceneFolderError(
            folder.root,
            expected="a scene with language",
            found=f"finished stages: {finished}",
            remedy="run the build again to finish it",
        )
    cameras, gaussians = folder.read_cameras(), folder.read_gaussians()
    tensors, metadata = read_tensors(folder.language_path)
    # A build takes a stage out of the record before it touches its files: what was read is of one build if the record
    # is still the same.
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
    made_from = folder.record["stages"].get("reconstruct", {}).get("fingerprint")
    if changed or metadata.get("reconstruction") != made_from or len(field.uncertainties) != len(gaussians):
        raise SceneFolderError(
            folder.root,
            expected="language made for these Gaussians",
            found="files that change" if changed else "language of an earlier reconstruction",
            remedy="the scene is being rebuilt or was left half way: run the build again",
        )
    return folder, cameras, gaussians.to(device), field
