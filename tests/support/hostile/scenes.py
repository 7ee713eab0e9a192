"""Readers of scene folders: record, cameras, language, code maps, journal of edits."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.images import png
from support.hostile.language import small_field
from support.hostile.registry import Reader, finite, reader
from support.hostile.splats import check_gaussians, small_gaussians


def check_open_scene(scene: Any) -> None:
    """A valid scene: Gaussians with matching language, views inside the folder, finite answers."""
    check_gaussians(scene.gaussians)
    finite(*(t for t in scene.field.tensors().values()))
    assert len(scene.field.uncertainties) == len(scene.gaussians)
    finite(scene.field.code_probabilities(), scene.field.uncertainties)
    for name, view in scene.views.items():
        finite(view.camera.K, view.camera.viewmat)
        assert view.split in ("train", "test")
        path = scene.folder.code_map_path(name).resolve()
        assert path.is_relative_to(scene.folder.root.resolve()), "a name points outside the folder"


def make_folder(folder: Path, *, trained: bool = False) -> None:
    from lexsplat.runtime.files import write_tensors
    from lexsplat.scenes.folder import SceneFolder
    from support.written_captures import cameras_around

    made = SceneFolder(folder)
    names = ["a.png", "дом/b.png", "c.jpg"]
    cameras = cameras_around(3)
    made.write_cameras(
        {name: (camera, "test" if name[0] == "c" else "train") for name, camera in zip(names, cameras)}
    )
    made.write_gaussians(small_gaussians())
    stored = small_field(trained)
    write_tensors(made.language_path, stored.tensors(), {**stored.metadata(), "reconstruction": "r1"})
    for name in names:
        made.write_code_map(name, np.arange(48, dtype=np.uint8).reshape(6, 8) % 3)
    made.record["config"] = {"clip": "bundled", "downscale": 1.0}
    made.record |= {
        "capture": "/nowhere",
        "warnings": ["one"],
        "provenance": {"lexsplat": "0", "sources": {}},
    }
    for stage in ("reconstruct", "features", "codebook", "language"):
        made.finish(stage, f"{stage[0]}1", 1.0, **({"clip_hash": "00"} if stage == "features" else {}))


def open_folder(folder: Path) -> Any:
    from lexsplat.scenes.facts import scene_facts
    from lexsplat.scenes.scene import open_scene

    scene = open_scene(folder, device="cpu")
    scene_facts(scene.folder)
    return scene


@reader
def scene_folder() -> Reader:
    return Reader(
        make_folder, open_folder, check_open_scene,
        {
            "scene.json": lambda content, rng: mutate.json_file(content, rng, 30, 120),
            "cameras.json": lambda content, rng: mutate.json_file(content, rng, 30, 120),
            "gaussians.ply": lambda content, rng: mutate.binary(content, rng, 40, 60),
            "language.safetensors": language_file,
        },
        exact=("gaussians.ply", "language.safetensors"),
    )  # fmt: skip


def language_file(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
    yield from mutate.safetensors(content, rng, 40, 80)
    yield from mutate.tensors(content, rng, 60)


@reader
def trained_scene_folder() -> Reader:
    return Reader(
        lambda folder: make_folder(folder, trained=True), open_folder, check_open_scene,
        {"language.safetensors": lambda content, rng: mutate.tensors(content, rng, 60)},
    )  # fmt: skip


@reader
def code_maps() -> Reader:
    from lexsplat.scenes.folder import SceneFolder

    def check(codes: Any) -> None:
        assert codes.dtype == np.uint8
        assert codes.ndim == 2
        assert codes.size <= 10_000

    return Reader(
        make_folder, lambda folder: SceneFolder(folder).read_code_map("a.png"), check,
        {"codes/a.png": lambda content, rng: png(content, rng, 200)}, exact=("codes/a.png",),
    )  # fmt: skip


@reader
def journal() -> Reader:
    import torch

    from lexsplat.queries.selection import Selection
    from lexsplat.scenes.editing import Editor, Motion
    from lexsplat.scenes.scene import open_scene

    kept: dict[str, Any] = {}

    def make(folder: Path) -> None:
        make_folder(folder / "scene")
        kept["scene"] = open_scene(folder / "scene", device="cpu")
        editor = Editor(kept["scene"], folder / "edits.jsonl")

        def choose(*numbers: int) -> Selection:
            gaussians = editor.scene.gaussians
            mask = torch.tensor([i in numbers for i in range(len(gaussians))])
            return Selection(gaussians, editor.scene.cameras, mask, mask.float(), phrase="дом")

        editor.recolor(choose(0, 1), (0.2, 0.4, 0.6), 0.5)
        editor.duplicate(choose(2), Motion(translation=(0.1, 0, 0), scale=1.5))
        editor.delete(choose(0))
        editor.undo()
        editor.move(choose(1), Motion(rotation=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])))

    def read(folder: Path) -> Any:
        return Editor(kept["scene"], folder / "edits.jsonl").scene

    def lines(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.truncated(content, 150)
        yield from mutate.flipped(content, rng, 80)
        yield from mutate.shifted(content, rng, 60)
        yield from mutate.foreign(content)
        parts = content.decode().splitlines()
        for row, line in enumerate(parts):
            yield "lines", "\n".join([*parts[:row], *parts[row + 1 :], ""]).encode()
            yield "lines", "\n".join([*parts[:row], line, *parts[row:], ""]).encode()
            for kind, changed in mutate.structure(json.loads(line), rng, 30):
                yield (
                    kind,
                    "\n".join(
                        [*parts[:row], changed.decode("utf-8", "replace"), *parts[row + 1 :], ""]
                    ).encode(),
                )

    return Reader(make, read, check_open_scene, {"edits.jsonl": lines})
