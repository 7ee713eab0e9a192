"""A built scene, open for queries: the Python face of lexsplat.

scene = lexsplat.open_scene("demo")
answers = scene.ask(["red apple", "mug"])  # scores, thresholds and presence of each prompt
apple = scene.find("red apple left of the mug")  # a Selection: instances, boxes, best view
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features.hub import present_name
from lexsplat.features.same_encoder import under_hash_of_features
from lexsplat.features.text import TextCache, TextTower, encode_each, load_text, texts_of_scene
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import World, world_of
from lexsplat.language.fields import LanguageField
from lexsplat.queries.everyday import EverydayScale, everyday_words
from lexsplat.queries.parts import ThingGraph
from lexsplat.queries.phrases import Understood
from lexsplat.queries.picking import Hit, point_at, select_hit, surface_at
from lexsplat.queries.presence import PresenceClassifier
from lexsplat.queries.relevancy import (
    QueryConfig,
    Question,
    TextEncoder,
    check_phrase,
    check_prompts,
    embed_prompts,
    render_relevancy,
)
from lexsplat.queries.scoring import form_used, render_gaussian_scores
from lexsplat.queries.seen import Seen
from lexsplat.queries.selection import Selection
from lexsplat.queries.thresholds import check_threshold
from lexsplat.queries.vocabulary import thing_of_part
from lexsplat.rendering import Rendering, render
from lexsplat.runtime.bounded import Bounded
from lexsplat.runtime.device import kernel_threads, torch_threads
from lexsplat.runtime.errors import SceneFolderError
from lexsplat.runtime.lazy import at_first_call
from lexsplat.runtime.progress import Listener, silent
from lexsplat.scenes.answers import Answers, automatic_thresholds
from lexsplat.scenes.asking import in_words_that_fit
from lexsplat.scenes.finding import find_in, understood_in
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.kept import KeptObjects, kept_objects_of, seen_of
from lexsplat.scenes.objects import codes_of_things, objects_of
from lexsplat.scenes.reading import read_scene
from lexsplat.scenes.views import StoredView, view_named
from lexsplat.scenes.words import KEPT_GRAPHS, Word, new_words

_KEPT_BYTES = 128 << 20
"""Memory for the scores and selections of words that were asked, at most; 32 words are kept in any case."""
_KEPT_TEXTS = 4096
"""Number of text embeddings and of parsed phrases that are kept."""


class Scene:
    """Gaussians, their language, and the views they were built from.

    Wherever a list of prompts is expected, a single text is one prompt. Wherever a view is expected, the name of a
    view (with or without suffix), a `StoredView` or any `Camera` will do.

    A scene keeps what it has computed for a word (bounded), and may be asked by many threads at once.

    Args:
        gaussians: Geometry and appearance.
        field: Their language.
        views: The views by name.
        clip: Name or folder of the text encoder that belongs to the language.
        query: Settings of the comparison with text.
        folder: The folder that the scene was opened from, if any.
        encode_text: Texts to embeddings, in place of the encoder that ``clip`` names.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        field: LanguageField,
        views: Mapping[str, StoredView],
        clip: str,
        query: QueryConfig | None = None,
        folder: SceneFolder | None = None,
        encode_text: TextEncoder | None = None,
    ) -> None:
        self.gaussians, self.field, self.views = gaussians, field, dict(views)
        self.clip, self.folder = present_name(clip), folder
        self.listener: Listener = silent  # receives progress events, such as of stage "views"
        self._working = threading.RLock()
        """Held while something new is computed; what is known is answered without it."""
        self.query = query or QueryConfig()
        self.given_encode_text = encode_text
        self.text_tower: TextTower | None = None
        self.original: Scene | None = None  # the scene as it was built, where this one is an edit of it
        self._cache: TextCache | None = None
        if folder is not None:
            own, common = (root / "checkpoints" / "texts" for root in (folder.root, BUNDLED_SCENE))
            self._cache = texts_of_scene(own, shipped=folder.is_bundled, common=common)
        self._texts: Bounded[str, Tensor] = Bounded(_KEPT_TEXTS)
        self.graphs: Bounded[str, ThingGraph] = Bounded(KEPT_GRAPHS)  # of things whose parts were asked for

    def __repr__(self) -> str:
        place = f", folder={str(self.folder.root)!r}" if self.folder else ""
        return f"Scene(gaussians={len(self.gaussians)}, views={len(self.views)}, method={self.field.method!r}{place})"

    _repr_html_ = at_first_call("lexsplat.scenes.notebook", "scene_html")

    @property
    def query(self) -> QueryConfig:
        """How text is compared with the scene."""
        return self._query

    @query.setter
    def query(self, query: QueryConfig) -> None:
        self._query = query
        self._classifier: PresenceClassifier | None = None
        self._scale: EverydayScale | None = None
        self._objects: tuple[Selection, ...] | None = None
        self.__dict__.pop("kept", None)
        kept = max(32, min(1024, _KEPT_BYTES // (9 * max(1, len(self.gaussians)))))
        self._words: Bounded[str, Word] = Bounded(kept)
        self._found: Bounded[tuple[str, str | None, float | None], Selection] = Bounded(kept)
        self._understood: Bounded[str, Understood] = Bounded(_KEPT_TEXTS)

    def with_content(self, gaussians: Gaussians, field: LanguageField) -> Scene:
        """The same views and encoder with other Gaussians and their language, as after an edit."""
        same = self.views, self.clip, self.query, self.folder, self.given_encode_text
        other = Scene(gaussians, field, *same)
        other.text_tower, other._cache, other._texts = self.text_tower, self._cache, self._texts
        other.listener, other.original = self.listener, self.original or self
        other._scale = self._scale if field.codebook is self.field.codebook else None
        return other

    # -- text

    def embed(self, prompts: str | Sequence[str]) -> Tensor:
        """Unit text embeddings ``[P, D]``; each prompt is encoded once.

        Raises:
            QueryError: If there is no prompt or one is empty.
            ModelError: If the text encoder cannot be loaded.
        """
        prompts = check_prompts(prompts)
        found = {prompt: self._texts.get(prompt) for prompt in dict.fromkeys(prompts)}
        new = [prompt for prompt, vector in found.items() if vector is None]
        if new:  # in one call, so that the cache on disk is written once
            with self._working, torch_threads(kernel_threads()):  # `new_words` uses few
                vectors = embed_prompts(new, self.encode_text, self.query.templates)
            found.update((prompt, self._texts.put(prompt, vector)) for prompt, vector in zip(new, vectors))
        return torch.stack([vector for prompt in prompts if (vector := found[prompt]) is not None])

    def write_texts(self) -> None:
        """Write what was embedded to the caches on disk, as the end of the process does."""
        if self._cache is not None:
            self._cache.write()

    def encode_text(self, texts: list[str]) -> Tensor:
        """Embeddings ``[T, D]`` of whole sentences, from the encoder that belongs to the language.

        The scene folder and the user's cache keep them, so that a known prompt needs no model.

        Raises:
            ModelError: If the encoder cannot be loaded, or is not the one that belongs to the language.
        """
        if self.given_encode_text is not None:
            return self.given_encode_text(texts)
        known = self._encoder_hash
        if self._cache is None or known is None:
            return encode_each(self.preload(), texts, self.listener)
        return self._cache.encode(known, texts, self.preload, self.listener)

    def encoder_identity(self) -> dict[str, str]:
        """Name and content hash (if known) of the text encoder, for files of other programs."""
        known = self._encoder_hash
        return {"encoder": self.clip, **({"encoder_hash": known} if known else {})}

    @property
    def _encoder_hash(self) -> str | None:
        return self.folder.record["stages"].get("features", {}).get("clip_hash") if self.folder else None

    def preload(self) -> TextTower:
        """Load the text encoder that belongs to the language, so that the first query does not wait for it.

        Raises:
            ModelError: If it cannot be loaded, or is another one.
        """
        tower = self.text_tower or load_text(self.clip, str(self.gaussians.device))
        self.text_tower = under_hash_of_features(self.clip, tower, self._encoder_hash)
        return self.text_tower

    def question(self, prompts: str | Sequence[str]) -> Question:
        """The embedded prompts with what they are compared with."""
        texts = self.embed(prompts), self.embed(self.query.compared)
        if not self.query.everyday:
            return Question(*texts, self.query)
        with self._working:  # before the locks of the classifier's properties, as in `ask`
            best = self.presence_classifier.best_heights(check_prompts(prompts))
        return Question(*texts, self.query, self.everyday_scale, best)

    @property
    def everyday_scale(self) -> EverydayScale:
        """Scores of everyday words in the scene; computed at first use."""
        if self._scale is None:
            self._scale = EverydayScale.of(self.field.codebook.clip, self.embed(everyday_words()))
        return self._scale

    # -- answers

    def ask(
        self, prompts: str | Sequence[str], threshold: float | None = None, *, checked: bool = False
    ) -> Answers:
        """Scores, threshold and presence of each prompt; every mask and selection of the scene reads them.

        A prompt with words that are not understood, or that the encoder does not know, is "unsure" at most.

        Args:
            prompts: Free-text prompts.
            threshold: Smallest score of a selected Gaussian, in 0..1; None derives one (`automatic_thresholds`).
            checked: Whether the prompts are names of things, whose words are not checked (again).

        Raises:
            QueryError: If there is no prompt, one is empty, or the threshold is not in 0..1.
            ModelError: If the text encoder cannot be loaded.
        """
        prompts = check_prompts(prompts)
        given = None if threshold is None else check_threshold(threshold)
        words_of = self._words  # another query replaces it
        found = {prompt: words_of.get(prompt) for prompt in dict.fromkeys(prompts)}
        if new := [prompt for prompt, word in found.items() if word is None]:
            # A part is cut within its thing, which is asked for with it.
            things = (thing for thing in map(thing_of_part, new) if thing and words_of.get(thing) is None)
            new = list(dict.fromkeys([*things, *new]))
            with self._working:
                found.update((p, words_of.put(p, word)) for p, word in zip(new, new_words(self, new)))
        words = [word for prompt in prompts if (word := found[prompt]) is not None]
        presences = tuple(word.presence for word in words)
        if not checked:
            words, presences = in_words_that_fit(self, prompts, words)
        scores = torch.stack([word.scores for word in words])
        if given is not None:
            limits = torch.full((len(words),), given)
            return Answers(tuple(prompts), scores, limits, presences, self, automatic=False)
        unknown = {prompt: word for prompt, word in zip(prompts, words) if word.threshold is None}
        if unknown:
            with self._working:
                for word, limit in zip(unknown.values(), automatic_thresholds(self, unknown)):
                    word.threshold = limit
        limits = torch.tensor([word.threshold for word in words])
        return Answers(tuple(prompts), scores, limits, presences, self, words=tuple(words))

    def relevancy(self, prompts: str | Sequence[str], view: str | StoredView | Camera) -> Tensor:
        """Relevancy maps ``[P, H, W]`` of the prompts in a view, in 0..1.

        Raises:
            QueryError: If a prompt is empty or the view is unknown.
        """
        camera = self.camera(view)
        if form_used(self.field, self.query) == "segment":
            return render_gaussian_scores(self.gaussians, camera, self.ask(prompts).scores)
        return render_relevancy(self.field, self.gaussians, camera, self.question(self.ask(prompts).asked))

    def scores(self, prompts: str | Sequence[str]) -> Tensor:
        """Relevancy ``[P, N]`` of every Gaussian for the prompts, in 0..1."""
        return self.ask(prompts).scores

    def thresholds(self, prompts: str | Sequence[str]) -> Tensor:
        """The automatic threshold ``[P]`` of each prompt (`ask`); 0.5 for what the scene does not hold."""
        return self.ask(prompts).thresholds

    def select(self, phrase: str, threshold: float | None = None) -> Selection:
        """The Gaussians that match a phrase, with instances, boxes and a best view.

        Args:
            phrase: Free-text phrase.
            threshold: Smallest score of a selected Gaussian, in 0..1; None derives one from the scene and drops
                instances that score far worse than the best one (`Selection.convincing`).

        Raises:
            QueryError: If the phrase is empty or not a single text, or the threshold is not in 0..1.
        """
        return self.ask(check_phrase(phrase), threshold).selection(0)

    def find(
        self,
        phrase: str,
        view: str | StoredView | Camera | None = None,
        *,
        threshold: float | None = None,
    ) -> Selection:
        """The Gaussians that match a phrase with relations, such as "mug on the cloth" (`lexsplat.queries.grammar`).

        Args:
            phrase: Free-text phrase.
            view: The view that "left" and "right" refer to; None takes what most of the views that show both say.
            threshold: See `select`.

        Raises:
            QueryError: If a part of the phrase is empty, the view is unknown, or the threshold is not in 0..1.
        """
        understood = self.understand(phrase)
        threshold = None if threshold is None else check_threshold(threshold)
        camera = None if view is None else self.camera(view)
        if isinstance(view, Camera):
            return find_in(self, understood, camera, threshold)
        name = None if view is None else (view if isinstance(view, StoredView) else self.view(view)).name
        key = (repr(understood), name, threshold)
        return self._found.get_or_make(key, lambda: find_in(self, understood, camera, threshold))

    def understand(self, phrase: str) -> Understood:
        """How `find` understands a phrase; its typing errors are corrected where the scene holds what is meant.

        Raises:
            QueryError: If a part of the phrase is empty.
        """
        text = check_phrase(phrase)
        return self._understood.get_or_make(text, lambda: understood_in(self, text))

    @property
    def objects(self) -> tuple[Selection, ...]:
        """Its objects with everyday names (`lexsplat.scenes.objects.objects_of`), the largest first."""
        if self._objects is None:
            with self._working:
                self._objects = self._objects or (self.kept.objects if self.kept else objects_of(self))
        return self._objects

    def selection(self, mask: Tensor, scores: Tensor, **facts: Any) -> Selection:
        """A selection of its Gaussians; the arguments are those of `Selection`."""
        facts = {"world": self.world, "seen": self.seen, **facts}
        return Selection(self.gaussians, self.cameras, mask, scores, **facts)

    def click(self, view: str | StoredView | Camera, x: float, y: float) -> Selection:
        """The surface at a pixel, and connected Gaussians with the same language.

        Args:
            view: The view that was clicked.
            x: Pixels from the left; the first pixel's center is 0.5.
            y: Pixels from the top.

        Raises:
            QueryError: If the pixel lies outside the image or shows nothing, or the view is unknown.
        """
        return self.select_hit(surface_at(self.gaussians, self.camera(view), x, y))

    def point(self, view: str | StoredView | Camera, x: float, y: float) -> NDArray[np.float64] | None:
        """The point ``[3]`` on the surface at a pixel (as of `click`), world units; None where it shows nothing.

        Raises:
            QueryError: If the pixel lies outside the image or is not of two numbers, or the view is unknown.
        """
        return point_at(self.gaussians, self.camera(view), x, y)

    def select_hit(self, hit: Hit) -> Selection:
        """The object at a surface that was clicked."""
        return replace(select_hit(hit, self.gaussians, self.field, self.cameras, self.world), seen=self.seen)

    @property
    def presence_classifier(self) -> PresenceClassifier:
        """Decides whether the scene holds a phrase at all; made at first use."""
        if self._classifier is None:
            places, things = self.kept.places if self.kept else None, partial(codes_of_things, self)
            known = (self.everyday_scale, self.embed, places, things)
            self._classifier = PresenceClassifier(self.gaussians, self.field, *known)
        return self._classifier

    @cached_property
    def seen(self) -> Seen | None:
        """Visibility of its segments in its views; None for a scene without segments."""
        return seen_of(self)

    @cached_property
    def kept(self) -> KeptObjects | None:
        """Its objects as its folder keeps them; None where it keeps none of this scene, encoder and query."""
        return None if self.given_encode_text is not None else kept_objects_of(self)

    @property
    def hidden(self) -> Tensor:
        """Gaussians ``[N]`` bool that the views hardly show, as far as a scene with segments knows."""
        return torch.zeros_like(self.gaussians.opacity_logits).bool() if not self.seen else self.seen.hidden

    # -- views

    @cached_property
    def world(self) -> World:
        """The up direction, and the length of a unit in meters if known (``lexsplat scale``)."""
        return world_of(self.folder.record if self.folder else {}, self.cameras)

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of all views by name."""
        return {name: view.camera for name, view in self.views.items()}

    def render(self, view: str | StoredView | Camera) -> Rendering:
        """The scene in color.

        Raises:
            QueryError: If the view is unknown.
        """
        with torch.no_grad():
            return render(self.gaussians, self.camera(view))

    def camera(self, view: str | StoredView | Camera) -> Camera:
        """The camera of a view.

        Raises:
            QueryError: If the view is unknown.
        """
        found = view if isinstance(view, (Camera, StoredView)) else self.view(view)
        return found if isinstance(found, Camera) else found.camera

    def view(self, name: str) -> StoredView:
        """The view called ``name`` (`lexsplat.scenes.views.view_named`).

        Raises:
            QueryError: If there is none, or several match.
        """
        return view_named(self.views, name)


def open_scene(path: str | Path, *, device: str = "auto", clip: str | None = None) -> Scene:
    """Open a scene folder for queries.

    Args:
        path: A folder made by ``lexsplat build`` or ``lexsplat demo``, or the word ``demo`` for the bundled scene.
        device: "cpu", "cuda", or "auto": CUDA where there is a GPU that gsplat renders on.
        clip: Name or folder of the text encoder, if it is not where the build found it; it is checked at once.

    Raises:
        SceneFolderError: If the folder is not a finished scene.
        ModelError: If ``clip`` cannot be found, or is not the encoder of the build.
        FileFormatError: If one of its files is damaged.
        BackendError: If "cuda" is asked for and cannot be used.
        ValueError: If the device is not one of the three.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise SceneFolderError(repr(path)[:60], expected="a scene folder's path", found=type(path).__name__)
    found = read_scene(Path(path), device)
    return Scene(found.gaussians, found.field, found.views, found.encoder(clip), found.query, found.folder)
