"""Readers of captures: camera files, splits, ground truth, cached points."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.images import picture, png
from support.hostile.registry import Reader, finite, grid, reader


def check_capture(capture: Any) -> None:
    """A valid capture: rigid camera poses, files inside the folder, points with colors."""
    assert capture.views
    assert set(capture.train_names).isdisjoint(capture.test_names)
    assert {*capture.train_names, *capture.test_names} == set(capture.views)
    root = capture.root.resolve()
    for name, view in capture.views.items():
        finite(view.camera.viewmat, view.camera.K)
        np.testing.assert_allclose(
            view.camera.viewmat[:3, :3] @ view.camera.viewmat[:3, :3].T, np.eye(3), atol=1e-5
        )
        assert np.abs(view.camera.viewmat).max() <= 1e7
        assert 0 < view.camera.width <= 65535
        assert view.image_path.resolve().is_relative_to(root)
        assert ".." not in Path(name).parts
        assert not Path(name).is_absolute()
    finite(capture.points, capture.point_colors)
    assert capture.points.shape == capture.point_colors.shape
    assert len(capture.points) <= 1000


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
        make_colmap, load, check_capture,
        {f"sparse/0/{name}": lambda content, rng: mutate.binary(content, rng, 40, 250) for name in names}
        | {"sparse/0/images.bin": colmap_images},
        exact=tuple(f"sparse/0/{name}" for name in names),
    )  # fmt: skip


def colmap_images(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
    yield from mutate.binary(content, rng, 50, 250)
    for name in (*mutate.NAMES, "c.png", "дом/b.png", "./c.png", "дом//b.png", "дом/../c.png"):
        raw = name.encode("utf-8", "surrogatepass")
        yield "names", content.replace(b"a.png\0", raw + b"\0")


@reader
def colmap_text() -> Reader:
    names = ("cameras.txt", "images.txt", "points3D.txt")
    return Reader(
        make_colmap_text, load, check_capture,
        {f"sparse/0/{name}": lambda content, rng: mutate.text(content, rng, 40, 150) for name in names},
    )  # fmt: skip


def make_transforms(folder: Path) -> None:
    from support.written_captures import write_transforms

    document = write_transforms(folder, ["a.png", "дом/b.png", "c.png"], k1=0.01, camera_model="OPENCV")
    document["frames"][0]["mask_path"] = "masks/a.png"
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    picture(folder / "masks" / "a.png", mode="L")


@reader
def transforms() -> Reader:
    return Reader(make_transforms, load, check_capture,
                  {"transforms.json": lambda content, rng: mutate.json_file(content, rng, 60, 350)})  # fmt: skip


def make_split(folder: Path) -> None:
    make_transforms(folder)
    (folder / "test_views.json").write_text(json.dumps(["a", "дом/b.png"]))


@reader
def split_file() -> Reader:
    return Reader(
        make_split, load, check_capture, {"test_views.json": lambda c, r: mutate.json_file(c, r, 40, 120)}
    )


def make_masks(folder: Path) -> None:
    make_colmap(folder)
    for prompt in ("red apple", "床"):
        picture(folder / "segmentations" / "a" / f"{prompt}.png", value=255, mode="L")


def ground_truth_of(
    write: Callable[[Path], None], mutations: dict[str, Any], exact: tuple[str, ...] = ()
) -> Reader:
    """The ground truth of a capture that is loaded once: of ground truth, loading reads names of files only."""
    kept: dict[str, Any] = {}

    def make(folder: Path) -> None:
        write(folder)
        kept["capture"] = load(folder)

    def read(folder: Path) -> Any:
        from lexsplat.captures import load_annotations
        from lexsplat.captures.ground_truth.layouts import load_ground_truth

        ground_truth = load_annotations(kept["capture"])
        return ground_truth, [
            load_ground_truth(kept["capture"].views[view], mask)
            for view, masks in ground_truth.masks.items()
            for mask in masks.values()
        ]

    return Reader(make, read, check_ground_truth, mutations, exact)


def check_ground_truth(result: Any) -> None:
    ground_truth, masks = result
    assert all(mask.dtype == bool and mask.ndim == 2 and mask.size <= 64 * 48 * 64 for mask in masks)
    for boxes in ground_truth.boxes.values():
        finite(*boxes.values())


@reader
def masks() -> Reader:
    name = "segmentations/a/red apple.png"
    return ground_truth_of(make_masks, {name: lambda c, r: png(c, r, 50)}, exact=(name,))


def make_ovs3d(folder: Path) -> None:
    make_masks(folder)
    (folder / "segmentations" / "classes.txt").write_text("red apple\n床\n", encoding="utf-8")


@reader
def ovs3d() -> Reader:
    def lists(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.text(content, rng, 80)
        for name in mutate.NAMES:
            yield "names", content + name.encode("utf-8", "surrogatepass") + b"\n"

    return ground_truth_of(make_ovs3d, {"segmentations/classes.txt": lists})


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
    return ground_truth_of(
        make_lerf, {"label/frame_00001.json": lambda c, r: mutate.json_file(c, r, 40, 180)}
    )


@reader
def points_cache() -> Reader:
    """A damaged cache of points yields None."""
    from lexsplat.captures.sfm.triangulation import _read_cache, _write_cache

    def check(result: Any) -> None:
        if result is not None:
            finite(*result)
            assert result[0].shape == result[1].shape == (5, 3)

    return Reader(
        lambda folder: _write_cache(folder / "points.safetensors", grid(5, 3), grid(5, 3)),
        lambda folder: _read_cache(folder / "points.safetensors"), check,
        {"points.safetensors": lambda content, rng: mutate.binary(content, rng, 150, 200)},
    )  # fmt: skip
