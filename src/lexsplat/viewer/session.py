"""What is asked, shown and selected: the state of the viewer, without a browser.

Quick answers (`ask`, `colors`) take milliseconds; `refine` looks at rendered views and takes longer, so the page
shows the quick answer first.
"""

from __future__ import annotations

import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.heatmaps import overlay_mask
from lexsplat.queries.phrases import Thing, parse
from lexsplat.queries.picking import select_hit, surface_at
from lexsplat.queries.presence import REFERENCE_PHRASES, PresenceClassifier
from lexsplat.queries.relevancy import Question as TextQuestion
from lexsplat.queries.relevancy import check_prompts, probability_relevancy
from lexsplat.queries.selection import Selection
from lexsplat.queries.thresholds import BORDER
from lexsplat.rendering import render
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.answers import file_name
from lexsplat.scenes.exporting import export_gaussians
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.coloring import PROMPT_COLORS, Coloring, Layer, Mode, quick_threshold
from lexsplat.viewer.history import Memory
from lexsplat.viewer.vocabulary import MAX_LENGTH

MAX_QUESTIONS = len(PROMPT_COLORS)
CLICKED_COLOR = (0, 168, 150)
EXPORT_ENDINGS = (".ply", ".glb", ".splat", ".spz", ".points.ply")
_CANDIDATE_VIEWS = 16
_MANY_GAUSSIANS = 500_000
"""From here on fewer views are tried: rendering one takes long."""


@dataclass
class Question:
    """A prompt that is shown, and what it found.

    Args:
        layer: How it is drawn.
        automatic: The scene's threshold for it; none until `Session.refine`.
        manual: The threshold that was chosen by hand, if one was.
        selection: The Gaussians it found; none until `Session.refine`.
    """

    layer: Layer
    automatic: float | None = None
    manual: float | None = None
    selection: Selection | None = None

    @property
    def text(self) -> str:
        """The prompt."""
        return self.layer.text


@dataclass(frozen=True)
class Answer:
    """What a click found.

    Args:
        phrases: The likeliest phrases of the vocabulary with their relevancy in 0..1, best first.
        selection: The surface that was clicked and what belongs to it.
        point: Where the click hit ``[3]``, world units.
    """

    phrases: list[tuple[str, float]]
    selection: Selection
    point: NDArray[np.float64]


