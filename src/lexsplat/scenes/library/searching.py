"""The two stages of a search in a library: bounds from codes, then answers from the index or of the scenes.

The answer also tells what was not understood of a phrase, and what was searched in other words.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from lexsplat.queries.colors import without_color
from lexsplat.queries.grammar import thing_of, understand
from lexsplat.queries.kinds import is_of_kind, unknown_note, words_of_things
from lexsplat.queries.meaning import compounds, known_words
from lexsplat.queries.phrases import Phrase, Thing, Understood, own_words_of, things_of, with_things
from lexsplat.queries.relevancy import check_prompts
from lexsplat.queries.selection import PRESENCES
from lexsplat.queries.spelling import corrected, spellings
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.errors import FileFormatError, LexsplatError, QueryError
from lexsplat.runtime.progress import Event
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.library.bounds import CERTAIN, SURELY_NOT, phrase_bound, presence_bounds
from lexsplat.scenes.library.found import Found, Hit
from lexsplat.scenes.library.indexed import Indexed, answer_from, decidable, with_world
from lexsplat.scenes.library.mending import orphans, rebuilt
from lexsplat.scenes.library.records import Record
from lexsplat.scenes.serving import shortened, worded

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

PROPOSED = 1000
"""Codes that a server proposes for each text."""
_ASKED = 4
"""Largest number of scenes examined for each scene of the answer."""
_REBUILT = 2
"""Rebuilt scenes examined before the others, for each scene of the answer."""
_NAMED = 3
"""Scenes that a note names, at most."""


def search(library: Library, phrase: str, limit: int, confirm: bool = False) -> Found:
    """The scenes of a library that hold what a phrase names (`Library.search`)."""
    if not isinstance(limit, int) or limit < 1:
        raise QueryError("limit", expected="a whole number of at least 1", found=repr(limit)[:40])
    prompts = check_prompts(phrase)
    if len(prompts) > 1:
        raise QueryError("phrase", expected="one phrase", found=f"{len(prompts)}", remedy="search one by one")
    asking = _Asking(library, prompts[0], confirm)
    asked_for = understand(asking.text)
    possible = candidates(library, asked_for.phrase)
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
        if hit.present == "yes" or (hit.present == "unsure" and hit.count):
            hits.append(hit)
    hits.sort(key=lambda hit: (-PRESENCES.index(hit.present), -hit.bound, hit.scene))
    del hits[limit:]
    names = library.names()
    skipped.update({name: str(error) for name, error in library.damaged.items() if name in names})
    return Found(
        phrase=asking.text,
        understood=hits[0].answer["understood"] if hits else str(asked_for.phrase),
        note=_note_of(asked_for, hits, possible.encoders),
        hits=tuple(hits),
        scenes=len(names),
        opened=opened,
        unopened=len(possible.ranked) - asked + possible.unproposed,
        skipped=skipped,
        rebuilt=possible.rebuilt,
        encoders=possible.encoders,
        unread=asked_for.unread,
    )


def _note_of(asked: Understood, hits: Sequence[Hit], encoders: Iterable[str]) -> str:
    """The notes of the hits, each once, and the words that encoders without a hit do not know.

    A note that holds for some hits only names their scenes.

    Args:
        asked: The phrase as it was parsed.
        hits: The scenes that hold it, the best first.
        encoders: Names of the encoders of all scenes.

    Returns:
        "" if everything was understood and found.
    """
    scenes: dict[str, list[str]] = {}
    for hit in hits:
        parts = hit.answer["note"].split("; ") if hit.answer["note"] else []
        if hit.answer["understood"] != hits[0].answer["understood"]:
            parts.append(f"understood as {worded(hit.answer['understood'])}")
        for part in dict.fromkeys(parts):
            scenes.setdefault(part, []).append(hit.scene)
    notes = [
        part if len(named) == len(hits) else f"{part} (in {_listed(named)})" for part, named in scenes.items()
    ]
    if not hits and asked.note:
        notes.append(asked.note)
    answered = {hit.clip for hit in hits}
    for clip in encoders if not asked.unknown else ():
        if clip not in answered:
            notes += _notes_without_hits(asked.phrase, clip, mended=not hits)
    return "; ".join(dict.fromkeys(notes))


def _notes_without_hits(phrase: Phrase, clip: str, mended: bool) -> Iterator[str]:
    """Notes of an encoder without a hit.

    Args:
        phrase: Phrase that was asked for.
        clip: Name of the encoder.
        mended: Whether to note what was searched in place of typing errors.
    """
    known = words_of_things(clip)

    def mend(thing: Thing) -> Phrase:
        right = thing.text if thing.exact else corrected(thing.text, known)
        return thing if right == thing.text else thing_of(right)

    searched = with_things(phrase, mend)
    if mended and searched != phrase:
        yield f"also searched as {shortened(str(searched))}"
    if note := unknown_note(searched, clip):
        yield note


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _in_turn(possible: Candidates, limit: int) -> list[tuple[str, float]]:
    """The candidates in the order in which they are examined.

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
        """The answer of a scene, even if it is "no".

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
            indexed = None if self.library.is_rebuilt(record) else self._indexed(record)
            current = indexed and with_world(indexed, folder.record.get("world"))
            if current:
                found, world = current
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
        found = answer_from(contents, codes.units, thing, self.text, self._texts[record.group].cpu())
        # The scene may hold it by its own words, a plural, or as two words.
        otherwise = thing.own or any(compounds(thing.text, known_words(record.clip)))
        return None if found and found.answer["present"] == "no" and otherwise else found


@dataclass(frozen=True)
class Candidates:
    """The scenes that may hold what a phrase names.

    Args:
        ranked: Their names and bounds, the highest first.
        unproposed: Number of scenes that a server did not propose, although they may hold it.
        skipped: Scenes that cannot be compared, and why.
        rebuilt: Scenes that were built again, and what to do: their old codes rule out nothing.
        encoders: Names of the encoders of all scenes, one for each encoder.
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
    # An encoder may have several names, of which "bundled" tells which words it knows.
    last = sorted(records, key=lambda record: record.clip == "bundled")
    encoders = tuple(sorted({record.group: record.clip for record in last}.values()))
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

    A scene corrects typing errors where that helps (`Scene.understand`), so both spellings are compared.
    """
    spellings = spellings_of(phrase, records[0].clip)
    codes = []
    for done, record in enumerate(records):
        library.listener(Event("scenes", done, len(records)))
        codes.append(library.codes(record))
    library.listener(Event("scenes", len(records), len(records)))
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
    """The texts of the things of a phrase, each with its possible corrections and the members of its kind.

    A thing may have a color that language does not find, so it is also compared without its color.
    """
    found, own = {}, own_words_of(phrase)
    for text in things_of(phrase):
        typed = own.get(text, text)
        split = (words for words, _ in compounds(text, known_words(clip)))
        meant = (text, without_color(text), typed, without_color(typed), *split)
        meant = (*meant, *spellings(text, words_of_things(clip)))
        members = (name for name in default_vocabulary(clip) if any(is_of_kind(name, one) for one in meant))
        found[text] = tuple(dict.fromkeys((*meant, *members)))
    return found
