"""OpenSplat on a CPU, for `peers.py`: a program that is on this machine or is built there, run beside the others.

OpenSplat is AGPL and stays a program of its own: nothing here links or copies it. A build needs git, CMake, a C++
compiler and OpenCV; torch is that of this environment.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures import Capture, InitialPoints
from lexsplat.geometry.cameras import OPENGL_TO_OPENCV
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.scenes.formats.reading import read_splats

BACKGROUND = (0.6130, 0.0101, 0.3984)
"""The color OpenSplat trains over."""

SOURCES = "https://github.com/pierotofy/OpenSplat.git"
REVISION = "15b7e80016bb25107f07956b5682231f226f62b9"
"""The commit that was measured."""
FETCH = "fetch"
"""In place of a program: fetch the sources and build them."""


class Skipped(Exception):
    """A peer cannot run here; the message is the reason."""


def find_opensplat(place: str | None, folder: Path) -> str:
    """The program, built if its sources are given or to be fetched.

    Args:
        place: The program, a folder of its sources, or `FETCH`.
        folder: Where fetched sources are kept. They are not fetched or built again.

    Raises:
        Skipped: If there is none, or it cannot be fetched or built.
    """
    if place is None:
        raise Skipped(
            f"no program opensplat on the path; name one, or its sources, with --opensplat, or {FETCH}"
        )
    if place == FETCH:
        if not (folder / "CMakeLists.txt").is_file():
            _run("git", "clone", "--quiet", SOURCES, str(folder))
            _run("git", "-C", str(folder), "checkout", "--quiet", REVISION)
        place = str(folder)
    if not Path(place).is_dir():
        return place
    build = Path(place) / "build"
    # What an earlier configuration was told, such as where its libraries are, holds on.
    _run(
        "cmake", "-S", place, "-B", str(build), "-DCMAKE_BUILD_TYPE=Release", "-DGPU_RUNTIME=CPU",
        f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}",
    )  # fmt: skip
    # A number: without one, make starts all of its jobs at once.
    jobs = str(os.cpu_count() or 1)
    _run("cmake", "--build", str(build), "--target", "opensplat", "--parallel", jobs)
    return str(build / "opensplat")


def _run(*command: str) -> None:
    """Run a program to its end.

    Raises:
        Skipped: If it is missing or fails, with what it said last.
    """
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    except OSError as error:
        raise Skipped(f"{command[0]} does not start: {error.strerror}") from error
    if done.returncode:
        said = [line.strip() for line in done.stdout.splitlines() if line.strip()] or ["nothing printed"]
        raise Skipped(f"{command[0]} ended with status {done.returncode}: {said[-1]}")


def train_opensplat(
    program: str, capture: Capture, points: InitialPoints, steps: int, threads: int
) -> tuple[Gaussians, NDArray, int]:
    """Train all steps at full resolution, from the same points and training views.

    Returns:
        The Gaussians, processor and wall seconds ``[steps - 1, 2]`` between its steps, and its peak memory in bytes.

    Raises:
        Skipped: If it fails.
    """
    if sys.platform != "linux":
        raise Skipped("its processor time is read in a way that only Linux has")
    with tempfile.TemporaryDirectory() as folder:
        write_project(Path(folder), capture, points)
        output = Path(folder) / "trained.ply"
        options = ["--cpu", "--keep-crs", "--num-downscales", "0", "-n", str(steps), "-o", str(output)]
        clocks, peak = timed_steps([program, folder, *options], threads)
        if not output.exists():
            raise Skipped("it wrote no Gaussians")
        return read_splats(output), np.diff(clocks, axis=0), peak


def timed_steps(command: list[str], threads: int) -> tuple[NDArray, int]:
    """Run it to its end: processor and wall clock at each line "Step ...", and its peak memory in bytes."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    try:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
    except OSError as error:
        raise Skipped(f"{command[0]} does not start: {error.strerror}") from error
    # The clock of another process: Linux's clock_getcpuclockid, which Python lacks.
    clock, status = (~process.pid << 3) | 2, Path(f"/proc/{process.pid}/status")
    clocks, peak, last = [], 0, "nothing printed"
    assert process.stdout is not None
    try:
        for line in process.stdout:
            last = line.strip() or last
            if line.startswith("Step "):
                clocks.append((time.clock_gettime(clock), time.perf_counter()))
                found = re.search(r"^VmHWM:\s*(\d+) kB", status.read_text(), flags=re.MULTILINE)
                peak = 1024 * int(found[1]) if found else peak
    except BaseException:
        process.kill()
        process.wait()
        raise
    if process.wait() != 0:
        raise Skipped(f"it ended with status {process.returncode}: {last}")
    if not clocks:
        raise Skipped(f"it ran no step: {last}")
    return np.array(clocks), peak


def write_project(folder: Path, capture: Capture, points: InitialPoints) -> None:
    """The training views and points as a Nerfstudio project; photos of 8 bits at the size of the training."""
    frames = []
    for number, view in enumerate(capture.train_views):
        camera, name = view.camera, f"{number:04}.png"
        Image.fromarray((view.load_image() * 255).round().astype(np.uint8)).save(folder / name)
        size = {"w": camera.width, "h": camera.height}
        lens = {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
        pose = (np.linalg.inv(camera.viewmat) @ OPENGL_TO_OPENCV).tolist()
        frames.append({"file_path": name, **size, **lens, "transform_matrix": pose})
    document = {"camera_model": "OPENCV", "frames": frames, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps(document))
    header = ["ply", "format ascii 1.0", f"element vertex {len(points.points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue")]
    rows = np.hstack([points.points, (points.colors * 255).round()])
    np.savetxt(folder / "points.ply", rows, "%.9g", header="\n".join([*header, "end_header"]), comments="")
