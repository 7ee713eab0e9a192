"""Readers of external features, of the feature and text caches, and of model folders."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.captures import load, make_transforms
from support.hostile.registry import Reader, finite, grid, reader


def check_features(maps: Any) -> None:
    for name in maps:
        finite(maps[name].clip)
        assert maps[name].clip.ndim == 3
        assert maps[name].clip.numel() <= 100_000
        if maps[name].dino is not None:
            finite(maps[name].dino)


def features_of(write: Callable[[Path], None], **mutations: Any) -> Reader:
    kept: dict[str, Any] = {}

    def make(folder: Path) -> None:
        make_transforms(folder / "capture")
        kept["capture"] = load(folder / "capture")
        kept["capture"] = replace(kept["capture"], views={"a.png": kept["capture"].views["a.png"]})
        write(folder)

    def read(folder: Path) -> Any:
        from lexsplat.features import load_external_features

        return load_external_features(folder, kept["capture"])

    return Reader(make, read, check_features, mutations)


@reader
def npy_features() -> Reader:
    def arrays(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.binary(content, rng, 200, 300)
        shapes = (b"(3, 4, 5000000000)", b"(-3, 4, 5)", b"(3,)", b"(3, 4, 10**12)", b"__import__('os')")
        for shape in shapes:
            yield "counts", content.replace(b"(3, 4, 5)", shape)
        for kind in (b"|O8", b"<c8", b"<U4", b"<i4", b">f4"):
            yield "counts", content.replace(b"<f4", kind)

    return features_of(lambda folder: np.save(folder / "a.npy", grid(3, 4, 5)), **{"a.npy": arrays})


@reader
def segment_features() -> Reader:
    def write(folder: Path) -> None:
        np.save(folder / "a_f.npy", grid(4, 5))
        np.save(folder / "a_s.npy", np.arange(24).reshape(2, 3, 4) % 5 - 1)

    return features_of(
        write, **{name: lambda c, r: mutate.binary(c, r, 100, 150) for name in ("a_f.npy", "a_s.npy")}
    )


@reader
def safetensors_features() -> Reader:
    import torch
    from safetensors.torch import save_file

    def write(folder: Path) -> None:
        arrays = {"clip": torch.from_numpy(grid(3, 4, 5)), "dino": torch.from_numpy(grid(3, 4, 2))}
        save_file(arrays, folder / "a.safetensors")

    def changes(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.safetensors(content, rng, 60, 150)
        yield from mutate.tensors(content, rng, 80)

    return features_of(write, **{"a.safetensors": changes})


@reader
def feature_cache() -> Reader:
    import torch

    from lexsplat.features.cache import (
        is_stored,
        read_crops,
        read_grid,
        read_levels,
        write_crops,
        write_grid,
    )
    from lexsplat.features.pyramid import CropLevel

    def make(folder: Path) -> None:
        levels = [
            CropLevel(8, np.array([0, 8]), np.array([0]), True),
            CropLevel(16, np.array([0]), np.array([0]), True),
        ]
        write_crops(folder / "crops", levels, torch.from_numpy(grid(3, 6)), (16, 8))
        write_grid(folder / "grid", torch.from_numpy(grid(3, 4, 5)))

    def read(folder: Path) -> Any:
        is_stored(folder / "crops")
        return (
            read_crops(folder / "crops", 4, 2),
            read_levels(folder / "crops", 4, 2)[0],
            read_grid(folder / "grid", 4, 2),
        )

    def check(result: Any) -> None:
        finite(*result)
        assert result[0].shape[:2] == (2, 4)
        assert result[2].shape[:2] == (2, 4)

    def changes(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.safetensors(content, rng, 30, 80)
        yield from mutate.tensors(content, rng, 40)

    return Reader(make, read, check, {"crops": changes, "grid": changes})


@reader
def text_cache() -> Reader:
    import torch

    from lexsplat.features.text import TextCache

    class Encoder:
        name, content_hash = "test", "00"

        def encode_text(self, texts: list[str]) -> Any:
            return torch.nn.functional.normalize(torch.ones(len(texts), 4), dim=-1)

    def read(folder: Path) -> Any:
        return TextCache(folder).encode("00", ["red apple", "床"], Encoder)

    def make(folder: Path) -> None:
        read(folder)

    def check(result: Any) -> None:
        finite(result)
        assert result.shape == (2, 4)

    def changes(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.safetensors(content, rng, 60, 100)
        yield from mutate.tensors(content, rng, 60)

    return Reader(make, read, check, {"text-00.safetensors": changes})


@reader
def model_folder() -> Reader:
    """The files that determine whether a folder is a model: its configuration and its index of shards."""
    from lexsplat.features.hub import model_folder as find

    def make(folder: Path) -> None:
        model = folder / "model"
        model.mkdir()
        (model / "config.json").write_text(json.dumps({"model_type": "clip"}))
        (model / "model.safetensors.index.json").write_text(
            json.dumps({"weight_map": {"a": "m1.safetensors"}})
        )
        (model / "m1.safetensors").write_bytes(b"")

    def check(found: Any) -> None:
        assert found.is_dir()

    return Reader(make, lambda folder: find(str(folder / "model"), "dino"), check,
                  {"model/model.safetensors.index.json": lambda c, r: mutate.json_file(c, r, 30, 120)})  # fmt: skip
