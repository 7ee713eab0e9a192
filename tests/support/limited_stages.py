"""Runs stages under a hard memory limit, each in a fork of one process that has imported everything.

test_memory_budget.py runs this module with a folder written by `write_photos`. It prints one line of JSON with the
outcome of each stage, its limit in bytes, and its peak resident memory in bytes.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from support.rooms import SIZE, room_cameras, room_photo

LARGE = (2400, 1800)
GIANT = (3600, 2700)
SIDE = SIZE[0]
FEATURES = 400
SAMPLE, DIMENSIONS, CODES = 40_000, 512, 8
SLACK = 32 << 20
"""What may be resident beyond the numbers of `lexsplat.runtime.memory`: heaps not given back, code that is loaded."""


def write_photos(folder: Path) -> None:
    """Large photos of the room, with and without cameras, and a giant portrait photo with a mask."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, camera in enumerate(room_cameras()):
        small = Image.fromarray((room_photo(camera) * 255).round().astype(np.uint8))
        small.resize(LARGE, Image.Resampling.BILINEAR).save(folder / "images" / f"{index}.jpg", quality=90)
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV to OpenGL axes
        frames.append({"file_path": f"images/{index}.jpg", "transform_matrix": pose.tolist()})
    scale = LARGE[0] / SIZE[0]
    intrinsics = {name: float(value) * scale for name, value in zip(("fl_x", "fl_y"), np.diag(camera.K))}
    document = {**intrinsics, "w": LARGE[0], "h": LARGE[1], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", GIANT, (120, 90, 40)).save(folder / "giant.jpg", exif=exif)
    mask = Image.new("L", (GIANT[0] // 4, GIANT[1] // 4), 255)
    mask.paste(0, (0, 0, 300, 200))
    mask.save(folder / "giant.jpg.png")


def place_photos(folder: Path, memory: int) -> str:
    """Structure from motion through the command line."""
    from lexsplat import cli

    out = io.StringIO()
    arguments = ["poses", str(folder / "images"), "--output", str(folder / f"poses_{os.getpid()}")]
    arguments += ["--memory", str(memory), "--max-side", str(SIDE), "--max-features", str(FEATURES)]
    with contextlib.redirect_stdout(out):
        status = cli.main(arguments)
    return out.getvalue().splitlines()[0] if status == 0 else f"status {status}"


def triangulate_points(folder: Path, memory: int) -> str:
    """Triangulation with known poses, with the feature size of the small photos."""
    from lexsplat.captures import PoseConfig, load_capture
    from lexsplat.captures.sfm import triangulation

    triangulation.FEATURES = PoseConfig(max_side=SIDE, max_features=FEATURES)
    points, _ = triangulation.triangulate(load_capture(folder, test_every=0), memory=memory)
    return f"{len(points)} points"


def undistort_giant(folder: Path, memory: int) -> str:
    """Undistorting and downscaling a giant photo with a mask, and its valid pixels."""
    from lexsplat.captures.capture import View
    from lexsplat.captures.images.undistortion import Lens, pinhole_of
    from lexsplat.geometry.cameras import Camera

    lens = Lens("SIMPLE_RADIAL", *GIANT, (0.9 * GIANT[0], GIANT[0] / 2, GIANT[1] / 2, -0.04))
    width, height, K = pinhole_of(lens)
    camera = Camera(width, height, K, np.eye(4)).downscaled(2.5)
    path = folder / "giant.jpg"
    view = View(path.name, path, camera, (width, height), lens, ignore_path=folder / "giant.jpg.png")
    image, valid = view.load_image(), view.load_valid()
    corner = np.round(image[-1, -1] * 255).astype(int).tolist()
    return f"{image.shape[1]}x{image.shape[0]} {corner} {valid.mean():.2f}"


def turn_giant(folder: Path, memory: int) -> str:
    """The upright copy of a giant photo that is stored rotated."""
    from lexsplat.captures.sfm.preparation import _look_at, _write_upright

    target = folder / "upright.jpg"
    _write_upright(_look_at(folder, "giant.jpg"), folder / "giant.jpg", target)
    with Image.open(target) as image:
        return f"{image.width}x{image.height}"


class Maps(dict):
    """Features of twenty views, generated on access."""

    def __missing__(self, name: str):
        import torch

        from lexsplat.features.cache import FeatureMap

        generator = torch.Generator().manual_seed(int(name))
        clip = torch.randn(50, 60, DIMENSIONS, generator=generator)
        return FeatureMap(clip / clip.norm(dim=-1, keepdim=True))


def fit_codes(folder: Path, memory: int) -> str:
    """A codebook fitted to a large sample."""
    from lexsplat.codebook import CodebookConfig, fit_codebook

    config = CodebookConfig(
        num_codes=CODES, sample_size=SAMPLE, kmeans_iterations=2, steps=2, batch_size=1024, use_dino=False
    )
    codebook = fit_codebook(Maps(), [str(number) for number in range(20)], config, memory=memory)
    return f"{len(codebook.clip)} codes"


def budgets() -> dict[str, tuple[Callable[[Path, int], str], int]]:
    """Each stage with its minimum memory, computed by the functions that the stages use."""
    from lexsplat.runtime import memory as budget

    searching = budget.extraction_bytes(LARGE, SIDE, FEATURES, 1)
    reading = budget.photo_bytes(LARGE, SIZE)
    giant = budget.photo_bytes(GIANT, (GIANT[0] * 2 // 5, GIANT[1] * 2 // 5))
    sample = budget.sample_bytes(SAMPLE, DIMENSIONS, CODES, 1024)
    return {
        "poses": (place_photos, max(searching, reading)),
        "triangulation": (triangulate_points, reading),
        "undistortion": (undistort_giant, giant),
        "turning": (turn_giant, budget.photo_bytes(GIANT)),
        "codebook": (fit_codes, -(-sample * 4 // 3)),
    }


def status_bytes(name: str) -> int:
    """A memory value of this process: "VmData" is the limited one, "VmRSS" resident memory, "VmHWM" its peak."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(name))


def run_limited(work: Callable[[Path, int], str], folder: Path, memory: int, beside: int) -> dict:
    """The outcome of a stage in a fork with a limit of additional memory in bytes: its result, or how it ended."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        limit = status_bytes("VmData") + memory + beside
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        try:
            Path("/proc/self/clear_refs").write_text("5")  # resets the peak
            before, code = status_bytes("VmRSS"), status_bytes("RssFile")
            said = work(folder, memory)
            # Pages of libraries that this process had not used yet are not taken by the stage.
            resident = status_bytes("VmHWM") - before - max(0, status_bytes("RssFile") - code)
        except BaseException as error:
            said, resident = f"{type(error).__name__}: {error}", -1
        os.write(write, json.dumps({"said": said[:4000], "resident": resident, "memory": memory}).encode())
        os._exit(0)
    os.close(write)
    _, status = os.waitpid(child, 0)
    with os.fdopen(read, "rb") as pipe:
        said = pipe.read().decode()
    return json.loads(said) if said else {"said": f"ended with {status}", "memory": memory}


def least_of_two(work: Callable[[Path, int], str], folder: Path, memory: int, beside: int) -> dict:
    """The outcome of a stage, of a second run where the first takes too much.

    A system may take pages of code back from an idle process. In the first run they count as new, in the second not.
    """
    first = run_limited(work, folder, memory, beside)
    if first.get("resident", 0) < memory + SLACK:
        return first
    return min(first, run_limited(work, folder, memory, beside), key=lambda report: report.get("resident", 0))


def main() -> None:
    folder, beside = Path(sys.argv[1]), int(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):  # the same number of threads on any machine
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    import pycolmap  # noqa: F401
    import torch  # noqa: F401

    import lexsplat.captures.sfm.photos  # noqa: F401

    report = {name: least_of_two(work, folder, memory, beside) for name, (work, memory) in budgets().items()}
    print(json.dumps(report))


if __name__ == "__main__":
    main()
