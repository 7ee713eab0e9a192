"""The two stages of a search in a library: bounds from codes, then answers of the scenes themselves."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from lexsplat.queries.grammar import understand
from lexsplat.queries.kinds import is_of_kind
from lexsplat.queries.phrases import Phrase, things_of
from lexsplat.queries.relevancy import check_prompts
from lexsplat.queries.selection import PRESENCES, Presence
from lexsplat.queries.spelling import corrected
from lexsplat.queries.vocabulary import QUALITIES, default_vocabulary
from lexsplat.rendering import render
from lexsplat.runtime.errors import LexsplatError, QueryError
from lexsplat.runtime.files import atomic_path
from lexsplat.scenes.answers import file_name, find_phrase
from lexsplat.scenes.library.bounds import CERTAIN, SURELY_NOT, phrase_bound, presence_bounds
from lexsplat.scenes.library.entries import Record
from lexsplat.scenes.scene import Scene

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

_COVERED = 0.3
"""A pixel shows a thing if the thing covers this share of it."""
PROPOSED = 1000
"""Codes that a server proposes for each text."""
_OPENED = 4
"""Scenes that are opened for each one that is asked for, at most."""


@dataclass(frozen=True)
class Hit:
    """A scene that holds what was asked for.

    Args:
        scene: Its name in the library.
        path: Its folder.
        bound: Upper bound of the strength of presence, from its codes.
        answer: The answer of the scene, as of `lexsplat.scenes.answers.find_phrase`.
        opened: The scene.
    """

    scene: str
    path: str
    bound: float
    answer: dict[str, Any]
    opened: Scene = field(repr=False)

    @property
    def present(self) -> Presence:
        """Whether the scene holds it: "yes" or "unsure"."""
        return self.answer["present"]

    @property
    def count(self) -> int:
        """Number of things found."""
        return self.answer["count"]

    def picture(self, side: int = 320) -> Image.Image:
        """The view that shows the first thing best, with a frame around it; the longer side in pixels."""
        things = self.opened.find(self.answer["phrase"]).instances
        name = things[0].best_view if things else next(iter(self.opened.views))
        camera = self.opened.camera(name)
        camera = camera.downscaled(max(1.0, max(camera.width, camera.height) / side))
        carried = things[0].mask[:, None].float() if things else None
        with torch.no_grad():
            shown = render(self.opened.gaussians, camera, features=carried)
        image = Image.fromarray((shown.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
        if shown.features is not None and bool((seen := shown.features[..., 0] > _COVERED).any()):
            ys, xs = (each.cpu().numpy() for each in seen.nonzero(as_tuple=True))
            frame = (xs.min() - 2, ys.min() - 2, xs.max() + 2, ys.max() + 2)
            ImageDraw.Draw(image).rectangle([int(side) for side in frame], outline="red", width=2)
        return image

    def write_picture(self, folder: Path) -> Path:
        """Write `picture` to ``FOLDER/SCENE/PHRASE.jpg``."""
        path = folder / self.scene / f"{file_name(self.answer['phrase'])}.jpg"
        with atomic_path(path) as temporary:
            self.picture().save(temporary, format="JPEG", quality=85)
        return path

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        answer = {
            key: value for key, value in self.answer.items() if key not in ("phrase", "understood", "note")
        }
        return {
            "scene": self.scene,
            "path": self.path,
            "encoder": self.opened.clip,
            "bound": round(self.bound, 4),
            **self.opened.world.to_json(),
            **answer,
        }


@dataclass(frozen=True)
class Found:
    """The answer of a library.

    Args:
        phrase: What was asked for.
        understood: How it was parsed.
        hits: The scenes that hold it: "yes" before "unsure", then by their bounds.
        scenes: Number of scenes in the library.
        opened: Number of scenes that were asked themselves.
        unopened: Number of scenes that may hold it as well and were not opened.
        skipped: Scenes that could not be asked, and why.
        notes: Other things to know.
    """

    phrase: str
    understood: str
    hits: tuple[Hit, ...]
    scenes: int
    opened: int
    unopened: int
    skipped: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "phrase": self.phrase,
            "understood": self.understood,
            "scenes": self.scenes,
            "opened": self.opened,
            "unopened": self.unopened,
            "hits": [hit.to_dict() for hit in self.hits],
            "skipped": [{"scene": name, "problem": problem} for name, problem in self.skipped.items()],
        }


def search(library: Library, phrase: str, limit: int) -> Found:
    """The scenes of a library that hold what a phrase names (`Library.search`)."""
    if limit < 1:
        raise QueryError("limit", expected="at least 1", found=str(limit))
    text = check_prompts(phrase)[0]
    understood = understand(text).phrase
    skipped: dict[str, str] = {}
    ranked = candidates(library, understood, skipped)
    hits: list[Hit] = []
    opened = 0
    for name, bound in ranked:
        if opened == _OPENED * limit or sum(hit.present == "yes" for hit in hits) == limit:
            break
        opened += 1
        try:
            scene = library.scene(name)
            answer = find_phrase(scene, text)
        except LexsplatError as error:
            skipped[name] = str(error)
            continue
        if answer["present"] != "no":
            hits.append(Hit(name, str(scene.folder.root) if scene.folder else "", bound, answer, scene))
    hits.sort(key=lambda hit: (-PRESENCES.index(hit.present), -hit.bound, hit.scene))
    names = library.names()
    skipped.update({name: str(error) for name, error in library.damaged.items() if name in names})
    unopened = len(ranked) - opened
    return Found(text, str(understood), tuple(hits[:limit]), len(names), opened, unopened, skipped)


def candidates(library: Library, phrase: Phrase, skipped: dict[str, str]) -> list[tuple[str, float]]:
    """The scenes that may hold what a phrase names with their bounds, the highest first.

    Args:
        library: The library.
        phrase: What to look for.
        skipped: Receives the scenes that cannot be compared, and why.
    """
    found: list[tuple[str, float]] = []
    for records in _groups(library, phrase):
        try:
            bounds = _bounds(library, records, phrase)
        except LexsplatError as error:  # the encoder of these scenes is not here
            skipped.update({record.name: str(error) for record in records})
            continue
        found += [(record.name, bound) for record, bound in zip(records, bounds) if bound >= SURELY_NOT]
    return sorted(found, key=lambda entry: (-entry[1], entry[0]))


def _groups(library: Library, phrase: Phrase) -> list[list[Record]]:
    """The records to compare, those of one encoder together; with a server, those that it proposes."""
    groups: dict[str, list[Record]] = {}
    if library.server is None or not things_of(phrase):
        for record in library.records():
            groups.setdefault(record.group, []).append(record)
        return list(groups.values())
    proposed = []
    for place, encoder, clip in library.server.groups(library.stage):
        texts = [text for both in spellings_of(phrase, clip).values() for text in both]
        names = library.server.nearest(place, library.embed(encoder, clip, texts), PROPOSED)
        proposed.append([known for name in names if (known := library.record(name)) is not None])
    return [records for records in proposed if records]


def _bounds(library: Library, records: list[Record], phrase: Phrase) -> list[float]:
    """Bounds of a phrase in scenes of one encoder; -1 for those whose codes are damaged.

    A scene mends typing errors where that helps (`Scene.understand`), so both spellings are compared.
    """
    spellings = spellings_of(phrase, records[0].clip)
    codes = [library.codes(record) for record in records]
    sound = [each for each in codes if each is not None]
    if not spellings or not sound:
        return [-1.0 if each is None else CERTAIN for each in codes]
    texts = list(dict.fromkeys(text for both in spellings.values() for text in both))
    bounds = presence_bounds(sound, library.embed(records[0].encoder, records[0].clip, texts))
    of_thing = {
        thing: bounds[:, [texts.index(text) for text in both]].max(1) for thing, both in spellings.items()
    }
    values = iter(np.broadcast_to(phrase_bound(phrase, of_thing), len(sound)).tolist())
    return [-1.0 if each is None else next(values) for each in codes]


def spellings_of(phrase: Phrase, clip: str) -> dict[str, tuple[str, ...]]:
    """The texts of the things of a phrase, each with what it may be mended to and the members of its kind."""
    names = default_vocabulary(clip)
    found = {}
    for text in things_of(phrase):
        members = (name for name in names if is_of_kind(name, text))
        found[text] = tuple(dict.fromkeys((text, corrected(text, [*names, *QUALITIES]), *members)))
    return found
