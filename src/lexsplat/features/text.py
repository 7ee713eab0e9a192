"""Cache of text embeddings on disk: known prompts need no encoder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from lexsplat.features.hub import model_folder
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import digest

log = logging.getLogger("lexsplat")

_MAX_STORED = 10_000
"""Texts in one file, at most; further ones are encoded each time."""


class TextTower(Protocol):
    """What questions need of an encoder."""

    content_hash: str

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to unit embeddings ``[B, D]``."""
        ...


def load_text(name: str, device: torch.device | str = "cpu") -> TextTower:
    """The text tower of a CLIP-like encoder by name, folder, or "bundled".

    Raises:
        ModelError: If it is not available and cannot be downloaded, or is not a CLIP-like model.
    """
    if name in ("bundled", "embedded"):
        from lexsplat.features.clip_text import ClipText

        return ClipText(model_folder(name, "clip"), device)
    from lexsplat.features.encoders import load_clip

    return load_clip(name, device)


def encode_each(encoder: TextTower, texts: Sequence[str]) -> Tensor:
    """Embeddings ``[T, D]`` of texts, encoded one by one: in a batch, the last bits depend on the other texts."""
    return torch.cat([encoder.encode_text([text]) for text in texts])


class TextCache:
    """Embeddings of prompts by model and prompt.

    One file per model, ``text-HASH.safetensors``, read once. A damaged file is replaced.

    Args:
        folder: Folder of the files; created on the first write.
        writable: Whether new embeddings are stored.
    """

    def __init__(self, folder: Path, *, writable: bool = True) -> None:
        self._folder, self._writable = Path(folder), writable
        self._known: dict[str, dict[str, Tensor]] = {}

    def encode(self, content_hash: str, prompts: Sequence[str], encoder: Callable[[], TextTower]) -> Tensor:
        """Embeddings ``[P, D]`` of prompts, float32, unit length.

        Args:
            content_hash: The model's hash, as recorded with the features.
            prompts: Texts; repeated ones are encoded once.
            encoder: Returns the model; called only for new prompts.

        Raises:
            ValueError: If there is no prompt, one is empty, or the model has another hash.
        """
        if not prompts or any(not prompt.strip() for prompt in prompts):
            raise ValueError("prompts must be one or more texts that are not empty")
        known = self._read(content_hash)
        new = [prompt for prompt in dict.fromkeys(prompts) if prompt not in known]
        if new:
            model = encoder()
            if model.content_hash != content_hash:
                raise ValueError(f"{model.content_hash} is not the model of the features ({content_hash})")
            known.update(zip(new, encode_each(model, new)))
            if len(known) > _MAX_STORED:
                found = torch.stack([known[prompt] for prompt in prompts])
                for prompt in new:
                    del known[prompt]
                return found
            try:
                if self._writable:
                    self._write(content_hash, known)
            except OSError as error:  # the cache is optional
                log.warning("%s: text embeddings are not cached (%s)", self._folder, error.strerror)
        return torch.stack([known[prompt] for prompt in prompts])

    def _path(self, content_hash: str) -> Path:
        return self._folder / f"text-{content_hash}.safetensors"

    def _read(self, content_hash: str) -> dict[str, Tensor]:
        if content_hash not in self._known:
            found: dict[str, Tensor] = {}
            try:
                tensors, prompts = read_tensors(self._path(content_hash))
                found = {prompts[key]: vector for key, vector in tensors.items()}
            except (FileFormatError, KeyError):
                pass  # a damaged cache counts as empty
            sound = all(
                v.ndim == 1 and v.dtype == torch.float32 and v.isfinite().all() for v in found.values()
            )
            uniform = len({len(vector) for vector in found.values()}) <= 1 if sound else False
            self._known[content_hash] = found if uniform else {}
        return self._known[content_hash]

    def _write(self, content_hash: str, known: dict[str, Tensor]) -> None:
        # Tensors are named by hashes: prompts may contain any character, and "__metadata__" is reserved.
        keys = {digest([prompt.encode()], 16): prompt for prompt in known}
        write_tensors(self._path(content_hash), {key: known[prompt] for key, prompt in keys.items()}, keys)
