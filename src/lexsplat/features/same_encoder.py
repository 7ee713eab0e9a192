"""Whether an encoder is the one that features were made with.

Settings of its tokenizer that came after the features make no other encoder of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from itertools import chain, combinations
from pathlib import Path

from lexsplat.features.hub import TOKENIZER_SETTINGS, hash_of, loaded_files, local_folder
from lexsplat.features.text import TextTower
from lexsplat.runtime.errors import ModelError


def check_encoder(name: str, content_hash: str, needed: str | None) -> None:
    """Refuse an encoder whose hash is not that of the features; ``needed`` is None if that is unknown.

    Raises:
        ModelError: It is another one.
    """
    if needed in (None, content_hash):
        return
    folder = local_folder(name)
    if folder is None or needed not in _earlier_hashes(folder):
        raise ModelError(
            name,
            expected="the encoder that the scene was built with",
            found="another one",
            remedy="give the right one with --clip, or build the scene again with this one",
        )


def under_hash_of_features(name: str, tower: TextTower, needed: str | None) -> TextTower:
    """A text tower with the hash of the features, under which its embeddings are kept.

    Raises:
        ModelError: As `check_encoder`.
    """
    check_encoder(name, tower.content_hash, needed)
    if needed in (None, tower.content_hash):
        return tower
    tower = copy(tower)
    tower.content_hash = str(needed)
    return tower


def _earlier_hashes(folder: Path) -> Iterator[str]:
    """Hashes of a CLIP without some of the settings beside its tokenizer's vocabulary, which may have come later."""
    files = loaded_files(folder, "clip")
    settings = [path for path in files if path.name in TOKENIZER_SETTINGS]
    for late in chain.from_iterable(combinations(settings, count + 1) for count in range(len(settings))):
        yield hash_of([path for path in files if path not in late])
