"""Every reader of lexsplat with a sound input, what a right result is, and the mutations to try on it.

Run by test_hostile_inputs.py in processes of their own::

    python hostile_readers.py WORK_FOLDER REPORT.json READER [READER ...]

Once everything is imported and every reader has read its sound input, the process may take one more gigabyte of
memory (RLIMIT_DATA) and each input `SECONDS`. What a reader raises must be an error of errors.py; what it returns
must pass the reader's check. Before each input its bytes and name are on disk, so that a crash can be traced.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import sys
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from support import hostile_mutations as mutate

os.environ.setdefault("OMP_NUM_THREADS", "1")

SECONDS = 5.0
GIGABYTE = 1 << 30
BASE_BYTES = 3 << 28
"""What the process takes before any input: torch, Numba's kernels, the other libraries."""


@dataclass
class Reader:
    """A reader and what to do to it.

    Args:
        make: Writes the sound input into a folder.
        read: Reads it.
        check: Raises AssertionError if what was read is not sound.
        mutations: By file, relative to the folder: what happens to it.
        exact: Files of which no part may be missing: cut off, they fail or say the same as the whole.
        value_errors: Whether ValueError is documented for damaged content.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    check: Callable[[Any], None]
    mutations: dict[str, Callable[[bytes, np.random.Generator], Iterator[mutate.Mutation]]]
    exact: tuple[str, ...] = ()
    value_errors: bool = False


READERS: dict[str, Callable[[], Reader]] = {}


def reader(make: Callable[[], Reader]) -> Callable[[], Reader]:
    READERS[make.__name__] = make
    return make


# -- what a right result is


def finite(*arrays: Any) -> None:
    for array in arrays:
        values = np.asarray(array)
        assert values.dtype.kind in "fiub", f"an array of {values.dtype}"
        assert np.isfinite(values).all(), "NaN or infinity came through"


def check_scene(scene: Any) -> None:
    """A capture: cameras that can be cameras, files inside the folder, points with colors."""
    assert scene.views
    assert set(scene.train_names).isdisjoint(scene.test_names)
    assert {*scene.train_names, *scene.test_names} == set(scene.views)
    root = scene.root.resolve()
    for name, view in scene.views.items():
        finite(view.camera.viewmat, view.camera.K)
        np.testing.assert_allclose(
            view.camera.viewmat[:3, :3] @ view.camera.viewmat[:3, :3].T, np.eye(3), atol=1e-5
        )
        assert np.abs(view.camera.viewmat).max() <= 1e7
        assert 0 < view.camera.width <= 65535
        assert view.image_path.resolve().is_relative_to(root)
        assert ".." not in Path(name).parts
        assert not Path(name).is_absolute()
    finite(scene.points, scene.point_colors)
    assert scene.points.shape == scene.point_colors.shape
    assert len(scene.points) <= 1000


def check_gaussians(gaussians: Any) -> None:
    """Gaussians that are finite and can be drawn."""
    import torch

    from lexsplat.geometry.cameras import look_at
    from lexsplat.rendering import render

    finite(*gaussians.tensors().values())
    finite(gaussians.scales, gaussians.opacities)
    assert len(gaussians) <= 10_000, "more Gaussians than the file can hold"
    camera = look_at([0.0, -3.0, 0.5], [0, 0, 0], [0, 0, 1], 12, 9, 0.8)
    with torch.no_grad():
        image = render(gaussians, camera).image
    finite(image)


def check_open_scene(scene: Any) -> None:
    """A scene folder: Gaussians and language that fit, views inside the folder, answers that are numbers."""
    check_gaussians(scene.gaussians)
    finite(*(t for t in scene.field.tensors().values()))
    assert len(scene.field.uncertainties) == len(scene.gaussians)
    finite(scene.field.code_probabilities(), scene.field.uncertainties)
    for name, view in scene.views.items():
        finite(view.camera.K, view.camera.viewmat)
        assert view.split in ("train", "test")
        path = scene.folder.code_map_path(name).resolve()
        assert path.is_relative_to(scene.folder.root.resolve()), "a name leads out of the folder"


# -- sound inputs


def small_gaussians(count: int = 4, degree: int = 1) -> Any:
    import torch

    from lexsplat.geometry.gaussians import gaussians_from_points

    rng = np.random.default_rng(3)
    made = gaussians_from_points(
        rng.normal(size=(count, 3)) * 0.4, rng.random((count, 3)), sh_degree=degree, opacity=0.7
    )
    return replace(made, shN=torch.from_numpy(rng.normal(size=tuple(made.shN.shape)) * 0.1).float())


def picture(path: Path, width: int = 64, height: int = 48, value: int = 90, mode: str = "RGB") -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.linspace(0, value, width * height).reshape(height, width).astype(np.uint8)
    image = Image.fromarray(ramp if mode == "L" else np.stack([ramp] * 3, -1))
    image.save(path)


def make_colmap(folder: Path) -> None:
    from support.written_captures import write_colmap

    write_colmap(folder, ["a.png", "дом/b.png", "c.png"])


def make_colmap_text(folder: Path) -> None:
    import pycolmap

    from support.written_captures import write_colmap

    model = write_colmap(folder, ["a.png", "дом/b.png", "c.png"])
    pycolmap.Reconstruction  # noqa: B018  (imported for its side effects: the formats' library is loaded once)
    cameras = ["# Camera list", "# Number of cameras: 2", "1 PINHOLE 64 48 60.0 60.0 32 24",
               "2 OPENCV 64 48 60 60 32 24 0.01 -0.02 0.001 0.0005"]  # fmt: skip
    images = ["# Image list", "# Number of images: 3, mean observations per image: 1"]
    points = ["# 3D point list", "# Number of points: 3, mean track length: 1"]
    for number, name in enumerate(["a.png", "дом/b.png", "c.png"], 1):
        images += [f"{number} 1 0.1 0 0 0.5 0.25 {number} {1 + number % 2} {name}", "1.5 2.5 1 3.5 4.5 -1"]
        points.append(f"{number} 0.{number} 0.2 -0.3 255 128 0 0.5 1 0")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (model / f"{name}.bin").unlink()
        (model / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def load(folder: Path) -> Any:
    from lexsplat.captures import load_capture

    return load_capture(folder)


@reader
def colmap_binary() -> Reader:
    names = ("cameras.bin", "images.bin", "points3D.bin")
    return Reader(
        make_colmap, load, check_scene,
        {f"sparse/0/{name}": lambda content, rng: mutate.binary(content, rng, 150) for name in names}
        | {"sparse/0/images.bin": colmap_images},
        exact=tuple(f"sparse/0/{name}" for name in names),
    )  # fmt: skip


def colmap_images(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
    yield from mutate.binary(content, rng, 200)
    for name in (*mutate.NAMES, "c.png", "дом/b.png", "./c.png", "дом//b.png", "дом/../c.png"):
        raw = name.encode("utf-8", "surrogatepass")
        yield "names", content.replace(b"a.png\0", raw + b"\0")


@reader
def colmap_text() -> Reader:
    names = ("cameras.txt", "images.txt", "points3D.txt")
    return Reader(
        make_colmap_text, load, check_scene,
        {f"sparse/0/{name}": lambda content, rng: mutate.text(content, rng, 150) for name in names},
    )  # fmt: skip


def make_transforms(folder: Path) -> None:
    from support.written_captures import write_transforms

    document = write_transforms(folder, ["a.png", "дом/b.png", "c.png"], k1=0.01, camera_model="OPENCV")
    document["frames"][0]["mask_path"] = "masks/a.png"
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    picture(folder / "masks" / "a.png", mode="L")


@reader
def transforms() -> Reader:
    return Reader(make_transforms, load, check_scene,
                  {"transforms.json": lambda content, rng: mutate.json_file(content, rng, 120, 900)})  # fmt: skip


def make_split(folder: Path) -> None:
    make_transforms(folder)
    (folder / "test_views.json").write_text(json.dumps(["a", "дом/b.png"]))


@reader
def split_file() -> Reader:
    return Reader(
        make_split, load, check_scene, {"test_views.json": lambda c, r: mutate.json_file(c, r, 40, 120)}
    )


@reader
def splat_ply() -> Reader:
    from lexsplat.scenes.formats.ply import write_ply
    from lexsplat.scenes.formats.reading import read_splats

    def headers(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        end = content.index(b"end_header\n") + 11
        yield from mutate.binary(content, rng, 250, 500)
        yield from mutate.overwritten(content, rng, 250, start=end)
        for kind, changed in mutate.text(content[:end], rng, 200, 0):
            yield kind, changed + content[end:]
        for count in (5, 10**6, 10**9, 2**63, 10**30):
            yield "counts", content.replace(b"element vertex 4", b"element vertex %d" % count)
        yield "foreign", point_cloud()

    return Reader(
        lambda folder: write_ply(small_gaussians(), folder / "a.ply"), lambda folder: read_splats(folder / "a.ply"),
        check_gaussians, {"a.ply": headers}, exact=("a.ply",),
    )  # fmt: skip


def point_cloud() -> bytes:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    return header.encode() + b"end_header\n" + np.zeros(6, "<f4").tobytes()


@reader
def splat() -> Reader:
    from lexsplat.scenes.formats.reading import read_splats
    from lexsplat.scenes.formats.splat import write_splat

    return Reader(
        lambda folder: write_splat(small_gaussians(), folder / "a.splat"),
        lambda folder: read_splats(folder / "a.splat"), check_gaussians,
        {"a.splat": lambda content, rng: mutate.binary(content, rng, 200)},
    )  # fmt: skip


def compressed(ending: str, count: int) -> Callable[[], Reader]:
    def make() -> Reader:
        from lexsplat.scenes.formats.compressed import COMPRESSED, write_compressed
        from lexsplat.scenes.formats.reading import read_splats

        return Reader(
            lambda folder: write_compressed(small_gaussians(), folder / f"a{ending}", COMPRESSED[ending]),
            lambda folder: read_splats(folder / f"a{ending}"), check_gaussians,
            {f"a{ending}": lambda content, rng: mutate.binary(content, rng, count, 150)},
        )  # fmt: skip

    return make


READERS["spz"] = compressed(".spz", 90)
READERS["compressed_ply"] = compressed(".compressed.ply", 90)
READERS["ksplat"] = compressed(".ksplat", 90)


# -- language and the scene folder


def small_field(trained: bool) -> Any:
    import torch

    from lexsplat.codebook import Codebook
    from lexsplat.language.fields import LiftedField, TrainedField

    generator = torch.Generator().manual_seed(0)
    clip, dino = torch.randn(3, 6, generator=generator), torch.randn(3, 4, generator=generator)
    codebook = Codebook(
        torch.nn.functional.normalize(clip, dim=1), torch.nn.functional.normalize(dino, dim=1)
    )
    if trained:
        return TrainedField.initial(small_gaussians(), codebook, generator=generator)
    codes = torch.tensor([[0, 1], [1, 2], [2, 0], [0, 2]], dtype=torch.uint8)
    return LiftedField(codebook, codes, torch.full((4, 2), 0.5), torch.linspace(0, 1, 4))


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
    from lexsplat.scenes.answers import scene_facts
    from lexsplat.scenes.scene import open_scene

    scene = open_scene(folder, device="cpu")
    scene_facts(scene.folder)
    return scene


@reader
def scene_folder() -> Reader:
    return Reader(
        make_folder, open_folder, check_open_scene,
        {
            "scene.json": lambda content, rng: mutate.json_file(content, rng, 60, 500),
            "cameras.json": lambda content, rng: mutate.json_file(content, rng, 60, 600),
            "gaussians.ply": lambda content, rng: mutate.binary(content, rng, 40, 60),
            "language.safetensors": language_file,
        },
        exact=("gaussians.ply", "language.safetensors"),
    )  # fmt: skip


def language_file(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
    yield from mutate.safetensors(content, rng, 100, 400)
    yield from mutate.tensors(content, rng, 150)


@reader
def trained_scene_folder() -> Reader:
    return Reader(
        lambda folder: make_folder(folder, trained=True), open_folder, check_open_scene,
        {"language.safetensors": lambda content, rng: mutate.tensors(content, rng, 200)},
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


def png(content: bytes, rng: np.random.Generator, count: int) -> Iterator[mutate.Mutation]:
    """PNG files with right checksums over wrong content, too: sizes, depths and color types that are not true."""
    yield from mutate.binary(content, rng, count)
    for number in range(count):
        data = bytearray(content)
        if number % 2:
            data[16 + 4 * (number % 4 // 2) : 20 + 4 * (number % 4 // 2)] = [
                b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\xff\xff", b"\0\1\0\0", b"\0\0\0\1",
            ][number // 4 % 6]  # fmt: skip
        else:
            data[24 + number // 2 % 5] = int(rng.integers(256))
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
        yield "sizes", bytes(data)


@reader
def codebook() -> Reader:
    from lexsplat.codebook import Codebook
    from lexsplat.runtime.files import read_tensors, write_tensors

    def check(book: Any) -> None:
        finite(book.clip, book.lambda_dino)
        assert book.clip.is_floating_point()

    return Reader(
        lambda folder: write_tensors(folder / "c", small_field(False).codebook.tensors(), {}),
        lambda folder: Codebook.from_tensors(read_tensors(folder / "c")[0]), check,
        {"c": lambda content, rng: [*mutate.safetensors(content, rng, 60, 150), *mutate.tensors(content, rng, 80)]},
        exact=("c",), value_errors=True,
    )  # fmt: skip


@reader
def checkpoints() -> Reader:
    """A damaged checkpoint is told and left aside; then the training must stand at its very beginning."""
    from lexsplat.language.methods.trained_settings import TrainedConfig
    from lexsplat.language.methods.trainer import FieldTrainer
    from lexsplat.runtime.checkpoints import Checkpoint
    from support.language_scene import make_scene

    scene = make_scene(per_ball=2, views=1, width=8, height=6)
    config = TrainedConfig(iterations=10, pixel_sample=8, smoothing_sample=4)

    def trainer() -> Any:
        return FieldTrainer(scene.gaussians, scene.codebook, config)

    def make(folder: Path) -> None:
        made = trainer()
        made.step(scene.cameras["view0"], scene.code_maps["view0"])
        Checkpoint(folder / "state", "inputs").save(made)

    fresh = trainer().state_dict()

    def read(folder: Path) -> tuple[bool, dict]:
        made = trainer()
        return Checkpoint(folder / "state", "inputs").resume(made), made.state_dict()

    def check(result: tuple[bool, dict]) -> None:
        import torch

        resumed, state = result
        assert {name: tuple(t.shape) for name, t in state.items() if name in fresh} == {
            name: tuple(t.shape) for name, t in fresh.items()
        }
        if resumed:
            finite(*(tensor for name, tensor in state.items() if name != "first_loss"))
            assert 0 <= int(state["iteration"]) <= 10
        else:
            assert state.keys() == fresh.keys()
            same = all(torch.equal(state[name].nan_to_num(), fresh[name].nan_to_num()) for name in fresh)
            assert same, "half a state was taken up"

    return Reader(
        make, read, check,
        {"state": lambda c, rng: [*mutate.safetensors(c, rng, 30, 120), *mutate.tensors(c, rng, 120)]},
    )  # fmt: skip


@reader
def reconstruction_checkpoints() -> Reader:
    """The same for the training of geometry."""
    from lexsplat.captures import load_capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
    from lexsplat.runtime.checkpoints import Checkpoint
    from support.tiny_capture import write_capture

    config = ReconstructionConfig(iterations=10, max_gaussians=5, sh_degree=1, exposure=True)
    points = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    kept: dict[str, Any] = {}

    def trainer(folder: Path) -> Any:
        if "scene" not in kept:
            kept["scene"] = load_capture(write_capture(folder / "capture", views=3, width=16, height=12))
        start = InitialPoints(points, np.full_like(points, 0.5), "capture", "")
        return Reconstructor(kept["scene"], config, start)

    def make(folder: Path) -> None:
        made = trainer(folder)
        made.step()
        Checkpoint(folder / "state", "inputs").save(made)
        kept["fresh"] = trainer(folder).state_dict()

    def read(folder: Path) -> tuple[bool, dict]:
        made = trainer(folder)
        return Checkpoint(folder / "state", "inputs").resume(made), made.state_dict()

    def check(result: tuple[bool, dict]) -> None:
        import torch

        resumed, state = result
        if resumed:
            finite(*(t for name, t in state.items() if "parameters" in name or "matrices" in name))
            assert len({len(t) for name, t in state.items() if name.startswith("parameters/")}) == 1
            assert 0 <= int(state["steps_done"]) <= 10
        else:
            same = all(
                torch.equal(state[n].nan_to_num(), kept["fresh"][n].nan_to_num()) for n in kept["fresh"]
            )
            assert state.keys() == kept["fresh"].keys()
            assert same, "half a state was taken up"

    return Reader(
        make, read, check,
        {"state": lambda c, rng: [*mutate.safetensors(c, rng, 30, 150), *mutate.tensors(c, rng, 150)]},
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
        yield from mutate.truncated(content, 250)
        yield from mutate.flipped(content, rng, 150)
        yield from mutate.shifted(content, rng, 60)
        yield from mutate.foreign(content)
        parts = content.decode().splitlines()
        for row, line in enumerate(parts):
            yield "lines", "\n".join([*parts[:row], *parts[row + 1 :], ""]).encode()
            yield "lines", "\n".join([*parts[:row], line, *parts[row:], ""]).encode()
            for kind, changed in mutate.structure(json.loads(line), rng, 120):
                yield (
                    kind,
                    "\n".join(
                        [*parts[:row], changed.decode("utf-8", "replace"), *parts[row + 1 :], ""]
                    ).encode(),
                )

    return Reader(make, read, check_open_scene, {"edits.jsonl": lines})


@reader
def viewer_memory() -> Reader:
    from lexsplat.viewer.history import History

    def make(folder: Path) -> None:
        (folder / "viewer.json").write_text(
            json.dumps({"history": ["red apple", "床"], "vocabulary": ["mug"]})
        )

    def check(history: Any) -> None:
        phrases = [*history.prompts, *history.vocabulary]
        assert all(isinstance(phrase, str) and phrase.strip() for phrase in phrases)
        json.dumps(phrases, ensure_ascii=False).encode("utf-8")

    return Reader(make, lambda folder: History.load(folder), check,
                  {"viewer.json": lambda c, r: mutate.json_file(c, r, 40, 200)})  # fmt: skip


@reader
def phrases() -> Reader:
    """Phrases as people and programs type them: the bytes are the phrase."""
    from lexsplat.queries.phrases import parse
    from lexsplat.queries.relevancy import check_prompts
    from lexsplat.scenes.answers import file_name

    def read(folder: Path) -> Any:
        raw = (folder / "phrase.txt").read_bytes().decode("utf-8", "surrogateescape")
        (phrase,) = check_prompts([raw])
        return phrase, str(parse(phrase)), file_name(phrase)

    def check(result: tuple[str, str, str]) -> None:
        assert result[0].strip()
        assert "/" not in result[2]
        assert result[2] not in ("", ".", "..")

    good = 'how many "salt and pepper" mugs on the largest book but not the red cup nearest to 床'
    return Reader(lambda folder: (folder / "phrase.txt").write_text(good) and None, read, check,
                  {"phrase.txt": lambda c, r: mutate.text(c, r, 150, 90)})  # fmt: skip


# -- pictures, masks, ground truth


def make_masks(folder: Path) -> None:
    make_colmap(folder)
    for prompt in ("red apple", "床"):
        picture(folder / "segmentations" / "a" / f"{prompt}.png", value=255, mode="L")


def read_truth(folder: Path) -> Any:
    from lexsplat.captures import load_annotations, load_capture
    from lexsplat.captures.ground_truth.layouts import load_ground_truth

    scene = load_capture(folder)
    ground_truth = load_annotations(scene)
    return ground_truth, [
        load_ground_truth(scene.views[view], mask)
        for view, masks in ground_truth.masks.items()
        for mask in masks.values()
    ]


def check_truth(result: Any) -> None:
    ground_truth, masks = result
    assert all(mask.dtype == bool and mask.ndim == 2 and mask.size <= 64 * 48 * 64 for mask in masks)
    for boxes in ground_truth.boxes.values():
        finite(*boxes.values())


@reader
def masks() -> Reader:
    name = "segmentations/a/red apple.png"
    return Reader(make_masks, read_truth, check_truth, {name: lambda c, r: png(c, r, 120)}, exact=(name,))


def make_ovs3d(folder: Path) -> None:
    make_masks(folder)
    (folder / "segmentations" / "classes.txt").write_text("red apple\n床\n", encoding="utf-8")


@reader
def ovs3d() -> Reader:
    def lists(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.text(content, rng, 80)
        for name in mutate.NAMES:
            yield "names", content + name.encode("utf-8", "surrogatepass") + b"\n"

    return Reader(make_ovs3d, read_truth, check_truth, {"segmentations/classes.txt": lists})


def make_lerf(folder: Path) -> None:
    from support.written_captures import write_colmap

    write_colmap(folder, ["frame_00001.png", "frame_00002.png"])
    entry = {"category": "床", "bbox": [3, 4, 20, 30], "segmentation": [[3, 4], [20, 5], [18, 30], [3, 28]]}
    document = {
        "info": {"name": "frame_00001.png", "width": 64, "height": 48, "depth": 3},
        "objects": [entry],
    }
    (folder / "label").mkdir()
    (folder / "label" / "frame_00001.json").write_text(json.dumps(document), encoding="utf-8")


@reader
def lerf_ovs() -> Reader:
    return Reader(make_lerf, read_truth, check_truth,
                  {"label/frame_00001.json": lambda c, r: mutate.json_file(c, r, 120, 500)})  # fmt: skip


def pictures_of(ending: str, **options: Any) -> Callable[[], Reader]:
    def make(folder: Path) -> None:
        from PIL import Image

        values = np.random.default_rng(0).integers(256, size=(12, 16, 3), dtype=np.uint8)
        Image.fromarray(values).save(folder / f"a{ending}", **options)

    def read(folder: Path) -> Any:
        from lexsplat.captures.images.reading import image_size, read_image, read_mask

        image_size(folder / f"a{ending}")
        read_mask(folder / f"a{ending}")
        return read_image(folder / f"a{ending}", (1.0, 1.0, 1.0))

    def check(image: Any) -> None:
        finite(image)
        assert image.ndim == 3
        assert image.shape[2] == 3
        assert image.min() >= 0
        assert image.max() <= 1

    return lambda: Reader(
        make, read, check,
        {f"a{ending}": lambda c, r: png(c, r, 150) if ending == ".png" else mutate.binary(c, r, 150, 150)},
    )  # fmt: skip


READERS["png"] = pictures_of(".png")
READERS["jpeg"] = pictures_of(".jpg", progressive=True)
READERS["webp"] = pictures_of(".webp")
READERS["tiff"] = pictures_of(".tif")
READERS["bmp"] = pictures_of(".bmp")


# -- features


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
        kept["scene"] = load(folder / "capture")
        kept["scene"] = replace(kept["scene"], views={"a.png": kept["scene"].views["a.png"]})
        write(folder)

    def read(folder: Path) -> Any:
        from lexsplat.features import load_external_features

        return load_external_features(folder, kept["scene"])

    return Reader(make, read, check_features, mutations)


def grid(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


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
        yield from mutate.safetensors(content, rng, 60, 250)
        yield from mutate.tensors(content, rng, 120)

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
def points_cache() -> Reader:
    """Kept points that are damaged are made anew: None."""
    from lexsplat.captures.sfm.triangulation import _read_cache, _write_cache

    def check(result: Any) -> None:
        if result is not None:
            finite(*result)
            assert result[0].shape == result[1].shape

    return Reader(
        lambda folder: _write_cache(folder / "points.npz", grid(5, 3), grid(5, 3)),
        lambda folder: _read_cache(folder / "points.npz"), check,
        {"points.npz": lambda content, rng: mutate.binary(content, rng, 150, 200)},
    )  # fmt: skip


@reader
def model_folder() -> Reader:
    """What decides whether a folder is a model: its configuration and its index of shards."""
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

    return Reader(make, lambda folder: find(str(folder / "model"), "clip"), check,
                  {"model/model.safetensors.index.json": lambda c, r: mutate.json_file(c, r, 30, 120)})  # fmt: skip


# -- running them


class Hang(BaseException):
    """An input took longer than `SECONDS`."""


def _interrupt(number: int, frame: Any) -> None:
    raise Hang


@dataclass
class Report:
    """What came of the inputs."""

    inputs: int = 0
    errors: Counter = field(default_factory=Counter)
    kinds: Counter = field(default_factory=Counter)
    right: int = 0
    failures: list[str] = field(default_factory=list)
    peak: int = 0
    seconds: float = 0.0

    def data(self) -> dict[str, Any]:
        return {**vars(self), "errors": dict(self.errors), "kinds": dict(self.kinds)}


def summary(result: Any) -> bytes:
    """A few bytes that are equal for equal results."""
    import torch

    if hasattr(result, "gaussians"):
        return summary([result.gaussians, list(result.field.tensors().values()), repr(result.views)])
    if hasattr(result, "tensors"):
        return summary(list(result.tensors().values()))
    if isinstance(result, (torch.Tensor, np.ndarray)):
        return np.asarray(result).tobytes()
    if isinstance(result, (list, tuple)):
        return b"|".join(map(summary, result))
    return repr(result).encode("utf-8", "replace")


def attempt(target: Reader, folder: Path, report: Report, about: str, whole: bytes | None) -> None:
    """Read once and judge what comes of it; ``whole`` is what a part of the file must say, if it says anything."""
    from lexsplat.runtime.errors import LexsplatError

    allowed = (LexsplatError, ValueError) if target.value_errors else (LexsplatError,)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        result = target.read(folder)
        target.check(result)
        assert whole is None or summary(result) == whole, "a part of the file was taken for the whole"
        report.right += 1
    except allowed as error:
        report.errors[type(error).__name__] += 1
        if "\n" in str(error) or not str(error):
            report.failures.append(f"{about}: not one line: {error!r}")
    except Hang:
        report.failures.append(f"{about}: not finished after {SECONDS:g} s")
    except (Exception, MemoryError) as error:
        where = error.__traceback__
        while where is not None and where.tb_next is not None:
            where = where.tb_next
        place = f"{Path(where.tb_frame.f_code.co_filename).name}:{where.tb_lineno}" if where else ""
        report.failures.append(f"{about}: {type(error).__name__} at {place}: {str(error)[:300]}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def run_reader(name: str, work: Path, current: Path) -> Report:
    """All mutations of one reader; ``current`` says which is being tried."""
    target, report = READERS[name](), Report()
    folder = work / name
    folder.mkdir(parents=True)
    target.make(folder)
    good = target.read(folder)
    target.check(good)
    # A little more than a gigabyte in all: nothing that is read here holds more than a few kilobytes.
    limit = _data_bytes() + GIGABYTE
    resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
    whole = summary(good)
    for number, (file, mutations) in enumerate(target.mutations.items()):
        path = folder / file
        content = path.read_bytes()
        for index, (kind, changed) in enumerate(mutations(content, np.random.default_rng(number))):
            about = f"{name} {file} {kind} {index}"
            current.write_text(about)
            path.write_bytes(changed)
            report.inputs += 1
            report.kinds[kind] += 1
            attempt(
                target, folder, report, about, whole if kind == "truncated" and file in target.exact else None
            )
            if len(report.failures) >= 200:
                break
        path.write_bytes(content)
    resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    shutil.rmtree(folder)
    return report


def _data_bytes() -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))


def main() -> None:
    work, output, *names = sys.argv[1:]
    import logging

    import torch

    torch.set_num_threads(1)
    logging.getLogger("lexsplat").setLevel(logging.CRITICAL)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _interrupt)
    reports: dict[str, Any] = {}
    for name in names:
        start = time.process_time()
        with contextlib.redirect_stdout(sys.stderr):
            report = run_reader(name, Path(work), Path(output).with_suffix(".current"))
        report.peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        report.seconds = round(time.process_time() - start, 2)
        reports[name] = report.data()
        Path(output).write_text(json.dumps(reports, indent=1))


if __name__ == "__main__":
    main()
