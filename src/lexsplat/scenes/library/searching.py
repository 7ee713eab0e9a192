"""The two stages of a search in a library: bounds from codes, then answers from the index or of the scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from lexsplat.geometry.world import World
from lexsplat.queries.grammar import understand
from lexsplat.queries.kinds import is_of_kind, words_of_things
from lexsplat.queries.phrases import Phrase, Thing, things_of
from lexsplat.queries.relevancy import check_prompts
from lexsplat.queries.selection import PRESENCES, Presence
from lexsplat.queries.spelling import spellings
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.rendering import render
from lexsplat.runtime.errors import FileFormatError, LexsplatError, QueryError
from lexsplat.runtime.files import atomic_path
from lexsplat.scenes.answers import file_name, find_phrase
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.library.bounds import CERTAIN, SURELY_NOT, phrase_bound, presence_bounds
from lexsplat.scenes.library.indexed import Indexed, answer_from, decidable, with_world
from lexsplat.scenes.library.mending import orphans, rebuilt
from lexsplat.scenes.library.records import Record
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import sentence

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

_COVERED = 0.3
"""A pixel shows a thing if the thing covers this share of it."""
PROPOSED = 1000
"""Codes that a server proposes for each text."""
_ASKED = 4
"""Scenes that are looked at for each one that is wanted, at most."""
_REBUILT = 2
"""Rebuilt scenes that are looked at before the others, for each scene that is wanted."""
_TOLD = 5
"""Largest number of notes, and of skipped scenes, that an answer prints."""


@dataclass(frozen=True)
class Hit:
    """A scene that holds what was asked for.

    Args:
        scene: Its name in the library.
        path: Its folder.
        bound: Upper bound of the strength of presence, from its codes.
        answer: The answer, as of `lexsplat.scenes.answers.find_phrase`.
        clip: Name of its encoder.
        world: Its up direction and scale.
        library: The library.
        indexed: The answer from the index; None if the scene itself was asked.
    """

    scene: str
    path: str
    bound: float
    answer: dict[str, Any]
    clip: str
    world: World
    library: Library = field(repr=False)
    indexed: Indexed | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"{self.scene}: present: {self.present}. {self.sentence}{self._sizes()}"

    def _sizes(self) -> str:
        scale, unit = (
            (self.world.meters_per_unit or 1.0),
            "m" if self.world.meters_per_unit else "scene units",
        )
        sizes = [each["size"] for each in self.answer["instances"][:8]]
        told = "; ".join(" x ".join(f"{side * scale:.2f}" for side in size) for size in sizes)
        return f" Size: {told} {unit}." if told else ""

    @property
    def opened(self) -> Scene:
        """The scene; opened where that was not necessary for the answer."""
        return self.library.scene(self.scene)

    @property
    def source(self) -> str:
        """What answered: "index" or "scene"."""
        return "index" if self.indexed else "scene"

    @property
    def present(self) -> Presence:
        """Whether the scene holds it: "yes" or "unsure"."""
        return self.answer["present"]

    @property
    def count(self) -> int:
        """Number of things found."""
        return self.answer["count"]

    @property
    def sentence(self) -> str:
        """The answer in one plain sentence."""
        return sentence(self.answer, self.world.meters_per_unit)

    def picture(self, side: int = 320) -> Image.Image:
        """The view that shows the first thing best, with a frame around it; the longer side in pixels.

        From the index, it is the best of the eight views that the library keeps, of at most 320 pixels.
        """
        kept = self.indexed.picture(side) if self.indexed else None
        return self._rendered(side) if kept is None else kept

    def _rendered(self, side: int) -> Image.Image:
        scene = self.opened
        things = scene.find(self.answer["phrase"]).instances
        name = things[0].best_view if things else next(iter(scene.views))
        camera = scene.camera(name)
        camera = camera.downscaled(max(1.0, max(camera.width, camera.height) / side))
        carried = things[0].mask[:, None].float() if things else None
        with torch.no_grad():
            shown = render(scene.gaussians, camera, features=carried)
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
            "encoder": self.clip,
            "bound": round(self.bound, 4),
            "source": self.source,
            **self.world.to_json(),
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
        unopened: Number of scenes that may hold it as well and were not looked at.
        skipped: Scenes that could not be asked, and why.
        rebuilt: Scenes that were built again since they were added, and what to do.
        encoders: Names of the encoders of the scenes.
    """

    phrase: str
    understood: str
    hits: tuple[Hit, ...]
    scenes: int
    opened: int
    unopened: int
    skipped: dict[str, str]
    rebuilt: dict[str, str] = field(default_factory=dict)
    encoders: tuple[str, ...] = ()

    def __repr__(self) -> str:
        more = f"; {self.unopened} more may hold it" if self.unopened else ""
        several = f" of {len(self.encoders)} encoders" if len(self.encoders) > 1 else ""
        head = f"{self.phrase}: in {len(self.hits)} of {self.scenes} scenes{several}{more}"
        lines = [head]
        for number, hit in enumerate(self.hits, start=1):
            lines.append(f"  {number}. {hit}" + (f" (encoder {hit.clip})" if several else ""))
        return "\n".join([*lines, *_told("note", self.rebuilt), *_told("skipped", self.skipped)])

    def rows(self) -> list[dict[str, Any]]:
        """One row for each thing, as for a table: `pandas.DataFrame(found.rows())`."""
        return [
            {
                "phrase": self.phrase,
                "scene": hit.scene,
                "present": hit.present,
                "count": hit.count,
                **dict(zip(("x", "y", "z"), thing["center"])),
                **dict(zip(("width", "depth", "height"), thing["size"])),
                "view": thing["best_view"],
            }
            for hit in self.hits
            for thing in hit.answer["instances"]
        ]

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
            "rebuilt": [{"scene": name, "problem": problem} for name, problem in self.rebuilt.items()],
            "encoders": list(self.encoders),
        }