class Session:
    """The state of one viewer.

    Args:
        scene: The scene.
        memory: History and vocabulary.
    """

    def __init__(self, scene: Scene, memory: Memory | None = None) -> None:
        self.scene, self.memory = scene, memory or Memory()
        self.coloring = Coloring(scene.gaussians, scene.field)
        self.mode: Mode = "photo"
        self.opacity, self.fade = 0.9, 0.0
        self.questions: list[Question] = []
        self.clicked: Question | None = None
        self.current: Question | None = None
        self._encoding = threading.Lock()
        self._judge: PresenceClassifier | None = None
        self._opacities = scene.gaussians.opacities.detach().cpu().numpy()

    def warm_up(self) -> None:
        """Load the text encoder and read the vocabulary, so that the first answers are quick.

        Raises:
            ModelError: If the encoder cannot be loaded.
        """
        with self._encoding:
            self.scene.preload()
        for phrase in [*self.scene.query.negatives, *self.memory.vocabulary]:
            with self._encoding:  # phrase by phrase: a question that comes meanwhile need not wait for all
                self.scene.embed([phrase])
        for phrase in REFERENCE_PHRASES:
            with self._encoding:
                self.scene.embed([phrase])
        self._judge = self.scene.presence_classifier

    # -- questions

    def ask(self, text: str) -> Question:
        """Show a prompt; an old one makes room when there are too many. Its threshold is provisional.

        Raises:
            QueryError: If it is empty or very long.
            ModelError: If the text encoder cannot be loaded.
        """
        (text,) = check_prompts([text])
        if len(text) > MAX_LENGTH:
            raise QueryError("prompt", expected=f"at most {MAX_LENGTH} characters", found=f"{len(text)}")
        question = self.find(text)
        if question is None:
            with self._encoding:
                self.scene.embed([text])
            scores = self.scene.scores([text])[0].cpu().numpy()
            layer = Layer(text, scores, self._quick_threshold(scores), self._free_color())
            question = Question(layer)
            self.questions = [*self.questions[-(MAX_QUESTIONS - 1) :], question]
        self.current, self.mode = question, "relevancy"
        return question

    def find(self, text: str) -> Question | None:
        """The question with this text, if it is shown."""
        return next((q for q in self.all_questions() if q.text == text), None)

    def all_questions(self) -> list[Question]:
        """Everything that is drawn: the prompts, then what was clicked."""
        return [*self.questions, *([self.clicked] if self.clicked else [])]

    def refine(self, question: Question, viewpoint: Camera | None = None) -> None:
        """Find the scene's own threshold for a prompt, and the Gaussians it selects.

        A phrase with relations ("mug on the cloth", see `lexsplat.queries.phrases`) is answered as by ``scene.find``.

        Args:
            question: The prompt.
            viewpoint: Whose left and right a phrase means; none takes the view that shows it best.
        """
        if question is self.clicked:
            return
        manual = question.manual
        if is_plain(question.text):
            selection = self.scene.select(question.text, manual)
            if manual is None:
                question.automatic = float(selection.threshold)
        else:
            selection = self.scene.find(question.text, viewpoint, threshold=manual)
            if manual is None:
                question.automatic = float(selection.threshold)
            selection = replace(selection, phrase=question.text)
            question.layer.set_scores(selection.scores.float().cpu().numpy())
        if manual == question.manual:  # otherwise the slider has moved on meanwhile
            question.selection = selection
            question.layer.threshold = float(selection.threshold)
            question.layer.mask = selection.mask.cpu().numpy()

    def set_threshold(self, question: Question, value: float | None) -> None:
        """Choose a threshold by hand, or none for the automatic one; drawn at once, selected by `refine`.

        Raises:
            ValueError: If it is not in 0..1.
        """
        if value is not None and not 0 <= value <= 1:
            raise ValueError(f"threshold must be in 0..1, got {value}")
        question.manual, question.selection, question.layer.mask = value, None, None
        if value is not None:
            question.layer.threshold = value
        elif question.automatic is not None:
            question.layer.threshold = question.automatic
        else:
            question.layer.threshold = self._quick_threshold(question.layer.scores)

    def remove(self, question: Question) -> None:
        """Show a prompt no longer."""
        self.questions = [q for q in self.questions if q is not question]
        if question is self.clicked:
            self.clicked = None
        if question is self.current:
            shown = self.all_questions()
            self.current = shown[-1] if shown else None

    def _quick_threshold(self, scores: NDArray[np.float32]) -> float:
        """A provisional threshold in milliseconds: 0.5 for what is not there, as the scene's own will be."""
        judge = self._judge  # none until `warm_up` has read its reference phrases
        if judge is not None and judge.classify(torch.from_numpy(scores)) == "no":
            return BORDER
        return quick_threshold(scores, self._opacities)

    def _free_color(self) -> tuple[int, int, int]:
        used = {question.layer.color for question in self.questions[-(MAX_QUESTIONS - 1) :]}
        return next(color for color in PROMPT_COLORS if color not in used)

    # -- clicks

    def what_is(self, camera: Camera, x: float, y: float, count: int = 6) -> Answer:
        """What a pixel of a picture shows: phrases of the vocabulary, and a selection that becomes the current one.

        Raises:
            QueryError: If nothing is there.
        """
        scene = self.scene
        hit = surface_at(scene.gaussians, camera, x, y)
        selection = select_hit(hit, scene.gaussians, scene.field, scene.cameras, world=scene.world)
        shares = hit.weights.float() / hit.weights.sum().clamp_min(1e-12)
        blended = shares @ scene.field.select(hit.indices).code_probabilities()
        vocabulary = self.memory.vocabulary
        with self._encoding:
            words, negatives = scene.embed(vocabulary), scene.embed(list(scene.query.negatives))
        asked = TextQuestion(words, negatives, scene.query)
        relevancy = probability_relevancy(blended[None], scene.field.codebook.clip, asked)[0]
        order = relevancy.argsort(descending=True)[:count].tolist()
        phrases = [(vocabulary[i], float(relevancy[i])) for i in order]
        scores = selection.scores.float().cpu().numpy()
        layer = Layer(
            "what was clicked",
            scores,
            float(selection.threshold),
            CLICKED_COLOR,
            selection.mask.cpu().numpy(),
        )
        self.clicked = Question(layer, automatic=float(selection.threshold), selection=selection)
        self.current, self.mode = self.clicked, "relevancy"
        return Answer(phrases, selection, hit.point)

    # -- pictures

    def colors(self, eye: NDArray | None = None) -> NDArray[np.uint8]:
        """A color for every Gaussian ``[N, 3]`` as things stand; ``eye`` is the camera, for depth."""
        layers = [question.layer for question in self.all_questions()]
        return self.coloring.colors(self.mode, layers, opacity=self.opacity, fade=self.fade, eye=eye)

    @property
    def selection(self) -> Selection | None:
        """The Gaussians of the current question, once they are known."""
        return self.current.selection if self.current else None

    def best_views(self, selection: Selection, count: int = 3) -> list[tuple[str, float]]:
        """The views that show most of a selection, with the share of the picture it takes; best first."""
        if not selection:
            return []
        names = list(self.scene.views)
        tried = _CANDIDATE_VIEWS if len(self.scene.gaussians) < _MANY_GAUSSIANS else _CANDIDATE_VIEWS // 4
        names = names[:: max(1, -(-len(names) // tried))]
        if selection.best_view and selection.best_view not in names:
            names.append(selection.best_view)
        mask = selection.mask.float()[:, None]
        shares = []
        for name in names:
            camera = self.scene.views[name].camera
            small = camera.downscaled(max(1.0, max(camera.width, camera.height) / 96))
            with torch.no_grad():
                drawn = render(self.scene.gaussians, small, features=mask, color=False).features
            shares.append((name, float(drawn.mean())))
        shares.sort(key=lambda entry: -entry[1])
        return [entry for entry in shares[:count] if entry[1] > 0]

    def thumbnail(self, name: str, selection: Selection, long_side: int = 280) -> NDArray[np.uint8]:
        """A view with the selection tinted, the rest dimmed ``[h, w, 3]``."""
        camera = self.scene.view(name).camera
        small = camera.downscaled(max(1.0, max(camera.width, camera.height) / long_side))
        with torch.no_grad():
            drawn = render(self.scene.gaussians, small, features=selection.mask.float()[:, None])
        picture = (drawn.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return overlay_mask(picture, drawn.features[..., 0].cpu().numpy() > 0.5)

    # -- files

    def export(self, selection: Selection, ending: str = ".ply") -> tuple[str, bytes]:
        """A name and the content of a file with the selection alone.

        Args:
            selection: What to write.
            ending: One of `EXPORT_ENDINGS`.

        Raises:
            ValueError: If the ending is another one.
            QueryError: If nothing is selected.
            BackendError: If the format needs a library that is not installed.
        """
        if ending not in EXPORT_ENDINGS:
            raise ValueError(f"ending must be one of {', '.join(EXPORT_ENDINGS)}, got {ending!r}")
        if not selection:
            raise QueryError("selection", expected="something selected", found="nothing")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"selection{ending}"
            export_gaussians(selection.selected, path, world=self.scene.world)
            return f"{file_name(selection.phrase)}{ending}", path.read_bytes()


def is_plain(phrase: str) -> bool:
    """Whether a phrase is a thing by itself; "something to sit on" is one, whatever it ends in.

    Phrases with parts, articles or counts ("how many mugs") are for `lexsplat.queries.phrases`.
    """
    try:
        return parse(phrase) == Thing(phrase)
    except QueryError:
        return True
