"""What a library did not understand of a phrase, and what it searched in other words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from lexsplat.queries.grammar import thing_of
from lexsplat.queries.kinds import unknown_note, words_of_things
from lexsplat.queries.phrases import Phrase, Thing, Understood, with_things
from lexsplat.queries.spelling import corrected
from lexsplat.scenes.library.found import Hit
from lexsplat.scenes.serving import shortened

_NAMED = 3
"""Scenes that a note names, at most."""


def note_of(asked: Understood, hits: Sequence[Hit], encoders: Iterable[str]) -> str:
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
            parts.append(f"understood as {shortened(hit.answer['understood'])}")
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
        phrase: What was asked for.
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
