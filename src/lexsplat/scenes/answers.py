"""Answers to prompts: in Python, as plain data for JSON, and as images."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lexsplat.captures import stem_of
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.grammar import understand, undetermined
from lexsplat.queries.heatmaps import overlay_heatmap
from lexsplat.queries.kinds import with_unknown_words
from lexsplat.queries.phrases import Thing, Understood
from lexsplat.queries.relevancy import check_prompts, render_relevancy
from lexsplat.queries.scoring import form_used
from lexsplat.queries.selection import Presence, Selection
from lexsplat.queries.spelling import singular
from lexsplat.queries.thresholds import BORDER, scene_thresholds
from lexsplat.queries.visibility import without_hidden
from lexsplat.queries.vocabulary import STUFF
from lexsplat.rendering.first_drawing import compile_drawing
from lexsplat.runtime.errors import QueryError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.progress import Event
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.unsaved import unsaved_steps
from lexsplat.scenes.words import Word, members_of_kind

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene

MAX_DEFAULT_VIEWS = 6
"""Number of held-out views that a query without ``--view`` renders, at most."""


@dataclass(frozen=True, eq=False, repr=False)
class Answers:
    """Scores, threshold and presence of every prompt in a scene, from `Scene.ask`.

    Args:
        prompts: The prompts, P of them.
        scores: Relevancy of every Gaussian ``[P, N]`` in 0..1.
        thresholds: Smallest score of a selected Gaussian for each prompt ``[P]``.
        presences: Whether the scene holds what each prompt names.
        scene: The scene that was asked.
        automatic: Whether the thresholds come from the scene; False if they were given.
        words: Cached answers to each prompt; () keeps nothing.
    """

    prompts: tuple[str, ...]
    scores: Tensor
    thresholds: Tensor
    presences: tuple[Presence, ...]
    scene: Scene
    automatic: bool = True
    words: tuple[Word, ...] = ()

    def __len__(self) -> int:
        return len(self.prompts)

    def __repr__(self) -> str:
        parts = zip(self.prompts, self.presences, self.thresholds.tolist())
        return f"Answers({', '.join(f'{p!r}: {present} (threshold {t:.3g})' for p, present, t in parts)})"

    def selection(self, index: int) -> Selection:
        """The Gaussians that match a prompt, without specks.

        With an automatic threshold, instances that score far worse than the best one are left out as well
        (`Selection.convincing`).

        Raises:
            QueryError: If there is no prompt of this number.
        """
        if type(index) is not int or not -len(self) <= index < len(self):
            raise QueryError("answer", expected=f"a number from 0 to {len(self) - 1}", found=repr(index)[:40])
        if not self.words:
            return self._selection(index)
        word, present = self.words[index], self.presences[index]
        if word.selection is None:  # an empty one is kept as well
            word.selection = self._selection(index)
        made = word.selection
        return made if made.present == present else made.described(present=present)

    @property
    def asked(self) -> tuple[str, ...]:
        """The words that each prompt is asked for in: its own, or its singular where only that is here."""
        words = self.words or (None,) * len(self)
        return tuple((word and word.asked) or prompt for prompt, word in zip(self.prompts, words))

    def note(self, index: int) -> str:
        """How a prompt is answered, if as something else: "the handle of the mug"."""
        return self.words[index].note if self.words else ""

    def chosen(self, index: int) -> Tensor:
        """The Gaussians ``[N]`` bool that reach the threshold of a prompt and can be seen."""
        return (self.scores[index] >= self.thresholds[index]) & ~self.scene.hidden

    def _selection(self, index: int) -> Selection:
        scores = self.words[index].scores if self.words else self.scores[index]
        threshold = float(self.thresholds[index])
        phrase, present = self.asked[index], self.presences[index]
        selection = self.scene.selection(
            scores >= threshold, scores, threshold=threshold, present=present, phrase=phrase
        )
        if self.words and self.words[index].note:
            selection = replace(selection, note=self.words[index].note)
        if phrase.lower().split()[-1] in STUFF:
            seen = replace(selection, mask=self.chosen(index))
            return replace(seen, parts=(seen,)) if seen else seen
        known = self.words[index].members if self.words else members_of_kind(self.scene, phrase)
        if present == "yes" and known:
            members = (each.within(selection.mask) for each in known)
            return replace(selection, parts=tuple(each.described(scores=scores) for each in members if each))
        selection = selection.without_specks()
        if self.automatic:
            selection = selection.convincing(self.words[index].own if self.words else None)
        shown = without_hidden(selection, self.scene.hidden)
        unseen = selection and not shown and present != "no"
        return replace(shown, note="no photo shows what fits") if unseen else shown

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: ``{"answers": [...]}``, each as `Selection.to_dict`."""
        return {"answers": [self.selection(index).to_dict() for index in range(len(self))]}


