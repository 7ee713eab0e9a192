"""Small scenes for tests of libraries: five balls, each of them a thing that is known by its name.

The text embeddings are random directions, one for each text, and are cached in the scene folder as a build's are: no
model is needed for everyday words, and what a scene holds is known from how it was made.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from lexsplat.codebook import Codebook
from lexsplat.features.text import TextCache, TextTower, load_text
from lexsplat.language.fields import CodeField
from lexsplat.language.segments import Segments
from lexsplat.queries.everyday import everyday_words
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.library import COMPARED
from lexsplat.scenes.library.records import read_record, write_record
from support.language_scene import make_scene

DIMENSIONS = 96
THINGS = ("apple", "mug", "banana", "vase", "lamp")
OTHERS = ("chair", "bottle", "candle", "clock", "basket")


def embedding(text: str, encoder: str) -> torch.Tensor:
    """A direction of its own for each text and encoder."""
    seed = int.from_bytes(hashlib.blake2b(f"{encoder} {text}".encode(), digest_size=4).digest(), "big")
    return torch.nn.functional.normalize(
        torch.from_numpy(np.random.default_rng(seed).normal(size=DIMENSIONS)), dim=0
    )


class Tower:
    """A text encoder of random directions."""

    def __init__(self, encoder: str) -> None:
        self.content_hash = encoder

    def encode_text(self, prompts: Sequence[str]) -> torch.Tensor:
        return torch.stack([embedding(prompt, self.content_hash) for prompt in prompts]).float()


def write_scene(
    path: Path, things: Sequence[str] = THINGS, encoder: str = "abc", build: int = 1, segments: bool = False
) -> Path:
    """A finished scene folder.

    Args:
        path: The folder.
        things: Names of the five balls, everyday words.
        encoder: Hash of the encoder.
        build: Number of the build: another one is a rebuilt scene.
        segments: Whether each ball is a segment, so that the index can answer.
    """
    assert set(things) <= set(everyday_words())
    made = make_scene(per_ball=40)
    units = torch.stack([embedding(thing, encoder) for thing in things]).float()
    count = len(made.labels)
    labels = torch.from_numpy(made.labels)
    balls = Segments(labels, torch.ones(count), torch.arange(len(things))[None]) if segments else None
    field = CodeField(
        Codebook(units),
        labels.to(torch.uint8)[:, None],
        torch.ones(count, 1),
        torch.zeros(count),
        segments=balls,
    )
    folder = SceneFolder(path)
    path.mkdir(parents=True, exist_ok=True)
    folder.record["config"] = {"clip": f"models/{encoder}"}
    folder.write_gaussians(made.gaussians)
    folder.write_cameras({f"{name}.png": (camera, "train") for name, camera in made.cameras.items()})
    write_tensors(folder.language_path, field.tensors(), {**field.metadata(), "reconstruction": f"r{build}"})
    folder.finish("reconstruct", f"r{build}", 0.0)
    folder.finish("features", "f", 0.0, clip_hash=encoder)
    folder.finish("language", f"l{build}", 0.0)
    TextCache(path / "checkpoints" / "texts").encode(encoder, COMPARED, lambda: Tower(encoder))
    return path


def copied(rooms: Path, target: Path) -> Path:
    """A copy of scenes and their library whose records do not name the originals."""
    shutil.copytree(rooms, target)
    for path in (target / "library" / "scenes").glob("*.json"):
        record = read_record(path)
        record = dataclasses.replace(record, path=record.path.replace(str(rooms), str(target)))
        write_record(record, path)
        tensors, _ = read_tensors(path.with_name(record.codes_file))
        write_tensors(path.with_name(record.codes_file), tensors, {"record": json.dumps(record.sealed())})
    return target


def install(patch) -> None:
    """Take these encoders in place of models: "models/abc" has the hash "abc"."""

    def load(name: str, *rest) -> TextTower:
        return load_text(name, *rest) if name == "bundled" else Tower(Path(name).name)

    for module in ("lexsplat.scenes.library.library", "lexsplat.scenes.scene"):
        patch.setattr(f"{module}.load_text", load)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def hits(library: Library, phrase: str) -> list[str]:
    return [hit.scene for hit in library.search(phrase).hits]
