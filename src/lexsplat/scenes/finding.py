"""`Scene.find`: phrases with relations, answered in a scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.answering import Searched, answer
from lexsplat.queries.grammar import understand
from lexsplat.queries.having import thing_of
from lexsplat.queries.kinds import with_unknown_words, words_of_things
from lexsplat.queries.meaning import in_known_words, known_words
from lexsplat.queries.phrases import Phrase, Thing, Understood, mended_note, things_of, with_things
from lexsplat.queries.selection import Selection
from lexsplat.queries.spelling import spellings
from lexsplat.scenes.pixels import object_colors

if TYPE_CHECKING:
    from lexsplat.scenes.answers import Answers
    from lexsplat.scenes.scene import Scene

_SHORT = 60
"""Letters of a thing that every encoder reads whole; with longer ones it is asked."""


def understood_in(scene: Scene, phrase: str) -> Understood:
    """How a phrase is understood; its typing errors are corrected where the scene holds what is meant.

    Raises:
        QueryError: If a part of the phrase is empty.
    """
    understood = understand(phrase)
    cut = max((_tokens_over(scene, text) for text in things_of(understood.phrase)), default=0)
    if cut:
        cut_off = f"longer than the encoder reads: the last {cut} of its tokens are left out"
        understood = replace(understood, note="; ".join(filter(None, (understood.note, cut_off))))
    if understood.unknown:
        return understood
    vocabulary = words_of_things(scene.clip)
    known = known_words(scene.clip)
    mended: dict[str, str] = {}
    otherwise: list[str] = []

    def mend(thing: Thing) -> Phrase:
        for meant in () if thing.exact else spellings(thing.text, vocabulary):
            if meant != thing.text and scene.ask(meant).presences[0] != "no":
                typed = zip(thing.text.split(), meant.split())
                mended.update({word: right for word, right in typed if word != right})
                return thing_of(meant)
        words = in_known_words(thing, lambda text: scene.ask(text, checked=True).presences[0], known)
        if words not in (thing.text, thing.own):
            otherwise.append(f'"{thing.text}" is asked for as "{words}"')
        return thing if words == thing.text else Thing(words)

    found = with_things(understood.phrase, mend)
    note = "; ".join(filter(None, (understood.note, mended_note(mended), *otherwise)))
    return with_unknown_words(replace(understood, phrase=found, note=note), scene.clip)


def _tokens_over(scene: Scene, text: str) -> int:
    """Number of tokens of a text that the encoder truncates; 0 if its limit is unknown."""
    if len(text) <= _SHORT or scene.given_encode_text is not None:
        return 0
    return int(getattr(scene.preload(), "tokens_over", lambda _: 0)(text))


def find_in(
    scene: Scene, understood: Understood, camera: Camera | None, threshold: float | None
) -> Selection:
    """The selection that a parsed phrase describes.

    Args:
        scene: The scene to ask.
        understood: The phrase.
        camera: Camera that "left" and "me" refer to; None lets the views decide that show both things
            (`lexsplat.queries.viewers`), and takes the camera in the middle of all for "me".
        threshold: See `Scene.select`. With an automatic threshold, an answer "no" has no Gaussians.

    Returns:
        The selection. Its note says what of the phrase was not understood, and which things do not reach a given
        threshold.
    """
    things = things_of(understood.phrase)
    # A phrase is checked as a whole; words in quotation marks have no grammar.
    answers = scene.ask(things, threshold, checked=True) if things else None

    def select(text: str) -> Selection:
        if answers is None or text not in things:
            return scene.ask(text, threshold, checked=True).selection(0)
        return answers.selection(things.index(text))

    def viewer(reference: Selection | None) -> Camera | None:
        return camera or (middle_camera(scene) if reference is None else None)

    searched = Searched(select, viewer, lambda: scene.objects, lambda thing: object_colors(scene, thing))
    found = answer(understood.phrase, searched)
    if found.present == "no" and threshold is None:
        found = replace(found, mask=torch.zeros_like(found.mask), parts=())
    if (present := understood.limit(found.present)) != found.present:
        note = "photos may not show each part" if understood.may_hide and found.present == "no" else ""
        found = found.described(present=present, note="; ".join(filter(None, (found.note, note))))
    low = _too_low(answers, threshold) if answers is not None and threshold is not None else ()
    return found.described(note="; ".join(filter(None, (understood.note, found.note, *low))))


def _too_low(answers: Answers, threshold: float) -> Iterator[str]:
    """A note on each thing in the scene whose scores are all below a threshold."""
    for thing, present, best in zip(answers.prompts, answers.presences, answers.scores.amax(1).tolist()):
        if present != "no" and best < threshold:
            yield f'nothing of "{thing}" reaches the threshold {threshold:g}: the best score is {best:.4f}'


def middle_camera(scene: Scene) -> Camera | None:
    """The camera closest to the middle of all: the viewpoint of "me" in a phrase without a view."""
    cameras = list(scene.cameras.values())
    if not cameras:
        return None
    middle = np.mean([camera.position for camera in cameras], axis=0)
    return min(cameras, key=lambda camera: float(np.linalg.norm(camera.position - middle)))
