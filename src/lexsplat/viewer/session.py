"""State of the viewer without a browser: prompts, clicks, selections.

`Session.ask` and `Session.colors` take milliseconds. `Session.refine` renders views to find the automatic threshold
and takes longer, so the page shows provisional colors first.
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
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.grammar import parse
from lexsplat.queries.heatmaps import overlay_mask
from lexsplat.queries.phrases import Thing
from lexsplat.queries.picking import select_hit, surface_at
from lexsplat.queries.presence import PresenceClassifier
from lexsplat.queries.relevancy import check_prompts, probability_relevancy
from lexsplat.queries.selection import Selection
from lexsplat.queries.thresholds import BORDER
from lexsplat.rendering import render
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.answers import file_name
from lexsplat.scenes.exporting import export_gaussians
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.coloring import PROMPT_COLORS, Coloring, Layer, Mode, quick_threshold
from lexsplat.viewer.history import History
from lexsplat.viewer.vocabulary import MAX_LENGTH

MAX_QUESTIONS = len(PROMPT_COLORS)
CLICKED_COLOR = (0, 168, 150)
EXPORT_ENDINGS = (".ply", ".glb", ".splat", ".spz", ".points.ply")


@dataclass(eq=False)  # compared by identity: the same prompt can be removed and asked again
class Question:
    """A prompt on the page, and its answer.

    Args:
        layer: How it is drawn.
        automatic: The automatic threshold; None until `Session.refine`.
        manual: The threshold set by the user, if any.
        selection: The Gaussians that answer it; None until `Session.refine`.
        understood: How it was parsed, for phrases that are more than a thing; "" until `Session.refine`.
    """

    layer: Layer
    automatic: float | None = None
    manual: float | None = None
    selection: Selection | None = None
    understood: str = ""

    @property
    def text(self) -> str:
        """The prompt."""
        return self.layer.text


@dataclass(frozen=True)
class ClickAnswer:
    """The answer to a click.

    Args:
        phrases: The most relevant phrases of the vocabulary with their relevancy in 0..1, best first.
        selection: The clicked surface and the Gaussians that belong to it.
        point: Where the click hit ``[3]``, world units.
    """

    phrases: list[tuple[str, float]]
    selection: Selection
    point: NDArray[np.float64]


class Session:
    """State of one viewer, shared by all open pages.

    Args:
        scene: The scene.
        history: Earlier prompts and the vocabulary; None starts empty and stores nothing.
    """

    def __init__(self, scene: Scene, history: History | None = None) -> None:
        self.scene, self.history = scene, history or History()
        self.coloring = Coloring(scene.gaussians, scene.field)
        self.mode: Mode = "photo"
        self.opacity, self.fade = 0.9, 0.0
        self.questions: list[Question] = []
        self.clicked: Question | None = None
        self.current: Question | None = None
        self._encoding = threading.Lock()
        self._presence: PresenceClassifier | None = None
        self._opacities = scene.gaussians.opacities.detach().cpu().numpy()

    def warm_up(self) -> None:
        """Load the text encoder and embed the vocabulary, so that the first answers are fast.

        Raises:
            ModelError: If the encoder cannot be loaded.
        """
        with self._encoding:
            self.scene.preload()
        for phrase in [*self.scene.query.compared, *self.history.vocabulary, *everyday_words()]:
            with self._encoding:  # one phrase at a time, so that a prompt waits for one phrase at most
                self.scene.embed([phrase])
        self._presence = self.scene.presence_classifier

    # -- prompts

    def ask(self, text: str) -> Question:
        """Show a prompt with a provisional threshold; it becomes the current one.

        The oldest prompt is dropped when `MAX_QUESTIONS` are shown.

        Raises:
            QueryError: If the prompt is empty or longer than `MAX_LENGTH`.
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
            layer = Layer(text, scores, self._provisional_threshold(text, scores), self._free_color())
            question = Question(layer)
            self.questions = [*self.questions[-(MAX_QUESTIONS - 1) :], question]
        self.current, self.mode = question, "relevancy"
        return question

    def find(self, text: str) -> Question | None:
        """The question with this text, if it is shown."""
        return next((question for question in self.all_questions() if question.text == text), None)

    def all_questions(self) -> list[Question]:
        """Everything that is drawn: the prompts, then the clicked object."""
        return [*self.questions, *([self.clicked] if self.clicked else [])]

    def refine(self, question: Question, viewpoint: Camera | None = None) -> None:
        """Compute the final answer to a prompt: its automatic threshold and the Gaussians it selects.

        Args:
            question: The prompt.
            viewpoint: The camera that defines left and right in phrases with relations; None takes the view that
                shows the reference object best.
        """
        # The selection of a plain prompt stays valid until `set_threshold` clears it.
        if question is self.clicked or (question.selection is not None and is_plain(question.text)):
            return
        manual = question.manual
        selection = answer_prompt(self.scene, question.text, manual, viewpoint)
        if manual is None:
            question.automatic = float(selection.threshold)
        if manual == question.manual:  # otherwise the user has moved the slider in the meantime
            question.selection = selection
            question.understood = understood_as(self.scene, question.text)
            question.layer.set_scores(selection.scores.float().cpu().numpy())
            question.layer.threshold = float(selection.threshold)
            question.layer.mask = selection.mask.cpu().numpy()

    def set_threshold(self, question: Question, value: float | None) -> None:
        """Set a threshold by hand, or None for the automatic one. Colors follow at once, the selection on `refine`.

        Raises:
            ValueError: If the threshold is not in 0..1.
        """
        if value is not None and not 0 <= value <= 1:
            raise ValueError(f"threshold must be in 0..1, got {value}")
        question.manual, question.selection, question.layer.mask = value, None, None
        if value is not None:
            question.layer.threshold = value
        elif question.automatic is not None:
            question.layer.threshold = question.automatic
        else:
            question.layer.threshold = self._provisional_threshold(question.layer.text, question.layer.scores)

    def remove(self, question: Question) -> None:
        """Remove a prompt; the latest remaining one becomes the current one."""
        self.questions = [other for other in self.questions if other is not question]
        if question is self.clicked:
            self.clicked = None
        if question is self.current:
            shown = self.all_questions()
            self.current = shown[-1] if shown else None

    def _provisional_threshold(self, text: str, scores: NDArray[np.float32]) -> float:
        """A threshold in milliseconds. It is 0.5 for an absent object, as the automatic one will be."""
        if self._presence is not None:  # None until `warm_up` has encoded the everyday words
            (present,) = self._presence.classify(self.scene.embed([text]), torch.from_numpy(scores)[None])
            if present == "no":
                return BORDER
        return quick_threshold(scores, self._opacities)

    def _free_color(self) -> tuple[int, int, int]:
        used = {question.layer.color for question in self.questions[-(MAX_QUESTIONS - 1) :]}
        return next(color for color in PROMPT_COLORS if color not in used)

    # -- clicks

    def what_is(self, camera: Camera, x: float, y: float, count: int = 6) -> ClickAnswer:
        """Name and select the surface at a pixel; the selection becomes the current one.

        Args:
            camera: The camera of the page.
            x: Column in pixels.
            y: Row in pixels.
            count: Maximum number of phrases.

        Raises:
            QueryError: If there is no surface at the pixel.
        """
        scene = self.scene
        hit = surface_at(scene.gaussians, camera, x, y)
        selection = select_hit(hit, scene.gaussians, scene.field, scene.cameras, world=scene.world)
        shares = hit.weights.float() / hit.weights.sum().clamp_min(1e-12)
        probabilities = shares @ scene.field.select(hit.indices).code_probabilities()
        vocabulary = self.history.vocabulary
        with self._encoding:
            asked = scene.question(vocabulary)
        relevancy = probability_relevancy(probabilities[None], scene.field.codebook.clip, asked)[0]
        order = relevancy.argsort(descending=True)[:count].tolist()
        phrases = [(vocabulary[i], float(relevancy[i])) for i in order]
        threshold = float(selection.threshold)
        layer = Layer(
            "clicked object",
            selection.scores.float().cpu().numpy(),
            threshold,
            CLICKED_COLOR,
            selection.mask.cpu().numpy(),
        )
        self.clicked = Question(layer, automatic=threshold, selection=selection)
        self.current, self.mode = self.clicked, "relevancy"
        return ClickAnswer(phrases, selection, hit.point)

    # -- images

    def colors(self, eye: NDArray | None = None) -> NDArray[np.uint8]:
        """The color of every Gaussian ``[N, 3]`` in the current state; ``eye`` is the camera position, for depth."""
        layers = [question.layer for question in self.all_questions()]
        return self.coloring.colors(self.mode, layers, opacity=self.opacity, fade=self.fade, eye=eye)

    @property
    def selection(self) -> Selection | None:
        """The selection of the current question; None until `refine`."""
        return self.current.selection if self.current else None

    def thumbnail(self, name: str, selection: Selection) -> NDArray[np.uint8]:
        """A view ``[h, w, 3]`` with the selection tinted and the rest dimmed."""
        camera = self.scene.view(name).camera
        small = camera.downscaled(max(1.0, max(camera.width, camera.height) / 280))
        with torch.no_grad():
            drawn = render(self.scene.gaussians, small, features=selection.mask.float()[:, None])
        image = (drawn.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return overlay_mask(image, drawn.features[..., 0].cpu().numpy() > 0.5)

    # -- files

    def export(self, selection: Selection, ending: str = ".ply") -> tuple[str, bytes]:
        """File name and content of an export of the selected Gaussians.

        Raises:
            ValueError: If the ending is not one of them.
            QueryError: If the selection is empty.
            BackendError: If the format needs a library that is not installed.
        """
        if ending not in EXPORT_ENDINGS:
            raise ValueError(f"ending must be one of {', '.join(EXPORT_ENDINGS)}, got {ending!r}")
        if not selection:
            raise QueryError("selection", expected="at least one Gaussian", found="none")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"selection{ending}"
            export_gaussians(selection.selected, path, world=self.scene.world)
            return f"{file_name(selection.phrase)}{ending}", path.read_bytes()


def answer_prompt(
    scene: Scene, prompt: str, threshold: float | None = None, viewpoint: Camera | None = None
) -> Selection:
    """The scene's answer to a prompt: scores, threshold, presence and selection.

    All final answers of the viewer come from here. Phrases with relations are answered by `Scene.find`.
    """
    if is_plain(prompt) and scene.understand(prompt).phrase == Thing(prompt):
        return scene.select(prompt, threshold)
    return replace(scene.find(prompt, viewpoint, threshold=threshold), phrase=prompt)


def understood_as(scene: Scene, prompt: str) -> str:
    """How a prompt was parsed, and what was not understood; "" for one thing in its own words."""
    understood = scene.understand(prompt)
    if is_plain(prompt) and not understood.note:
        return ""
    return "; ".join(filter(None, [f"understood as {understood.phrase}", understood.note]))


def is_plain(phrase: str) -> bool:
    """Whether a phrase names one thing, such as "mug" or "something to sit on".

    Phrases with relations, articles or counts ("how many mugs") are parsed by `lexsplat.queries.phrases`.
    """
    try:
        return parse(phrase) == Thing(phrase)
    except QueryError:
        return True