def automatic_thresholds(scene: Scene, words: Mapping[str, Word]) -> list[float]:
    """The automatic threshold of each word, from one rendering of the training views.

    Relative to everyday words and by segments, a score of 0.5 is the border itself.
    """
    query = scene.query
    if query.fixed or query.everyday or form_used(scene.field, query) == "segment":
        return [query.threshold if query.fixed else BORDER] * len(words)
    question = scene.question(list(words))
    training = [view.camera for view in scene.views.values() if view.split == "train"]
    return scene_thresholds(
        lambda camera: render_relevancy(scene.field, scene.gaussians, camera, question),
        training or list(scene.cameras.values()),
        [word.presence for word in words.values()],
    ).tolist()


def answer_queries(
    scene: Scene,
    prompts: str | Sequence[str],
    views: Sequence[str],
    threshold: float | None,
    folder: Path | None,
) -> dict[str, Any]:
    """Answer prompts in views, and write a heatmap and a mask for each pair.

    Args:
        scene: The scene to ask.
        prompts: Free-text prompts.
        views: Names of views; none means up to `MAX_DEFAULT_VIEWS` held-out views.
        threshold: Relevancy threshold of the masks; None derives one for each prompt.
        folder: Folder of ``PROMPT/VIEW.png`` and ``PROMPT/VIEW.mask.png``; None writes no images.

    Returns:
        ``{"scene", "form", "rests_on" (see `rests_on`), "prompts": [...]}``; a prompt has "threshold", "peak",
        "peak_view" (the view with the highest relevancy), "gaussians", "present" (whether the scene holds it: "yes",
        "no" or "unsure"), "note" (how `Scene.find` understands it, if as something else) and "views".

    Raises:
        QueryError: If a prompt is empty, a view is unknown, or the threshold is not in 0..1.
    """
    names = [scene.view(name).name for name in views] or default_views(scene)
    found = scene.ask(prompts, threshold)
    compile_drawing(scene.gaussians.device, scene.listener)
    thresholds = found.thresholds.tolist()
    answers: list[dict[str, Any]] = [
        {
            "prompt": prompt,
            "threshold": round(limit, 4),
            "peak": 0.0,
            "peak_view": names[0],
            "gaussians": len(found.selection(number)),
            "present": present,
            "note": "; ".join(filter(None, (in_own_words(asked, scene.clip).note, found.note(number)))),
            "views": {},
        }
        for number, (prompt, asked, limit, present) in enumerate(
            zip(found.prompts, found.asked, thresholds, found.presences)
        )
    ]
    for done, name in enumerate(names):
        scene.listener(Event("views", done, len(names)))
        image = (scene.render(name).image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        relevancy = scene.relevancy(found.prompts, name).cpu().numpy()
        for answer, limit, values in zip(answers, thresholds, relevancy):
            answer["views"][name] = _write_images(
                folder and folder / file_name(answer["prompt"]), name, image, values, limit
            )
            if values.max() > answer["peak"]:
                answer["peak"], answer["peak_view"] = float(values.max()), name
    scene.listener(Event("views", len(names), len(names)))
    return {
        "scene": str(scene.folder.root) if scene.folder else None,
        "form": form_used(scene.field, scene.query),
        "rests_on": rests_on(scene),
        "prompts": answers,
    }


@lru_cache(256)
def in_own_words(prompt: str, clip: str) -> Understood:
    """How a prompt is understood that is asked in its own words.

    The note says what to ask in place of a question or a phrase with grammar.
    """
    try:
        parsed = understand(prompt)
    except QueryError:
        return Understood(Thing(prompt))
    parsed = with_unknown_words(parsed, clip)
    if parsed.unknown or str(parsed.phrase).lower() == f'"{singular(undetermined(prompt.strip())).lower()}"':
        return parsed if parsed.unknown else replace(parsed, note="")
    return replace(parsed, note=f"asked in these words; lexsplat find understands {parsed.phrase}")


def rests_on(scene: Scene) -> str:
    """The phrases that relevancy and presence are relative to, in words."""
    words = f"{len(everyday_words()):,} everyday words in this scene"
    return (
        words if scene.query.everyday else f"relevancy: {', '.join(scene.query.compared)}; presence: {words}"
    )


def find_phrases(
    scene: Scene,
    phrases: str | Sequence[str],
    view: str | None = None,
    threshold: float | None = None,
) -> dict[str, Any]:
    """The document of ``lexsplat find --json``: what phrases name, in 3D.

    Args:
        scene: The scene to ask.
        phrases: Free-text phrases, with relations (`lexsplat.queries.phrases`).
        view: Name of the view that "left" and "right" refer to; None takes one for each relation.
        threshold: Smallest score of a selected Gaussian; None derives one for each phrase.

    Returns:
        ``{"scene", "up", "meters_per_unit", "rests_on", "unsaved_steps", "phrases": [...]}``; a phrase has "phrase",
        "understood", "present", "count", "gaussians", "threshold", "best_view" and "instances" with center, size and
        axes in world units, and "size_meters" if the scale is known. If "present" is "no", "count" is 0 and
        "instances" is empty.

    Raises:
        QueryError: If a phrase is empty, the view is unknown, or the threshold is not in 0..1.
    """
    answers = [find_phrase(scene, phrase, view, threshold) for phrase in check_prompts(phrases)]
    return {
        "scene": str(scene.folder.root) if scene.folder else None,
        "rests_on": rests_on(scene),
        **scene.world.to_json(),
        "unsaved_steps": unsaved_steps(scene.folder) if scene.folder else 0,
        "phrases": answers,
    }


def find_phrase(
    scene: Scene, phrase: str, view: str | None = None, threshold: float | None = None
) -> dict[str, Any]:
    """One entry of `find_phrases`."""
    understood = scene.understand(phrase)
    found = scene.find(phrase, view, threshold=threshold)
    if found.present != "no":
        find_best_views(scene, [found, *found.instances])
    return {**found.to_dict(), "phrase": phrase, "understood": str(understood.phrase)}


def find_best_views(scene: Scene, things: Sequence[Selection]) -> None:
    """Find the best view of each thing, unless its scene keeps what its views show; reports stage "views"."""
    if not things or (scene.seen is not None and scene.seen.complete):
        return
    compile_drawing(scene.gaussians.device, scene.listener)
    for done, thing in enumerate(things):
        scene.listener(Event("views", done, len(things)))
        thing.best_view  # noqa: B018 - it is kept
    scene.listener(Event("views", len(things), len(things)))


def default_views(scene: Scene) -> list[str]:
    """The held-out views that a query without views answers in, at most `MAX_DEFAULT_VIEWS`."""
    held_out = [name for name, view in scene.views.items() if view.split == "test"]
    return evenly(held_out or list(scene.views), MAX_DEFAULT_VIEWS)


def _write_images(
    folder: Path | None, name: str, image: np.ndarray, relevancy: np.ndarray, threshold: float
) -> dict[str, Any]:
    mask = relevancy >= threshold
    row, column = np.unravel_index(int(relevancy.argmax()), relevancy.shape)
    answer: dict[str, Any] = {
        "peak": round(float(relevancy.max()), 4),
        "peak_pixel": [int(column), int(row)],
        "mask_share": round(float(mask.mean()), 5),
    }
    if folder is None:
        return answer
    from PIL import Image

    heatmap_path, mask_path = (folder / f"{stem_of(name)}{ending}" for ending in (".png", ".mask.png"))
    for path, pixels in (
        (heatmap_path, overlay_heatmap(image, relevancy)),
        (mask_path, mask.astype(np.uint8) * 255),
    ):
        with atomic_path(path) as temporary:
            Image.fromarray(pixels).save(temporary, format="PNG")
    return {**answer, "heatmap": str(heatmap_path), "mask": str(mask_path)}


def file_name(prompt: str) -> str:
    """A file name of its own for a prompt: its letters and digits, of any alphabet, joined by underscores.

    Where these do not tell the prompt from others, such as "Mug!" from "mug", a hash of the prompt follows.
    """
    name = re.sub(r"\W+", "_", prompt.lower()).strip("_")[:80]
    if name.replace("_", " ") == prompt:
        return name
    own = hashlib.blake2b(prompt.encode("utf-8", "surrogatepass"), digest_size=4).hexdigest()
    return f"{name or 'prompt'}_{own}"
