"""Everything in a scene: objects with names, colors, places and sizes, as selections and data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lexsplat.queries.objects import (
    WholeSegments,
    likeliest_things,
    name_probabilities,
    pieces_of_others,
    surface_fits_better,
    whole_segments,
    with_surfaces,
)
from lexsplat.queries.pieces import level_with
from lexsplat.queries.presence import FAINT
from lexsplat.queries.relations import same
from lexsplat.queries.relevancy import check_prompts
from lexsplat.queries.selection import SMALLEST_SHARE, Selection
from lexsplat.queries.vocabulary import (
    CARRIERS,
    STUFF,
    SURFACES,
    default_vocabulary,
    gives_way,
    is_divided,
)
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.progress import Event
from lexsplat.scenes.answers import find_best_views, rests_on
from lexsplat.scenes.facts import NO_SEGMENTS
from lexsplat.scenes.pixels import object_colors, shown_weights
from lexsplat.scenes.sheet import write_sheet
from lexsplat.scenes.underfoot import Ground, underfoot

if TYPE_CHECKING:
    from lexsplat.language.segment_codes import SegmentCodes
    from lexsplat.scenes.scene import Scene

MAX_WORDS = 2000
"""Phrases of a vocabulary, at most."""
_MAX_BYTES = 1 << 20
_MAX_LENGTH = 120
_NAMES = 3
_LEAST_PROBABILITY = 0.01
_FEW_NAMES = 20
"""Names below which a banana may well be listed as an "apple"."""
_SEEN = 1.0
"""Pixels of all views from which a Gaussian of a surface tells its height and color."""
_MOST = 0.35
"""Share of a piece that lies apart from its surface, by opacity, which one thing's name must describe; on the second
bundled scene pieces have less than 0.1 or more than 0.5."""
_FAR_BETTER = 0.5
"""Share of the likeliest name's probability below which an object's own name gives way to it."""


def read_vocabulary(path: Path) -> list[str]:
    """The phrases of a text file, one a line, each once; empty lines and lines that start with # are skipped.

    Raises:
        FileFormatError: If the file cannot be read, is not text, is too large or has no phrase.
    """
    remedy = f"give a UTF-8 text file with one name a line, at most {MAX_WORDS:,}"

    def refused(expected: str, found: str) -> FileFormatError:
        return FileFormatError(path, expected=expected, found=found, remedy=remedy)

    try:
        with open(path, "rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        known = {FileNotFoundError: "no such file", IsADirectoryError: "a folder"}
        found = known.get(type(error)) or error.strerror or type(error).__name__
        raise refused("a readable file", found) from error
    if len(content) > _MAX_BYTES:
        raise refused(f"at most {_MAX_BYTES:,} bytes", "more")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise refused("text in UTF-8", f"other bytes at {error.start}") from error
    lines = (" ".join(line.split()) for line in text.splitlines())
    phrases = distinct_names(line for line in lines if line and not line.startswith("#"))
    if not phrases:
        raise refused("at least one name", "none")
    for line in phrases:
        if not line.isprintable():
            raise refused("names of printable characters", repr(line[:30]))
        if len(line) > _MAX_LENGTH:
            found = f"one of {len(line):,}, {line[:20] + '...'!r}"
            raise refused(f"names of at most {_MAX_LENGTH} characters", found)
    if len(phrases) > MAX_WORDS:
        raise refused(f"at most {MAX_WORDS:,} names", f"{len(phrases):,}")
    return phrases


def distinct_names(names: Iterable[str]) -> list[str]:
    """Names without those that differ from an earlier one only by case or by spaces."""
    found: dict[str, str] = {}
    for name in names:
        found.setdefault(" ".join(name.casefold().split()), name)
    return list(found.values())


def objects_of(scene: Scene, vocabulary: Sequence[str] = ()) -> tuple[Selection, ...]:
    """The objects of a scene, those that the views show most of first.

    Args:
        scene: The scene.
        vocabulary: Candidate names of the objects, in any case; () takes the everyday names of
            `lexsplat.queries.vocabulary`.

    The listener of the scene receives events of stage "objects", one for each name.

    Returns:
        Selections that share no Gaussian, each with its name in ``phrase`` and its likeliest names in ``names``.

    Raises:
        QueryError: If a phrase is empty.
    """
    words = distinct_names(check_prompts(list(vocabulary) or default_vocabulary(scene.clip)))
    if scene.field.segments is None:
        return _named_by_words(scene, words)
    classifier, segments, texts = scene.presence_classifier, scene.field.segments, scene.embed(words)
    codes = classifier.segment_codes
    if codes is None:
        return ()
    whole = _whole_segments(scene, words, texts, codes)
    numbers = np.where(whole.places < 0, -1, whole.words[whole.places])
    known = np.unique(numbers[numbers >= 0])
    if len(known) == 0:
        return ()
    surfaces = np.array([words[number] in SURFACES for number in known], bool)
    strengths = classifier.strengths(texts[known], codes.distributions)
    others = pieces_of_others(whole, codes.numbers[0], known, strengths, surfaces)
    likeliest = likeliest_things(codes.numbers[0], known, strengths, surfaces)
    named, pieces, things = (
        torch.from_numpy(each).to(segments.labels)[segments.labels] for each in (numbers, others, likeliest)
    )
    for number in known[surfaces].tolist():
        pieces = with_pieces_apart(scene, named == number, pieces, things)
    found: list[Selection] = []
    renamed: list[bool] = []
    carriers = torch.tensor([number for number in known.tolist() if words[number] in CARRIERS]).to(named)
    # Objects share no Gaussian, so they share scores. Surfaces come last: pieces of things leave them.
    scores, shown = torch.zeros_like(segments.masses), ~scene.hidden
    ground = Ground(scene.gaussians, shown & (segments.masses >= _SEEN), scene.world.up.direction)

    def with_names(thing: Selection) -> Selection:
        return _named(thing, words, classifier.strengths(texts, _mean_codes(scene, thing)[None])[0])

    better = surface_fits_better(codes.numbers[0], strengths, np.isin(known, carriers.cpu()))
    for done, place in enumerate([*np.flatnonzero(~surfaces), *np.flatnonzero(surfaces)]):
        number = int(known[place])
        scene.listener(Event("objects", done, len(known)))
        mask, name = named == number, words[number]
        both = scene.selection(mask | (pieces == number), scores, phrase=name)
        for each in [both] if name in STUFF else _instances(both, mask):
            named[each.indices] = number
            if name not in SURFACES:
                each = _without_surface(each, named, ground, carriers, segments.labels, better[:, place])
            each = each.within(shown)
            if (
                each and float(scene.gaussians.opacities[each.indices].mean()) >= FAINT
            ):  # not what no view shows
                found.append(with_names(each))
                renamed.append(found[-1].phrase != name)
    scene.listener(Event("objects", len(known), len(known)))
    found = with_renamed(found, renamed, with_names)
    return tuple(sorted(found, key=lambda each: -float(segments.masses[each.indices].sum())))


def _whole_segments(
    scene: Scene, words: Sequence[str], texts: torch.Tensor, codes: SegmentCodes
) -> WholeSegments:
    """The segments that are objects, by words with embeddings ``[W, D]``; surfaces have their names."""
    classifier = scene.presence_classifier
    whole = whole_segments(
        codes,
        lambda part: classifier.strengths(texts[part], codes.distributions),
        [gives_way(word) for word in words],
    )
    surfaces = np.flatnonzero([word.lower() in STUFF or is_divided(word) for word in words])
    if not len(surfaces):
        return whole
    strengths = classifier.strengths(texts[surfaces], codes.distributions)
    return with_surfaces(whole, codes.masses, surfaces, strengths)


def with_pieces_apart(
    scene: Scene, surface: torch.Tensor, pieces: torch.Tensor, things: torch.Tensor
) -> torch.Tensor:
    """The pieces of things ``[N]`` with what lies apart from a surface, off its plane, and is most like one thing.

    The neck of a green bottle shows the wall behind it, so that "wall" describes it best. It stands before the wall.

    Args:
        scene: The scene.
        surface: The Gaussians of the surface ``[N]`` bool.
        pieces: The word of the thing that each Gaussian is a piece of ``[N]``, -1 for none.
        things: The word of the thing that each Gaussian is like ``[N]``, -1 for none.
    """
    if not bool((surface & (things >= 0)).any()):
        return pieces
    chosen = scene.selection(surface, scene.gaussians.opacities.detach())
    labels, weights = chosen._clusters()
    like = things[chosen.indices].cpu().numpy()
    opacities = scene.gaussians.opacities[chosen.indices].detach().cpu().double().numpy()
    found = pieces.clone()
    apart = ~level_with(chosen.selected, labels, int(weights.argmax()))
    for label in np.flatnonzero(apart & (weights < SMALLEST_SHARE * weights.max())):
        own = labels == label
        of_things = like[own] >= 0
        shares = np.bincount(like[own][of_things], opacities[own][of_things])
        if len(shares) and shares.max() > _MOST * opacities[own].sum():
            found[chosen.indices[torch.from_numpy(own).to(chosen.indices.device)]] = int(shares.argmax())
    return found


def _without_surface(
    thing: Selection,
    named: torch.Tensor,
    ground: Ground,
    carriers: torch.Tensor,
    labels: torch.Tensor,
    described: NDArray[np.bool_],
) -> Selection:
    """The thing without its segments that are the surface it stands on; they are named as that surface.

    Args:
        thing: The thing.
        named: The word of each Gaussian ``[N]``; changed.
        ground: What may show a surface.
        carriers: Words of the surfaces that carry things.
        labels: The lowest segment of each Gaussian ``[N]``.
        described: Which lowest segments such a surface's word describes clearly better than the thing's ``[S]``.
    """
    surface = ground.around(thing)
    surface = surface[torch.isin(named[surface], carriers)]
    back = underfoot(thing, surface, labels, described)
    if not len(back):
        return thing
    means = thing.gaussians.means.detach()
    _, nearest = cKDTree(means[surface].cpu().numpy()).query(means[back].cpu().numpy())
    named[back] = named[surface[torch.from_numpy(nearest).to(surface.device)]]
    kept = thing.mask.clone()
    kept[back] = False
    return thing.within(kept)


def _instances(both: Selection, mask: torch.Tensor) -> list[Selection]:
    """The instances of a mask ``[N]`` with the pieces that they reach, from those of it and of all pieces."""
    if len(both) == int(mask.sum()):
        return both.instances
    labels, weights = both._clusters()
    own = np.bincount(labels[mask[both.indices].cpu().numpy()], minlength=len(weights)) > 0
    kept = np.flatnonzero(own & (weights >= SMALLEST_SHARE * weights[own].max(initial=0.0)))
    order = kept[np.argsort(-weights[kept], kind="stable")]
    members = torch.from_numpy(labels).to(both.indices.device)
    return [both.part(both.indices[members == int(label)]) for label in order]


def with_renamed(
    things: Sequence[Selection], renamed: Sequence[bool], with_names: Callable[[Selection], Selection]
) -> list[Selection]:
    """The things, where one whose name gave way to that of a thing it is connected to is a part of that thing.

    The edge of a book below a lamp may show more of the lamp than its other parts do, so that it is no part of the
    books until all of it is named.

    Args:
        things: Things that share no Gaussian.
        renamed: Which of them have another name than their segments ``[T]``.
        with_names: Names a thing.
    """
    kept = list(things)
    for part in (thing for thing, changed in zip(things, renamed) if changed):
        for place, whole in enumerate(kept):
            if whole is part or whole.phrase != part.phrase or not _is_connected(part, whole):
                continue
            kept[place] = with_names((whole | part).described(phrase=whole.phrase))
            kept = [thing for thing in kept if thing is not part]
            break
    return kept


def _is_connected(part: Selection, whole: Selection) -> bool:
    """Whether most of a part lies in the cluster that holds most of a whole."""
    both = (whole | part).described(phrase=whole.phrase)
    labels, weights = both._clusters()
    own = part.mask[both.indices].cpu().numpy()
    opacities = both.gaussians.opacities[both.indices].detach().cpu().double().numpy()
    shares = [np.bincount(labels[each], opacities[each], len(weights)) for each in (own, ~own)]
    return bool(shares[0].argmax() == shares[1].argmax())


def codes_of_things(scene: Scene) -> torch.Tensor:
    """The mean codes ``[V, K]`` of the listed objects that are no surfaces."""
    things = [thing for thing in scene.objects if thing.phrase not in SURFACES]
    none = scene.field.codebook.clip.new_zeros(0, len(scene.field.codebook.clip))
    return torch.stack([_mean_codes(scene, thing) for thing in things]) if things else none


def _mean_codes(scene: Scene, thing: Selection) -> torch.Tensor:
    weights, field = shown_weights(scene)[thing.indices], scene.field.select(thing.indices)
    shares = weights / weights.sum().clamp_min(1e-12)
    return torch.from_numpy(field.sums(torch.zeros_like(thing.indices), shares, 1)[0]).to(shares)


def list_document(
    scene: Scene, vocabulary: Sequence[str] = (), picture: Path | None = None
) -> dict[str, Any]:
    """The document of ``lexsplat list --json``.

    Args:
        scene: The scene.
        vocabulary: Candidate names of objects (`objects_of`).
        picture: File of the sheet of thumbnails; None writes none.
    """
    things = scene.objects if not vocabulary else objects_of(scene, vocabulary)
    names = len(distinct_names(vocabulary))
    notes = [] if scene.field.segments else [f"no segments: each word is looked for; {NO_SEGMENTS}"]
    if 0 < names < _FEW_NAMES:
        notes.append(
            "few names: a thing without its own name gets the one that fits it best; add names of other things"
        )
    find_best_views(scene, things)
    if picture is not None:
        write_sheet(scene, things, picture)
    return {
        "scene": str(scene.folder.root) if scene.folder else None,
        "rests_on": rests_on(scene),
        **scene.world.to_json(),
        "words": names or len(default_vocabulary(scene.clip)),
        "note": "; ".join(notes),
        "picture": None if picture is None else str(picture),
        "objects": [_entry(scene, thing) for thing in things],
    }


def _entry(scene: Scene, thing: Selection) -> dict[str, Any]:
    """One object of `list_document`."""
    return {
        **thing.geometry(),
        "names": [{"name": name, "probability": round(share, 4)} for name, share in thing.names],
        "colors": object_colors(scene, thing),
        "surface": thing.phrase in SURFACES,
    }


def _named(thing: Selection, words: Sequence[str], strengths: np.ndarray) -> Selection:
    """An object with its likeliest names, its own name first; the strength of that name becomes its scores.

    Its own name describes it and its parts, unless another one describes all of it far better.
    """
    own = words.index(thing.phrase)
    if not gives_way(words[own]):  # nothing is only of metal
        strengths = np.where([gives_way(word) for word in words], -np.inf, strengths)
    shares = name_probabilities(strengths)
    order = np.argsort(-shares, kind="stable")[:_NAMES]
    names = [(words[place], float(shares[place])) for place in order if shares[place] >= _LEAST_PROBABILITY]
    if names and shares[own] < _FAR_BETTER * names[0][1]:
        thing, own = thing.described(phrase=names[0][0]), int(order[0])
    if thing.phrase != (names or [("", 0.0)])[0][0]:
        names = [(thing.phrase, float(shares[own])), *(entry for entry in names if entry[0] != thing.phrase)]
    strength = min(max(float(strengths[own]), 0.0), 1.0)
    thing.scores[thing.indices] = strength
    return thing.described(names=tuple(names[:_NAMES]))


def _named_by_words(scene: Scene, words: Sequence[str]) -> tuple[Selection, ...]:
    """The objects of a scene without segments: the instances of all words, each place under its best word."""
    answers = scene.ask(words, checked=True)
    found = [
        instance
        for number, presence in enumerate(answers.presences)
        if presence != "no"
        for instance in answers.selection(number).instances
    ]
    kept: list[Selection] = []
    for instance in sorted(found, key=lambda each: -each.score):
        if not any(same(instance, other) or _is_part(instance, other) for other in kept):
            kept.append(instance.described(names=((instance.phrase, instance.score),)))
    return tuple(kept)


def _is_part(instance: Selection, other: Selection) -> bool:
    """Whether most of it belongs to another name. A part of a thing is no object; a coin on a table is one."""
    shared = int(other.mask[instance.indices].sum())
    return other.phrase not in SURFACES and shared > 0.5 * len(instance)
