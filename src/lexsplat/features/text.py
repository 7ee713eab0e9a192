"""Text embeddings: from the lightest tower that has them, and from a cache on disk for known words."""

from __future__ import annotations

import json
import logging
import math
import os
import time
import weakref
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from lexsplat.features.hub import model_folder
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.user_cache import user_cache

log = logging.getLogger("lexsplat")

_MAX_STORED = 10_000
"""Texts in one file, at most; the ones that came first are forgotten."""
_MAX_LENGTH = 1_000
"""Characters of a stored text, at most; longer ones are encoded each time."""
_WRITES_APART = 10.0
"""Seconds between two writes of a file, at least: it is written whole, 20 MB where it is full."""


class TextTower(Protocol):
    """Text side of an encoder, which is all that queries need."""

    content_hash: str

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to unit embeddings ``[B, D]``."""


def load_text(name: str, device: torch.device | str = "cpu") -> TextTower:
    """The text tower of a CLIP-like encoder by name, folder, or "bundled".

    A CLIP of the original architecture is computed by `ClipText`. Whatever that does not know is loaded, or refused,
    by transformers, whose import alone takes seconds.

    Raises:
        ModelError: If it is not available and cannot be downloaded, or is not a CLIP-like model.
    """
    from lexsplat.features.clip_text import open_clip_text

    tower = open_clip_text(model_folder(name, "clip"), name, device)
    if tower is not None:
        return tower
    from lexsplat.features.encoders import load_clip

    return load_clip(name, device)


def encode_each(encoder: TextTower, texts: Sequence[str], listener: Listener = silent) -> Tensor:
    """Embeddings ``[T, D]`` of texts, encoded one by one: in a batch, the last bits depend on the other texts.

    Args:
        encoder: The model.
        texts: The texts.
        listener: Receives events of stage "words".
    """
    found = []
    for done, text in enumerate(texts, start=1):
        found.append(encoder.encode_text([text]))
        listener(Event("words", done, len(texts)))
    return torch.cat(found)


class TextCache:
    """Embeddings of prompts by model and prompt, in one or more folders.

    A folder has one file per model, ``text-HASH.safetensors``, which is read once. A damaged file counts as empty.
    New texts are written at once. Those that follow within `_WRITES_APART` seconds wait for the next write, or until
    the cache is let go or the process ends.

    Args:
        *folders: Folders of the files; created on the first write. What is asked is kept in each that can be written.
        read_only: A folder that is read, too, and never written.
    """

    def __init__(self, *folders: Path, read_only: Path | None = None) -> None:
        self._written = [_store(Path(folder)) for folder in folders]
        self._read = [*self._written, *([] if read_only is None else [_store(read_only)])]

    def encode(
        self,
        content_hash: str,
        prompts: Sequence[str],
        encoder: Callable[[], TextTower],
        listener: Listener = silent,
    ) -> Tensor:
        """Embeddings ``[P, D]`` of prompts, float32, unit length.

        Args:
            content_hash: The model's hash, as recorded with the features.
            prompts: Texts; repeated ones are encoded once.
            encoder: Returns the model; called only for new prompts.
            listener: See `encode_each`.

        Raises:
            ValueError: If there is no prompt, one is empty, or the model has another hash.
        """
        if not prompts or any(not prompt.strip() for prompt in prompts):
            raise ValueError("prompts must be one or more texts that are not empty")
        wanted = list(dict.fromkeys(prompts))
        found: dict[str, Tensor] = {}
        for store in reversed(self._read):
            known = store.read(content_hash)
            found.update((each, vector) for each in wanted if (vector := known.get(each)) is not None)
        if len({len(vector) for vector in found.values()}) > 1:
            found = {}  # one of the files was made by something else
        new = [prompt for prompt in wanted if prompt not in found]
        if new:
            listener(Event("words", 0, len(new)))  # before the model is loaded
            model = encoder()
            if model.content_hash != content_hash:
                raise ValueError(f"{model.content_hash} is not the model of the features ({content_hash})")
            vectors = encode_each(model, new, listener)
            if any(len(vector) != vectors.shape[1] for vector in found.values()):
                new, vectors = wanted, encode_each(model, wanted, listener)
            found.update(zip(new, vectors))
        for store in self._written:  # in one order, so that files do not depend on what was known
            store.add(content_hash, {prompt: found[prompt] for prompt in wanted})
        return torch.stack([found[prompt] for prompt in prompts])

    def write(self) -> None:
        """Write the texts that wait."""
        for store in self._written:
            store.write()


class _Store:
    """The files of one folder. A folder that cannot be written is only read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, dict[str, Tensor]] = {}
        self._written: dict[str, float] = {}
        self._unwritten: set[str] = set()
        weakref.finalize(self, _write_rest, folder, self._known, self._unwritten)

    def read(self, content_hash: str) -> dict[str, Tensor]:
        """The stored embeddings by text."""
        if content_hash not in self._known:
            try:
                self._known[content_hash] = _read(_path(self._folder, content_hash))
            except (FileFormatError, KeyError, ValueError, RecursionError):
                self._known[content_hash] = {}  # a damaged cache counts as empty
        return self._known[content_hash]

    def add(self, content_hash: str, found: dict[str, Tensor]) -> None:
        """Store new texts, and drop the oldest ones if there are too many."""
        known, width = self.read(content_hash), len(next(iter(found.values())))
        if any(len(vector) != width for vector in islice(known.values(), 1)):  # all are as wide as the first
            known.clear()
        new = {text: v for text, v in found.items() if text not in known and len(text) <= _MAX_LENGTH}
        if not new:
            return
        place = next(folder for folder in (self._folder, *self._folder.parents) if folder.exists())
        if not os.access(place, os.W_OK):
            return
        known.update(new)
        for text in list(known)[:-_MAX_STORED]:
            known.pop(text, None)  # unless another thread has dropped it
        if time.monotonic() < self._written.get(content_hash, -math.inf) + _WRITES_APART:
            self._unwritten.add(content_hash)
            return
        _write(self._folder, content_hash, known)
        self._unwritten.discard(content_hash)
        self._written[content_hash] = time.monotonic()

    def write(self) -> None:
        """Write the texts that wait."""
        _write_rest(self._folder, self._known, self._unwritten)


