"""``--memory`` is a budget: under a hard limit every stage comes through, on a capture that is larger."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_capture import camera_poses, quaternion

from lexsplat.config import BuildConfig

MEGABYTE = 1 << 20
VIEWS, WIDTH, HEIGHT = 50, 960, 720
MEMORY = 80 * MEGABYTE
BESIDE = 300 * MEGABYTE
"""What one photo on its way, a few hundred Gaussians and threads may take beside the budget."""

BUILD = """
import json, resource, sys
from lexsplat import cli
import lexsplat.pipeline, lexsplat.rendering.cpu_backend, scipy.ndimage, skimage.measure, pycolmap
from lexsplat.features.encoders import load_clip
load_clip("embedded", "cpu").encode_text(["warm"])
with open("/proc/self/status") as file:
    before = next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))
limit = before + int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
sys.exit(cli.main(sys.argv[2:]))
"""


@pytest.fixture(scope="module")
def large_capture(tmp_path_factory) -> Path:
    """Many large photos of nearly nothing, in COLMAP's text layout: small files, and large once they are decoded."""
    folder = tmp_path_factory.mktemp("large") / "capture"
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    lines = []
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for number, (rotation, translation) in enumerate(camera_poses(VIEWS), start=1):
        ramp = ((x + 9 * number) // 4 % 200 + y // 16).astype(np.uint8)
        Image.fromarray(np.stack([ramp, ramp // 2, 255 - ramp], -1)).save(
            folder / "images" / f"{number:02d}.jpg"
        )
        pose = " ".join(f"{v:.9g}" for v in (*quaternion(rotation), *translation))
        lines.append(f"{number} {pose} 1 {number:02d}.jpg\n\n")
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {WIDTH} {HEIGHT} {WIDTH} {WIDTH} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    (model / "images.txt").write_text("".join(lines))
    points = np.random.default_rng(0).normal(size=(300, 3)) * 0.5
    rows = (f"{i} {a:.4f} {b:.4f} {c:.4f} 120 90 60 0.5\n" for i, (a, b, c) in enumerate(points, 1))
    (model / "points3D.txt").write_text("".join(rows))
    return folder


def run(capture: Path, output: Path, limit: int, *options: str) -> subprocess.CompletedProcess:
    arguments = [
        "build", str(capture), "--output", str(output), "--clip", "embedded", "--dino", "none", "--device", "cpu",
        "--downscale", "1", "--iterations", "44", "--reconstruction.max-gaussians", "400",
        "--reconstruction.warm-up", "0", "--codebook.num-codes", "8", "--codebook.steps", "20",
        "--method", "trained", "--embedding.iterations", "10", "--embedding.render-downscale", "4", 
        "--features.crop-sizes", "0.5", "--features.crop-strides", "0.5", "--features.map-cells", "16",
        "--features.max-short-side", "120", *options,
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    command = [sys.executable, "-c", BUILD, str(limit), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=900, env=environment)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the hard limit (RLIMIT_DATA) needs Linux")
def test_all_stages_come_through_under_a_hard_limit_that_the_photos_exceed(large_capture, tmp_path):
    limit = MEMORY + BESIDE
    assert limit < VIEWS * WIDTH * HEIGHT * 3 * 4, "the decoded photos must not fit"
    done = run(large_capture, tmp_path / "scene", limit, "--memory", f"{MEMORY}")
    assert done.returncode == 0, done.stderr[-2000:]
    stages = json.loads((tmp_path / "scene" / "scene.json").read_text())["stages"]
    assert {"reconstruct", "features", "codebook", "embed"} <= stages.keys()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the hard limit (RLIMIT_DATA) needs Linux")
def test_the_limit_is_one_that_bites(large_capture, tmp_path):
    """Without the budget the same build ends, in one line, under the same limit."""
    done = run(large_capture, tmp_path / "scene", MEMORY + BESIDE, "--memory", "8GB")
    assert done.returncode == 1, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    assert "error: " in done.stderr.splitlines()[-1]


def test_memory_bounds_the_store_of_every_stage_and_no_setting_that_decides_a_result():
    config = BuildConfig(memory="400MB")
    bounded = config.within_memory()
    quarter = 100 * MEGABYTE
    assert bounded.reconstruction.image_memory == quarter
    assert bounded.embedding.memory_bytes == quarter
    assert bounded.lifting.memory_bytes == quarter
    assert bounded.features.memory == 4 * quarter
    again = replace(
        bounded,
        reconstruction=config.reconstruction,
        embedding=config.embedding,
        lifting=config.lifting,
        features=config.features,
    )
    assert again == config
