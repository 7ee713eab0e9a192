"""What one prompt selects, where the objects of the scene know more than its relevancy.

A kind such as "toy" is its members (`lexsplat.queries.kinds`), a part is cut within its thing
(`lexsplat.queries.parts`), a thing in a color has that color in its pixels (`lexsplat.queries.colors`), and a name is
all of the object that is listed under it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lexsplat.queries.colors import color_told, colors_expected, is_qualified, may_be
from lexsplat.queries.kinds import is_kind, is_of_kind
from lexsplat.queries.part_names import DOUBTFUL, is_doubtful
from lexsplat.queries.parts import FEWEST, ThingGraph, part_scores, with_parts
from lexsplat.queries.presence import FAINT
from lexsplat.queries.relevancy import gaussian_relevancy
from lexsplat.queries.scoring import form_used, scores_in_form
from lexsplat.queries.selection import Presence, Selection, union
from lexsplat.queries.thresholds import BORDER
from lexsplat.queries.vocabulary import (
    CARRIERS,
    STUFF,
    SURFACES,
    is_part,
    is_part_alone,
    part_named,
    thing_of_part,
)
from lexsplat.runtime.device import threads_for_kernels
from lexsplat.runtime.fingerprints import digest
from lexsplat.scenes.gone import gone_nouns, noun_of, nouns_of
from lexsplat.scenes.listed import doubt, holding, listed_as, listed_under
from lexsplat.scenes.pixels import object_colors, seen_colors

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


MEMBER = 0.9
"""Score of an object that is the answer, where language has less: at the border itself, masks stay empty."""
_PIECE = 0.3
"""Share of an object of its name from which a word is that object."""
_MOSTLY = 0.7
"""Share of what views show of an object of its noun from which a phrase with a color or another quality is it."""
_PER_THREAD = 100_000
"""Gaussians for each thread of torch: with fewer, waiting for each other costs more than it saves."""
KEPT_GRAPHS, _KEPT_GRAPH = 16, 20_000
"""Graphs of things that are kept, and Gaussians of the largest of them: a graph takes about 200 bytes for each."""


@dataclass(eq=False)
class Word:
    """Cached answers to one prompt.

    Args:
        scores: Relevancy of every Gaussian ``[N]`` in 0..1, in the form of the query.
        own: The same for each Gaussian by itself ``[N]``.
        presence: Whether the scene holds it, as if its words were known.
        threshold: The automatic threshold; None until it is asked for.
        selection: The selection of that threshold; None until it is asked for.
        note: A remark on how it is answered; "" if there is none.
        members: The objects that are the answer, where objects are; each is an instance.
        asked: The words that are asked for in place of the prompt; "" where it is asked for itself.
    """

    scores: Tensor
    own: Tensor
    presence: Presence
    threshold: float | None = None
    selection: Selection | None = None
    note: str = ""
    members: tuple[Selection, ...] = ()
    asked: str = ""


def new_words(scene: Scene, prompts: list[str]) -> Iterator[Word]:
    """Scores and presence of prompts that were not asked before, each when the former ones are known."""
    with _few_threads(scene):
        question = scene.question(prompts)
        scores = gaussian_relevancy(scene.field, question)
        presences = scene.presence_classifier.classify(prompts, question.positives, scores)
        formed = scores_in_form(scene.field, scene.query, scores, presences)
    # Copies: a row would keep the scores of all prompts asked with it.
    words = [Word(row.clone(), own.clone(), here) for row, own, here in zip(formed, scores, presences)]
    return (with_objects(scene, prompt, word) for prompt, word in zip(prompts, words))


def with_objects(scene: Scene, prompt: str, word: Word) -> Word:
    """The answer to a prompt, given its relevancy and its presence by language."""
    if word.presence != "no" and (noun := noun_of(prompt)) in gone_nouns(scene):
        return replace(word, scores=word.own, presence="no", note=f"an edit took the {noun} away")
    with _few_threads(scene):
        word = of_qualities(scene, prompt, of_part(scene, prompt, of_kind(scene, prompt, word)))
        word = completed(scene, prompt, word)
        return noted(scene, prompt, _if_visible(scene, word))


def _few_threads(scene: Scene) -> AbstractContextManager[None]:
    return threads_for_kernels(len(scene.gaussians) // _PER_THREAD)


def noted(scene: Scene, prompt: str, word: Word) -> Word:
    """A word that is "unsure" with a note on what it takes, if that is listed as something else."""
    if word.presence != "unsure" or word.note or form_used(scene.field, scene.query) != "segment":
        return word
    return replace(word, note=doubt(scene, prompt, (word.scores >= BORDER) & ~scene.hidden))


def _if_visible(scene: Scene, word: Word) -> Word:
    """The word, or "no" where what is selected is too faint to be seen, such as what remains of a deleted thing."""
    if word.presence == "no" or form_used(scene.field, scene.query) != "segment":
        return word
    taken = (word.scores >= BORDER) & ~scene.hidden
    faint = bool(taken.any()) and float(scene.gaussians.opacity_logits[taken].sigmoid().mean()) < FAINT
    return replace(word, presence="no") if faint else word


def of_kind(scene: Scene, prompt: str, word: Word) -> Word:
    """The word as it is, or with the objects of its kind ("toy") if the scene has any (`lexsplat.queries.kinds`)."""
    return _of_members(word, members_of_kind(scene, prompt))


def members_of_kind(scene: Scene, prompt: str) -> list[Selection]:
    """The objects of the kind that a prompt names; none where it names no kind."""
    if scene.query.fixed or not is_kind(prompt):
        return []
    return [each for each in scene.objects if is_of_kind(each.phrase, prompt)]


def completed(scene: Scene, prompt: str, word: Word) -> Word:
    """The word with all of each object of its name of which it takes at least `_PIECE`.

    The widest gap between the scores of segments may lie within a thing of many looks, such as a stack of books. The
    list of objects knows its other segments by name: no other word describes them better. So it knows what the word
    takes too much: a little of other things, a green bowl beside a green apple, and what is no object at all.
    """
    if word.presence != "yes" or word.members or form_used(scene.field, scene.query) != "segment":
        return word
    if scene.query.fixed or is_part(prompt) or is_part_alone(prompt):
        return word
    taken, named = (word.scores >= BORDER) & ~scene.hidden, listed_under(scene, noun_of(prompt))
    if is_qualified(prompt):  # a yellow book is not the stack, but a gold ring is the ring
        named = [each for each in named if each.phrase == prompt.lower() or _is_mostly(scene, each, taken)]
    found = [
        each
        for each in named
        if each.phrase not in STUFF and int(taken[each.indices].sum()) >= _PIECE * len(each)
    ]
    if not found:
        return word
    whole = union(taken, found)
    noun = noun_of(prompt)
    left = union(
        taken, [each for each in scene.objects if each not in named and _is_too_much(each, taken, noun)]
    )
    if not any(each.phrase in SURFACES for each in found):  # a table is listed without what few views show
        left |= ~_listed(scene)
    scores = torch.where(whole & ~taken, word.scores.clamp(min=MEMBER), word.scores)
    scores = torch.where(left & taken & ~whole, scores.clamp(max=BORDER - 1e-4), scores)
    return replace(word, scores=scores)


def _is_mostly(scene: Scene, thing: Selection, taken: Tensor) -> bool:
    """Whether a word takes nearly all that views show of a thing: a green bottle has a cork, too."""
    segments = scene.field.segments
    weights = thing.gaussians.opacities if segments is None else segments.masses
    shown = weights[thing.indices]
    return float((shown * taken[thing.indices]).sum()) >= _MOSTLY * float(shown.sum())


def _is_too_much(other: Selection, taken: Tensor, noun: str) -> bool:
    """Whether a word takes what it should not of another thing.

    That is a little of it, such as the upper edge of the books before a lamp, or much of what its noun is no likely
    name of.
    """
    count = int(taken[other.indices].sum())
    if count >= _PIECE * len(other):
        return other.phrase not in SURFACES and noun not in likely_nouns(other)
    return count > 0 and (other.phrase not in SURFACES or other.phrase in CARRIERS)


def _listed(scene: Scene) -> Tensor:
    """The Gaussians ``[N]`` bool of any listed object."""
    known: dict[str, Tensor] = scene.__dict__
    if "_listed" not in known:
        known["_listed"] = union(scene.hidden, scene.objects)
    return known["_listed"]


def likely_nouns(thing: Selection) -> set[str]:
    """The nouns of the likeliest names of an object."""
    return {noun for name in (thing.phrase, *(name for name, _ in thing.names)) for noun in nouns_of(name)}


def of_part(scene: Scene, prompt: str, word: Word) -> Word:
    """The word as it is, or cut within its thing if it names a part of one (`lexsplat.queries.parts`)."""
    segments = scene.field.segments
    if word.presence == "no" or form_used(scene.field, scene.query) != "segment" or not segments:
        return word
    taken = (word.scores >= BORDER) & ~scene.hidden
    if is_part_alone(prompt):
        return _of_objects(scene, prompt, word, taken)
    name = thing_of_part(prompt)
    if not name:
        return word
    thing = _thing_named(scene, name)
    if thing is None:
        return word
    thing = with_parts(thing, taken, scene.gaussians, segments.labels)
    scores = part_scores(word.own, _graph_of(scene, thing, segments.masses))
    word = word if scores is None else replace(word, scores=scores)
    return replace(word, presence="unsure", note=DOUBTFUL) if _is_doubtful(scene, prompt, word) else word


def _thing_named(scene: Scene, name: str) -> Tensor | None:
    """The Gaussians that the name of a thing selects ``[N]`` bool; None if they have no parts that can be cut."""
    found = scene.ask(name, checked=True)
    thing = found.chosen(0)
    return None if found.presences[0] == "no" or int(thing.sum()) < FEWEST else thing


def things_with_parts(scene: Scene) -> list[str]:
    """Names of the objects whose graphs are kept together: as many as fit, the largest first, and no surfaces."""
    if not scene.field.segments or form_used(scene.field, scene.query) != "segment":
        return []
    return [each.phrase for each in scene.objects if each.phrase not in SURFACES][:KEPT_GRAPHS]


def prepare_parts(scene: Scene, name: str) -> None:
    """Make the graph of a thing, so that the first question about a part of it is answered as soon as the next."""
    thing, segments = _thing_named(scene, name), scene.field.segments
    if segments and thing is not None and int(thing.sum()) <= _KEPT_GRAPH:
        _graph_of(scene, thing, segments.masses)


def _graph_of(scene: Scene, thing: Tensor, masses: Tensor) -> ThingGraph:
    """The graph of a thing; kept, for its other parts, unless it is as large as a room."""
    if int(thing.sum()) > _KEPT_GRAPH:
        return ThingGraph.of(thing, scene.gaussians, masses)
    key = digest([np.packbits(thing.cpu().numpy()).tobytes()])
    return scene.graphs.get_or_make(key, lambda: ThingGraph.of(thing, scene.gaussians, masses))


def _is_doubtful(scene: Scene, prompt: str, word: Word) -> bool:
    """Whether another name of a part describes what is taken better (`lexsplat.queries.part_names`)."""
    segments, taken = scene.field.segments, ((word.scores >= BORDER) & ~scene.hidden).nonzero()[:, 0]
    if word.presence != "yes" or segments is None or not len(taken):
        return False
    shown = segments.masses[taken]
    sums = torch.from_numpy(scene.field.select(taken).sums(torch.zeros_like(taken), shown, 1)[0]).float()
    place = sums.to(shown) / shown.sum().clamp_min(1e-12)
    return is_doubtful(part_named(prompt), place, scene.presence_classifier.part_fits)


def of_qualities(scene: Scene, prompt: str, word: Word) -> Word:
    """The word as pixels and names have it, if its prompt tells a color or another quality of a thing.

    Encoders take a thing for the same thing in another color, or another thing for it: a banana for a yellow apple,
    in a scene with a red one. Such a word is "unsure". They also keep the color that a thing had before it was
    recolored, also that of a metal: a blue ring is no "gold ring". An object that the prompt without its color names,
    and whose pixels have mostly the color, is the answer, whatever they say.
    """
    told, expected = color_told(prompt), colors_expected(prompt)
    if not is_qualified(prompt) or form_used(scene.field, scene.query) != "segment":
        return word
    if not scene.field.segments:
        return word
    if word.presence == "yes":
        taken = (word.scores >= BORDER) & ~scene.hidden
        held, name = holding(scene, taken), prompt.lower().split()[-1]
        other = held and name in _last_words(scene.objects) - _last_words(held)
        if not other and (not expected or not held or _is_seen_in(scene, held, expected, taken)):
            return word
        word = replace(word, presence="unsure")
    return _of_members(word, of_color_told(scene, prompt, told)) if told else word


def of_color_told(scene: Scene, prompt: str, told: set[str]) -> list[Selection]:
    """The objects that a prompt names without its color, and whose pixels have mostly the color that it tells."""
    named = [] if is_part(prompt) else listed_as(scene, prompt)
    return [each for each in named if object_colors(scene, each)[0] in told]


def _is_seen_in(scene: Scene, things: Sequence[Selection], expected: set[str], taken: Tensor) -> bool:
    """Whether things are seen in a color or a near one, and not only a part of them: a bear with a light belly."""
    if not may_be(expected, {color for each in things for color in seen_colors(scene, each)}):
        return False
    return any(
        2 * int(taken[each.indices].sum()) > len(each) or expected & set(object_colors(scene, each))
        for each in things
    )


def _of_members(word: Word, members: Sequence[Selection]) -> Word:
    """A word that is answered by objects; as it is if there are none."""
    if not members:
        return word
    taken = torch.stack([each.mask for each in members]).any(0)
    # Members exceed the border, and all others stay below it.
    inside, outside = word.scores.clamp(min=MEMBER), word.scores.clamp(max=BORDER - 1e-4)
    return replace(word, scores=torch.where(taken, inside, outside), presence="yes", members=tuple(members))


def _last_words(things: Sequence[Selection]) -> set[str]:
    return {each.phrase.split()[-1] for each in things}


def _of_objects(scene: Scene, part: str, word: Word, taken: Tensor) -> Word:
    """A part without its thing as that part of each object that has much of what its name selects: "mug handle"."""
    held, part = holding(scene, taken), part.split()[-1]  # without its article
    things = [each for each in held if each.phrase not in SURFACES]
    found = {}
    for name in dict.fromkeys(each.phrase for each in things or held if each.phrase not in STUFF):
        answers = scene.ask(f"{name} {part}", checked=True)
        chosen = answers.chosen(0)
        # Where the two disagree about the place, the word by itself is as likely to be right.
        if answers.presences[0] != "no" and 2 * int((chosen & taken).sum()) > int(chosen.sum()):
            found[name] = answers.words[0]
    certain = {name: each for name, each in found.items() if each.presence == "yes"}
    found, presence = (certain, word.presence) if certain else (found, "unsure")
    if not found:
        return word
    scores, own = (torch.stack(rows).amax(0) for rows in zip(*((w.scores, w.own) for w in found.values())))
    note = f"the {part} of the {' and the '.join(found)}"
    return replace(word, scores=scores, own=own, presence=presence, note=note)