_stores: weakref.WeakValueDictionary[Path, _Store] = weakref.WeakValueDictionary()
"""Those in use: scenes of one process read the texts of each other that wait to be written."""


def _store(folder: Path) -> _Store:
    return _stores.setdefault(folder.absolute(), _Store(folder))


def _path(folder: Path, content_hash: str) -> Path:
    return folder / f"text-{content_hash}.safetensors"


def _write(folder: Path, content_hash: str, known: dict[str, Tensor]) -> None:
    try:
        texts, rows = zip(*known.copy().items())  # other threads may add to it meanwhile
        vectors = torch.stack(rows)
        facts = {"texts": json.dumps(texts), "width": str(vectors.shape[1])}
        write_tensors(_path(folder, content_hash), {"embeddings": vectors}, facts, lasting=False)
    except OSError as error:  # the cache is optional
        log.warning("%s: text embeddings are not cached (%s)", folder, error.strerror)


def _write_rest(folder: Path, known: dict[str, dict[str, Tensor]], unwritten: set[str]) -> None:
    """Write what waits, unless its folder has gone."""
    for content_hash in sorted(unwritten):
        if folder.is_dir():
            _write(folder, content_hash, known[content_hash])
    unwritten.clear()


def _read(path: Path) -> dict[str, Tensor]:
    """The texts of a file and their embeddings."""
    tensors, facts = read_tensors(path)
    vectors, texts = tensors["embeddings"], json.loads(facts["texts"])
    if vectors.ndim != 2 or vectors.dtype != torch.float32 or not bool(vectors.isfinite().all()):
        raise ValueError("embeddings must be [T, D], float32 and finite")
    if str(vectors.shape[-1]) != facts.get("width", str(vectors.shape[-1])):
        raise ValueError("embeddings of another width than was written")
    if (
        not isinstance(texts, list)
        or len(texts) != len(vectors)
        or not all(isinstance(t, str) for t in texts)
    ):
        raise ValueError("as many texts as embeddings expected")
    return dict(zip(texts, vectors))


def texts_of_scene(folder: Path, *, shipped: bool, common: Path | None = None) -> TextCache:
    """The cache of a scene: its own folder, so that a scene carries its words, and that of the user for all scenes.

    Args:
        folder: The scene's own folder of texts.
        shipped: Whether it belongs to the package and is never written.
        common: A folder of texts that ships with the package, for scenes with the same encoder; never written.
    """
    try:
        users = [user_cache() / "texts"]
    except RuntimeError:
        users = []
    return TextCache(*users, read_only=folder) if shipped else TextCache(folder, *users, read_only=common)