def _told(kind: str, problems: dict[str, str]) -> list[str]:
    """Lines for people: the first few problems, and how many more there are."""
    lines = [f"  {kind}: {problem}" for problem in list(problems.values())[:_TOLD]]
    more = len(problems) - _TOLD
    return [*lines, f"  {kind}: {more} more; lexsplat library verify LIB names them"] if more > 0 else lines


def search(library: Library, phrase: str, limit: int, confirm: bool = False) -> Found:
    """The scenes of a library that hold what a phrase names (`Library.search`)."""
    if limit < 1:
        raise QueryError("limit", expected="at least 1", found=str(limit))
    asking = _Asking(library, check_prompts(phrase)[0], confirm)
    understood = understand(asking.text).phrase
    possible = candidates(library, understood)
    skipped, asked, opened = possible.skipped, 0, 0
    hits: list[Hit] = []
    for name, bound in _in_turn(possible, limit):
        if asked == _ASKED * limit or sum(hit.present == "yes" for hit in hits) == limit:
            break
        asked += 1
        try:
            hit = asking.hit(name, bound)
        except LexsplatError as error:
            skipped[name] = str(error)
            opened += 1
            continue
        opened += hit.source == "scene"
        if hit.present != "no":
            hits.append(hit)
    hits.sort(key=lambda hit: (-PRESENCES.index(hit.present), -hit.bound, hit.scene))
    names = library.names()
    skipped.update({name: str(error) for name, error in library.damaged.items() if name in names})
    return Found(
        phrase=asking.text,
        understood=str(understood),
        hits=tuple(hits[:limit]),
        scenes=len(names),
        opened=opened,
        unopened=len(possible.ranked) - asked + possible.unproposed,
        skipped=skipped,
        rebuilt=possible.rebuilt,
        encoders=possible.encoders,
    )


def _in_turn(possible: Candidates, limit: int) -> list[tuple[str, float]]:
    """The candidates in the order in which they are looked at.

    Nothing is known of rebuilt scenes. They come first, but many of them would leave no room for the others.
    """
    again = [entry for entry in possible.ranked if entry[0] in possible.rebuilt]
    late = {name for name, _ in again[_REBUILT * limit :]}
    return sorted(possible.ranked, key=lambda entry: entry[0] in late)


