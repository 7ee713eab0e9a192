"""Answers from what a library keeps of a scene, without opening it.

A phrase takes whole segments, and which ones follows from the language of the segments (`lexsplat.queries.segments`),
so presence and selection are computed as in the scene, by the same functions. Instances, boxes and views come from
links between segments and from sampled points. What needs more, such as relations of things, is left to the scene.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from lexsplat.geometry.boxes import fit_box, representatives
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.geometry.world import World
from lexsplat.language.segment_codes import SegmentCodes, segment_codes
from lexsplat.language.segments import Segments
from lexsplat.queries.clusters import LINK
from lexsplat.queries.colors import color_told, colors_expected, may_be
from lexsplat.queries.everyday import EverydayScale
from lexsplat.queries.grammar import understand
from lexsplat.queries.kinds import is_kind, is_of_kind, words_of_things
from lexsplat.queries.phrases import Thing
from lexsplat.queries.places import lengths
from lexsplat.queries.presence import FAINT, DescribedPlaces, PresenceClassifier
from lexsplat.queries.segments import SEGMENT_THRESHOLD, segment_relevancy
from lexsplat.queries.selection import PEAK_COUNT, SMALLEST_SHARE, Presence, Selection
from lexsplat.queries.spelling import corrected, strange
from lexsplat.queries.vocabulary import NAMES, STUFF, is_part_alone, thing_of_part
from lexsplat.runtime.errors import SceneFolderError
from lexsplat.scenes.gone import noun_of
from lexsplat.scenes.library.contents import Contents

_LARGE = 0.05
"""Phrases without an everyday name that select this share of a scene are left to it."""

Array = NDArray[Any]


@dataclass(frozen=True)
class Indexed:
    """An answer from the index.

    Args:
        answer: As of `lexsplat.scenes.answers.find_phrase`.
        contents: Contents that it was made from.
        view: Number of the image that shows the first thing best; -1 if none does.
        frame: Left, upper, right and lower pixel of that thing in it.
    """

    answer: dict[str, Any]
    contents: Contents
    view: int = -1
    frame: tuple[int, int, int, int] = (0, 0, 0, 0)

    def picture(self, side: int) -> Image.Image | None:
        """The image with the frame; None if the library has none of this thing."""
        if self.view < 0:
            return None
        image = self.contents.picture(self.view)
        ImageDraw.Draw(image).rectangle(list(self.frame), outline="red", width=2)
        image.thumbnail((side, side))
        return image


class _KeptPresence(PresenceClassifier):
    """`PresenceClassifier` with what was kept when the scene was added."""

    def __init__(self, contents: Contents, codes: Tensor) -> None:
        self._contents, self._best_colored = contents, contents.best_colored
        scale = EverydayScale(contents.mean, contents.best, float(contents.peak))
        field: Any = SimpleNamespace(
            codebook=SimpleNamespace(clip=codes.float()), segments=_segments(contents)
        )
        places = DescribedPlaces(contents.places.float(), ())
        super().__init__(_one_gaussian(), field, scale, self._no_text, places)

    @staticmethod
    def _no_text(_: Any) -> Tensor:
        raise ValueError("the places of the scene are kept")

    @functools.cached_property
    def segment_codes(self) -> SegmentCodes | None:
        """The language of the segments of all levels; made where a phrase names a part of a thing."""
        masses = self._contents.masses.double().numpy()
        return segment_codes(_segments(self._contents), masses[:, None] * _spread(self._contents).toarray())


@functools.cache
def _one_gaussian() -> Gaussians:
    """A placeholder for the geometry, which no rule reads."""
    return gaussians_from_points(np.zeros((1, 3)), np.zeros((1, 3)), sh_degree=0, opacity=0.5)


def _segments(contents: Contents) -> Segments:
    return Segments(torch.arange(len(contents.masses)), contents.masses, contents.levels.long())


def _spread(contents: Contents) -> csr_array:
    """Distributions of the segments over the codes ``[S, K]``."""
    shares, columns = contents.shares.float().numpy(), contents.columns.numpy()
    shape = (len(contents.masses), len(contents.best))
    return csr_array((shares, columns, contents.rows.numpy()), shape=shape)


def decidable(phrase: str, clip: str) -> Thing | None:
    """The thing that a phrase names, if the index can answer it; None if scenes must be searched themselves.

    Args:
        phrase: Free-text phrase.
        clip: Name of the encoder.
    """
    understood = understand(phrase)
    thing = understood.phrase
    if not isinstance(thing, Thing) or understood.note or (clip == "bundled" and not phrase.isascii()):
        return None
    if thing_of_part(thing.text) or is_part_alone(
        thing.text
    ):  # compared where its thing is described, or cut
        return None
    known = words_of_things(clip)
    if clip == "bundled" and strange(thing.text, known):
        return None
    if not thing.exact and corrected(thing.text, known) != thing.text:
        return None
    return thing


def answer_from(contents: Contents, codes: Tensor, thing: Thing, phrase: str, text: Tensor) -> Indexed | None:
    """The answer of a scene, from what is kept of it.

    Args:
        contents: Contents of the scene.
        codes: Codewords of unit length ``[K, D]``.
        thing: The thing that is looked for (`decidable`).
        phrase: The phrase that named it.
        text: Its unit embedding ``[D]``.

    Returns:
        The answer; None if the scene itself must be asked.
    """
    common = {"phrase": phrase, "understood": str(thing), "note": ""}
    if not thing.exact and is_kind(thing.text):
        known = [each for each in contents.facts["objects"] if is_of_kind(each["name"], thing.text)]
        if known:
            return _of_objects(contents, known, common)
    classifier, unit, words = _KeptPresence(contents, codes), text[None].float(), thing.text.lower().split()
    (presence,) = classifier.classify([thing.text], unit, torch.zeros(1, 1))
    presence = "no" if noun_of(thing.text) in contents.facts.get("gone", ()) else presence
    told, expected = color_told(thing.text), colors_expected(thing.text)
    if presence != "yes" and told and any(told & colors for colors in _colors_of(contents, words[-1])):
        return None  # an object of this name that is mostly in this color is the answer
    if presence == "no":
        return Indexed({**_answer([], presence), **common}, contents)
    if presence == "yes" and expected:
        seen = _colors_of(contents, words[-1])
        if not seen:
            return None
        presence = "yes" if any(may_be(expected, colors) for colors in seen) else "unsure"
    best = classifier.best_heights([thing.text])
    by_code = classifier.scale.relevancy(classifier.language.codebook.clip, unit, best)[:, 0].numpy()
    own = torch.from_numpy(np.clip(_spread(contents) @ by_code, 0, 1))[None]
    scores = segment_relevancy(own, _segments(contents), contents.uncertainties)[0].numpy()
    counts = contents.counts.numpy()
    taken = np.flatnonzero((scores >= SEGMENT_THRESHOLD) & (counts > 0))
    large = counts[taken].sum() >= _LARGE * counts.sum() and NAMES.isdisjoint(words)
    if not len(taken) or (large and words[-1] not in STUFF):
        return None
    if contents.opacities.numpy()[taken].sum() < FAINT * counts[taken].sum():
        return Indexed({**_answer([], "no"), **common}, contents)
    parts = [taken] if words[-1] in STUFF else _instances(contents, taken, own[0].numpy())
    found = [_instance(contents, part, scores, thing.text) for part in parts]
    in_color = (_is_in_color(contents, each[0], words[-1], expected) for each in found)
    if not found or (expected and not any(in_color)):
        return None
    return Indexed({**_answer([each[0] for each in found], presence), **common}, contents, *found[0][1:])


def _is_in_color(contents: Contents, instance: Mapping[str, Any], name: str, expected: set[str]) -> bool:
    """Whether an instance lies in an object of a name that is seen in a color, or in a near one."""
    for each, colors in zip(contents.facts["objects"], contents.facts.get("colors", ())):
        place = np.array(each["axes"]) @ (np.array(instance["center"]) - each["center"])
        inside = bool((np.abs(place) <= np.array(each["size"]) / 2).all())
        if inside and each["name"].split()[-1] == name and may_be(expected, set(colors)):
            return True
    return False


def _colors_of(contents: Contents, name: str) -> list[set[str]]:
    """The colors that the objects with a name are seen in, of each; none where the index does not hold them."""
    named = zip(contents.facts["objects"], contents.facts.get("colors", ()))
    return [set(colors) for each, colors in named if each["name"].split()[-1] == name]


def _answer(instances: list[dict[str, Any]], presence: Presence) -> dict[str, Any]:
    return {
        "present": presence,
        "count": len(instances),
        "gaussians": sum(each["gaussians"] for each in instances),
        "threshold": SEGMENT_THRESHOLD,
        "best_view": instances[0]["best_view"] if instances else "",
        "instances": instances,
    }


def _of_objects(contents: Contents, known: list[dict[str, Any]], common: Mapping[str, str]) -> Indexed:
    """The objects of a kind, as they were when the scene was added."""
    centers = contents.centers.numpy() @ np.array(known[0]["axes"]).T
    low = np.array(known[0]["axes"]) @ known[0]["center"] - np.array(known[0]["size"]) / 2
    inside = ((centers >= low) & (centers <= low + known[0]["size"])).all(1) & (contents.counts.numpy() > 0)
    view, frame = _best_view(contents, np.flatnonzero(inside))
    return Indexed({**_answer(known, "yes"), **common}, contents, view, frame)


def _instances(contents: Contents, taken: Array, own: Array) -> list[Array]:
    """The instances among taken segments, the largest first, without specks and unconvincing ones."""
    sizes, opacities = contents.counts.numpy(), contents.opacities.numpy()
    order = taken[np.argsort(contents.spacings.numpy()[taken], kind="stable")]
    half = np.searchsorted(np.cumsum(sizes[order]), sizes[order].sum() / 2)
    reach = LINK * float(contents.spacings[int(order[half])])
    chosen = np.zeros(len(sizes), bool)
    chosen[taken] = True
    links = contents.links.numpy()[chosen[contents.links.numpy()].all(1) & (contents.gaps.numpy() <= reach)]
    edges = (np.ones(len(links)), (links[:, 0], links[:, 1]))
    _, labels = connected_components(coo_array(edges, shape=(len(sizes),) * 2), directed=False)
    totals = np.bincount(labels[taken], opacities[taken], labels.max() + 1)
    ranked = [label for label in np.argsort(-totals, kind="stable") if totals[label] > 0]
    parts = [
        taken[labels[taken] == label] for label in ranked if totals[label] >= SMALLEST_SHARE * totals.max()
    ]
    if len(parts) < 2:
        return parts or [taken]
    peaks = [_peak(own[part], sizes[part]) for part in parts]
    nothing = Selection(
        _one_gaussian(), {}, torch.zeros(1, dtype=torch.bool), torch.zeros(1), SEGMENT_THRESHOLD
    )
    limit = nothing.convincing_limit(max(peaks))
    return [part for part, peak in zip(parts, peaks) if peak >= limit]


def _peak(scores: Array, sizes: Array) -> float:
    """The mean of the highest scores of `PEAK_COUNT` Gaussians."""
    order = np.argsort(-scores, kind="stable")
    before = np.cumsum(sizes[order]) - sizes[order]
    counted = np.clip(PEAK_COUNT - before, 0, sizes[order])
    return float((scores[order] * counted).sum() / max(1, counted.sum()))


def _point_rows(contents: Contents, part: Array) -> tuple[Array, Array]:
    """Rows of the sampled points of segments, and their positions ``[m, 3]``."""
    starts = contents.starts.numpy()
    rows = np.concatenate([np.arange(starts[each], starts[each + 1]) for each in part])
    of = np.repeat(part, starts[part + 1] - starts[part])
    return rows, contents.centers.numpy()[of].astype(np.float64) + contents.offsets.numpy()[rows]


def _instance(
    contents: Contents, part: Array, scores: Array, name: str
) -> tuple[dict[str, Any], int, tuple[int, int, int, int]]:
    """An instance as plain data (`Selection.geometry`), its best image and its frame there."""
    rows, points = _point_rows(contents, part)
    of = np.repeat(part, np.diff(contents.starts.numpy())[part])
    kept = np.diff(contents.starts.numpy())[of]
    # A point stands for the Gaussians of its segment that are not kept.
    weights = contents.weights.numpy()[rows].astype(np.float64) * contents.counts.numpy()[of] / kept
    up = np.array(contents.facts["world"]["up"]["direction"], np.float64)
    chosen, opacities = representatives(weights), contents.opacities.numpy()[part]
    box = fit_box(points[chosen], up, contents.spreads_of(rows[chosen]))
    view, frame = _best_view(contents, part)
    data = {
        "name": name,
        "gaussians": int(contents.counts.numpy()[part].sum()),
        "score": round(float((scores[part] * opacities).sum() / max(opacities.sum(), 1e-12)), 4),
        "center": [round(float(v), 5) for v in box.center],
        "size": [round(float(v), 5) for v in 2 * box.half_sizes],
        "axes": [[round(float(v), 5) for v in axis] for axis in box.axes],
        "best_view": contents.facts["views"][view] if view >= 0 else "",
    }
    return data, view, frame


def _best_view(contents: Contents, part: Array) -> tuple[int, tuple[int, int, int, int]]:
    """The image that shows most of some segments, and the frame around them in it; -1 if none shows them."""
    if not len(part):
        return -1, (0, 0, 0, 0)
    rows, points = _point_rows(contents, part)
    seen, best = contents.seen.numpy()[rows], (0.0, -1, (0, 0, 0, 0))
    for number in range(len(contents.ends)):
        here = (seen >> number & 1).astype(bool)
        if not here.any():
            continue
        camera = contents.camera(number)
        pixels, depth, inside = camera.project(points[here])
        shown = float((camera.K[0, 0] / depth[inside] ** 2).sum()) if inside.any() else 0.0
        if shown > best[0]:
            x, y = pixels[inside].T
            edges = (x.min() - 2, y.min() - 2, x.max() + 2, y.max() + 2)
            frame = tuple(round(float(edge)) for edge in edges)
            best = (shown, number, frame)  # type: ignore[assignment]
    return best[1], best[2]


def with_world(indexed: Indexed, stored: Any) -> tuple[Indexed, World] | None:
    """The answer in meters where the scene's scale has been set since it was added, and its world.

    Args:
        indexed: The answer.
        stored: The entry "world" of its ``scene.json``, if it has one.

    Returns:
        None if the up direction has changed since: the boxes of the answer would not be upright.
    """
    world = before = World.from_json(indexed.contents.facts["world"])
    if isinstance(stored, Mapping):
        with contextlib.suppress(SceneFolderError):
            world = World.from_json(stored)
    if not np.allclose(world.up.direction, before.up.direction, atol=1e-6):
        return None
    if world.meters_per_unit is None:
        return indexed, world
    for each in indexed.answer["instances"]:
        each.update(lengths(each["center"], each["size"], world.meters_per_unit))
    return indexed, world
