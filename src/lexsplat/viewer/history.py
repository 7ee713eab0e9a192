"""What the viewer remembers of a scene between visits: questions asked, and the vocabulary."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field
from pathlib import Path

from lexsplat.runtime.errors import LexsplatError
from lexsplat.runtime.files import read_json, write_json
from lexsplat.viewer.vocabulary import clean_phrases, default_vocabulary

MAX_HISTORY = 50

logger = logging.getLogger("lexsplat")


@dataclass
class Memory:
    """History and vocabulary of a scene, kept in ``viewer.json`` of its folder where that can be written.

    Args:
        path: The file; none keeps nothing.
        history: Questions, the latest first.
        vocabulary: Phrases of "what is this?"; none takes ``default``.
        default: What the vocabulary starts with, and comes back to.
    """

    path: Path | None = None
    history: list[str] = field(default_factory=list)
    vocabulary: list[str] = field(default_factory=list)
    default: list[str] = field(default_factory=default_vocabulary)

    def __post_init__(self) -> None:
        self.vocabulary = self.vocabulary or list(self.default)

    @classmethod
    def load(cls, folder: Path | None, clip: str = "") -> Memory:
        """The memory of a scene folder; a damaged file is told in the log and replaced at the next question."""
        default = default_vocabulary(clip)
        if folder is None:
            return cls(default=default)
        memory = cls(folder / "viewer.json" if os.access(folder, os.W_OK) else None, default=default)
        path = folder / "viewer.json"
        if not path.is_file():
            return memory
        try:
            content = read_json(path)
            if not isinstance(content, dict):
                raise ValueError("not an object")
            history, vocabulary = content.get("history", []), content.get("vocabulary", [])
            if not all(isinstance(phrase, str) for phrase in [*history, *vocabulary]):
                raise ValueError("phrases must be strings")
        except (LexsplatError, ValueError, TypeError) as error:
            logger.warning("%s: not used: %s", path, error)
            return memory
        memory.history = clean_phrases(history)[:MAX_HISTORY]
        memory.vocabulary = clean_phrases(vocabulary) or default
        return memory

    def remember(self, phrase: str) -> None:
        """Put a question first in the history."""
        self.history = clean_phrases([phrase, *self.history])[:MAX_HISTORY]
        self._save()

    def set_vocabulary(self, phrases: list[str]) -> None:
        """Replace the vocabulary; nothing in it brings the default back."""
        self.vocabulary = clean_phrases(phrases) or list(self.default)
        self._save()

    def _save(self) -> None:
        if self.path is None:
            return
        try:
            own = {} if self.vocabulary == self.default else {"vocabulary": self.vocabulary}
            write_json(self.path, {"history": self.history, **own})
        except OSError as error:  # a full disk must not stop the viewing
            logger.warning("%s: not saved: %s", self.path, error.strerror or error)
            self.path = None
