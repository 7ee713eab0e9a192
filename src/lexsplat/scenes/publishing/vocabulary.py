"""The phrases that a published page answers without a text encoder, and what it answers."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from functools import lru_cache
from importlib.resources import files

import torch
from torch import Tensor

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.grammar import understand
from lexsplat.queries.phrases import Thing
from lexsplat.queries.relevancy import embed_prompts
from lexsplat.queries.vocabulary import thing_of_part
from lexsplat.runtime.errors import LexsplatError, QueryError
from lexsplat.runtime.files import read_json
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.gone import gone_nouns, noun_of
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

ASKED, NAME, COMBINED, USE = "a", "n", "c", "u"
"""Kinds of phrases: asked of this scene before; names, which answer "what is this?"; names with a color, material or
part; what things are for."""

_MOST_ASKED = 500
_LONGEST = 120
_BATCH = 128


def everyday_phrases(bundled: bool = False) -> dict[str, str]:
    """The kind of each everyday phrase, in the order of ``words.txt``: names first.

    Args:
        bundled: Whether the encoder is the bundled one, which knows few names: the others count as `COMBINED`.
    """
    text = files(__package__).joinpath("page/words.txt").read_text(encoding="utf-8")
    sections: dict[str, list[str]] = {}
    for line in text.splitlines():
        name, colon, content = line.partition(":")
        if colon and not line.startswith("#"):
            separator = ";" if name == "parts" else ","
            sections.setdefault(name, []).extend(part.strip() for part in content.split(separator))
    phrases = dict.fromkeys(sections["bundled"], NAME)
    for name in (*sections["things"], *everyday_words()):
        phrases.setdefault(name.lower(), COMBINED if bundled else NAME)
    for adjectives, things in (("colors", "colored"), ("materials", "made")):
        for thing in sections[things]:
            for adjective in sections[adjectives]:
                phrases.setdefault(f"{adjective} {thing}", COMBINED)
    for entry in sections["parts"]:
        owner, _, parts = entry.partition("=")
        for part in parts.split(","):
            phrases.setdefault(f"{owner.strip()} {part.strip()}", COMBINED)
    for use in sections["uses"]:
        phrases.setdefault(use, USE)
    return phrases


def page_phrases(asked: Iterable[str] = (), bundled: bool = False) -> dict[str, str]:
    """The kind of each phrase of a page: the things asked of the scene, then everyday phrases.

    Only plain things are taken. "Mug left of the duck", "red toy" and "small table" are not answered by their
    relevancy alone.
    """
    phrases: dict[str, str] = {}
    for phrase in asked:
        plain = " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", phrase).split())[:_LONGEST].lower()
        if plain and len(phrases) < _MOST_ASKED and _is_thing(plain):
            phrases[plain] = ASKED
    for phrase, kind in everyday_phrases(bundled).items():
        if phrase not in phrases and _is_thing(phrase):
            phrases[phrase] = kind
    return phrases


@lru_cache(maxsize=10_000)  # the viewer asks for the same phrases after each edit
def _is_thing(phrase: str) -> bool:
    try:
        understood = understand(phrase)
    except QueryError:
        return False
    return isinstance(understood.phrase, Thing) and not understood.unknown


def asked_phrases(scene: Scene) -> list[str]:
    """Phrases asked in the viewer, the latest first; none for a scene without a folder."""
    if scene.folder is None:
        return []
    try:
        content = read_json(scene.folder.root / "viewer.json")
        history = content.get("history", []) if isinstance(content, dict) else []
    except LexsplatError:
        return []
    return [phrase for phrase in history if isinstance(phrase, str)]


def offered_phrases(scene: Scene) -> dict[str, str]:
    """The `page_phrases` of a scene; a note says how many were asked in the viewer, and in which file they are.

    Those that the encoder would truncate are left out.
    """
    phrases = page_phrases(asked_phrases(scene), bundled=scene.clip == "bundled")
    asked = [phrase for phrase, kind in phrases.items() if kind == ASKED]
    if not asked or scene.folder is None:
        return phrases
    over = getattr(scene.preload(), "tokens_over", lambda _: 0)
    long = [one for one in asked if any(over(form.replace("{}", one)) for form in scene.query.templates)]
    for phrase in long:
        del phrases[phrase]
    count = len(asked) - len(long)
    told = f"{count:,} phrase{' is' if count == 1 else 's are'} offered to visitors"
    if long:
        told += f", and {len(long):,} left out that the encoder would truncate"
    log.log(NOTE, "%s: %s", scene.folder.root / "viewer.json", told)
    return phrases


@torch.no_grad()
def phrase_answers(scene: Scene, phrases: list[str]) -> tuple[Tensor, list[str]]:
    """Relevancy of every phrase for every code, ``[P, K]`` uint8 in 255ths, and its presence: "y", "u" or "n".

    Both are relative to everyday words (`lexsplat.queries.everyday`), as the answers of a scene are.

    Raises:
        ModelError: If the text encoder cannot be loaded.
    """
    scale, field = scene.everyday_scale, scene.field
    codewords = field.codebook.clip
    encoder = scene.preload()
    encode = getattr(encoder, "encode_together", encoder.encode_text)
    embeddings = embed_prompts(phrases, encode, scene.query.templates)
    tables, presences = [], []
    for start in range(0, len(phrases), _BATCH):
        batch, texts = phrases[start : start + _BATCH], embeddings[start : start + _BATCH]
        best = scene.presence_classifier.best_heights(batch)
        relevancy = scale.relevancy(codewords, texts.to(codewords.device), best)
        tables.append((relevancy.T * 255).round().to(torch.uint8).cpu())
        # Evidence lies in the segments, where there are any; scores of a million Gaussians would take a minute.
        scores = field.scores(relevancy).T.contiguous() if field.segments is None else texts.new_zeros(0, 0)
        presences += [presence[0] for presence in scene.presence_classifier.classify(batch, texts, scores)]
    gone = gone_nouns(scene)
    for number, phrase in enumerate(phrases):
        if noun_of(phrase) in gone:
            presences[number] = "n"
        if presences[number] == "y" and thing_of_part(phrase):  # it may be another part
            presences[number] = scene.ask(phrase, checked=True).presences[0][0]
    return torch.cat(tables), presences


def words_file(phrases: dict[str, str], presences: list[str]) -> bytes:
    """The list of phrases for the page: one a line, its kind and its presence in front."""
    lines = (f"{kind}{present}{phrase}\n" for (phrase, kind), present in zip(phrases.items(), presences))
    return "".join(lines).encode("utf-8")