class _Asking:
    """One question to many scenes: what is the same for all of them is worked out once.

    Args:
        library: The library.
        text: The phrase.
        confirm: Whether the scenes themselves are asked in any case.
    """

    def __init__(self, library: Library, text: str, confirm: bool) -> None:
        self.library, self.text, self.confirm = library, text, confirm
        self._things: dict[str, Thing | None] = {}
        self._texts: dict[str, Tensor] = {}

    def hit(self, name: str, bound: float) -> Hit:
        """The answer of a scene, also if it is "no".

        Raises:
            LexsplatError: If it cannot be asked.
        """
        record = self.library.record(name)
        try:
            return self._hit(name, bound, record)
        except FileFormatError:
            if self.library.record(name) == record:
                raise
            return self.hit(name, bound)  # replaced in the meantime

    def _hit(self, name: str, bound: float, record: Record | None) -> Hit:
        if record is not None and record.contents and not self.confirm:
            folder = SceneFolder.open(self.library.folder(record))
            found = None if self.library.is_rebuilt(record) else self._indexed(record)
            if found is not None:
                found, world = with_world(found, folder.record.get("world"))
                path = str(folder.root)
                return Hit(name, path, bound, found.answer, record.clip, world, self.library, found)
        scene = self.library.scene(name)
        answer, path = find_phrase(scene, self.text), str(scene.folder.root) if scene.folder else ""
        return Hit(name, path, bound, answer, scene.clip, scene.world, self.library)

    def _indexed(self, record: Record) -> Indexed | None:
        if record.clip not in self._things:
            self._things[record.clip] = decidable(self.text, record.clip)
        thing, codes = self._things[record.clip], self.library.codes(record)
        if thing is None or codes is None:
            return None
        if record.group not in self._texts:
            self._texts[record.group] = self.library.embed(record.encoder, record.clip, [thing.text])[0]
        contents = self.library.contents(record)
        return answer_from(contents, codes.units, thing, self.text, self._texts[record.group].cpu())


@dataclass(frozen=True)
class Candidates:
    """The scenes that may hold what a phrase names.

    Args:
        ranked: Their names and bounds, the highest first.
        unproposed: Number of scenes that a server did not propose, although they may hold it.
        skipped: Scenes that cannot be compared, and why.
        rebuilt: Scenes that were built again, and what to do: their old codes rule out nothing.
        encoders: Names of the encoders of all scenes.
    """

    ranked: list[tuple[str, float]]
    unproposed: int
    skipped: dict[str, str]
    rebuilt: dict[str, str]
    encoders: tuple[str, ...]


def candidates(library: Library, phrase: Phrase) -> Candidates:
    """The scenes of a library that may hold what a phrase names."""
    current, skipped, again = [], orphans(library), {}
    records = library.records()
    for record in records:
        try:
            if library.is_rebuilt(record):
                again[record.name] = rebuilt(library, record)
            else:
                current.append(record)
        except LexsplatError as error:
            skipped[record.name] = str(error)
    found = [(name, CERTAIN) for name in again]
    groups, unproposed = _groups(library, current, phrase)
    for group in groups:
        try:
            bounds = _bounds(library, group, phrase)
        except LexsplatError as error:  # the encoder of these scenes is not here
            skipped.update({record.name: str(error) for record in group})
            continue
        found += [(record.name, bound) for record, bound in zip(group, bounds) if bound >= SURELY_NOT]
    ranked = sorted(found, key=lambda entry: (-entry[1], entry[0]))
    encoders = tuple(sorted({record.clip for record in records}))
    return Candidates(ranked, unproposed, skipped, again, encoders)


def _groups(library: Library, records: list[Record], phrase: Phrase) -> tuple[list[list[Record]], int]:
    """The records to compare, those of one encoder together: all, or those that a server proposes.

    Returns:
        The groups, and the number of scenes that the server did not propose although they may hold the phrase.
    """
    groups: dict[str, dict[str, Record]] = {}
    for record in records:
        groups.setdefault(record.group, {})[record.name] = record
    if library.server is None or not things_of(phrase):
        return [list(group.values()) for group in groups.values()], 0
    proposed, unproposed = [], 0
    for collection in library.server.groups(library.stage, library.groups()):
        there = groups.get(collection.group, {})
        if not there:
            continue
        one = next(iter(there.values()))
        texts = [text for both in spellings_of(phrase, one.clip).values() for text in both]
        embedded = library.embed(one.encoder, one.clip, texts)
        names, least = library.server.nearest(collection.place, embedded, PROPOSED)
        known = [there[name] for name in names if name in there]
        proposed.append(known)
        unproposed += len(there) - len(known) if least >= SURELY_NOT else 0
    return [group for group in proposed if group], unproposed


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
    found = {}
    for text in things_of(phrase):
        meant = (text, *spellings(text, words_of_things(clip)))
        members = (name for name in default_vocabulary(clip) if any(is_of_kind(name, one) for one in meant))
        found[text] = tuple(dict.fromkeys((*meant, *members)))
    return found
