"""`Scene.ask`: a prompt that the scene does not surely hold, in other words for the same thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from lexsplat.queries.meaning import in_known_words, known_words
from lexsplat.queries.phrases import Thing, Understood
from lexsplat.queries.selection import Presence
from lexsplat.scenes.answers import in_own_words
from lexsplat.scenes.words import Word

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


def in_words_that_fit(
    scene: Scene, prompts: Sequence[str], words: Sequence[Word]
) -> tuple[list[Word], tuple[Presence, ...]]:
    """The answers to prompts, some in other words for the same thing, and their presences.

    Args:
        scene: The scene that was asked.
        prompts: The prompts.
        words: The answers to them as they are written.
    """
    fitting, presences = [], []
    for prompt, word in zip(prompts, words):
        understood = in_own_words(prompt, scene.clip)
        other = _in_other_words(scene, prompt, understood, word)
        if other.asked:
            understood = in_own_words(other.asked, scene.clip)
        fitting.append(other)
        presences.append(understood.limit(other.presence))
    return fitting, tuple(presences)


def _in_other_words(scene: Scene, prompt: str, understood: Understood, word: Word) -> Word:
    """The answer to a prompt: its own, or where that is no "yes" the one to it as two words, or to its plural.

    Only what is understood as a single thing has other words.
    """
    thing, has_grammar = understood.phrase, understood.note and not understood.unknown
    if word.presence == "yes" or has_grammar or not isinstance(thing, Thing) or thing.exact:
        return word
    one = Thing(prompt, own="" if thing.text == prompt else thing.text)
    asked = in_known_words(
        one, lambda text: scene.ask(text, checked=True).presences[0], known_words(scene.clip)
    )
    if asked == prompt:
        return word
    other = scene.ask(asked, checked=True).words[0]
    note = "; ".join(filter(None, (f'asked for as "{asked}"', other.note)))
    return replace(other, selection=None, note=note, asked=asked)
