"""State that the viewer keeps between visits: the prompts that were asked, and the vocabulary."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.errors import LexsplatError
from lexsplat.runtime.files import read_json, write_json

MAX_PROMPTS, MAX_PHRASES = 50, 500
MAX_LENGTH = 120
"""Characters in one phrase."""

logger = logging.getLogger("lexsplat")


@dataclass
class History:
    """Prompts and vocabulary of a scene, stored in ``viewer.json`` of its folder if the folder is writable.

    Args:
        path: The file; None stores nothing.
        prompts: Prompts that were asked, latest first.
        vocabulary: Phrases for "What is this?"; an empty list becomes ``default``.
        default: The initial vocabulary, restored when the user empties the list.
    """

    path: Path | None = None
    prompts: list[str] = field(default_factory=list)
    vocabulary: list[str] = field(default_factory=list)
    default: list[str] = field(default_factory=default_vocabulary)

    def __post_init__(self) -> None:
        self.vocabulary = self.vocabulary or list(self.default)

    @classmethod
    def load(cls, folder: Path | None, clip: str = "") -> History:
        """Read the history of a scene folder.

        A damaged file is reported in the log, ignored, and overwritten by the next prompt.

        Args:
            folder: The scene folder; None stores nothing.
            clip: Name of the text encoder, which decides the default vocabulary.
        """
        default = default_vocabulary(clip)
        if folder is None:
            return cls(default=default)
        path = folder / "viewer.json"
        history = cls(path if os.access(folder, os.W_OK) else None, default=default)
        if not path.is_file():
            return history
        try:
            content = read_json(path)
            if not isinstance(content, dict):
                raise ValueError("not an object")
            prompts, vocabulary = content.get("history", []), content.get("vocabulary", [])
            if not all(isinstance(phrase, str) for phrase in [*prompts, *vocabulary]):
                raise ValueError("phrases must be strings")
        except (LexsplatError, ValueError, TypeError) as error:
            logger.warning("%s: ignored: %s", path, error)
            return history
        history.prompts = clean_phrases(prompts)[:MAX_PROMPTS]
        history.vocabulary = clean_phrases(vocabulary) or default
        return history

    def add(self, prompt: str) -> None:
        """Put a prompt first, and save."""
        self.prompts = clean_phrases([prompt, *self.prompts])[:MAX_PROMPTS]
        self._save()

    def set_vocabulary(self, phrases: list[str]) -> None:
        """Replace the vocabulary, and save; an empty list restores the default."""
        self.vocabulary = clean_phrases(phrases) or list(self.default)
        self._save()

    def _save(self) -> None:
        if self.path is None:
            return
        try:
            own = {} if self.vocabulary == self.default else {"vocabulary": self.vocabulary}
            write_json(self.path, {"history": self.prompts, **own})
        except OSError as error:  # a full disk must not stop the viewer
            logger.warning("%s: not saved: %s", self.path, error.strerror or error)
            self.path = None


def clean_phrases(phrases: Iterable[str]) -> list[str]:
    """Normalize white space; drop empty phrases and duplicates (ignoring case); keep at most `MAX_PHRASES`."""
    cleaned: dict[str, str] = {}
    for phrase in phrases:
        short = " ".join(phrase.split())[:MAX_LENGTH].strip()
        if short:
            cleaned.setdefault(short.lower(), short)
        if len(cleaned) == MAX_PHRASES:
            break
    return list(cleaned.values())
