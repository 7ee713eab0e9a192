"""``--memory`` is a budget: under a hard limit every stage comes through, on a capture that is larger."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support import TESTS_ON_PATH, limited_stages
from support.tiny_capture import camera_poses, quaternion
from support.warm_starts import Ended, Program, Stage, run_warm

from lexsplat import cli
from lexsplat.captures.sfm import feature_budget
from lexsplat.codebook import CodebookConfig, fit_codebook
from lexsplat.features import FeatureMap
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import ReconstructionConfig, check_gaussians
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import MemoryBudgetError

pytestmark = pytest.mark.slow

MEGABYTE = 1 << 20
VIEWS, WIDTH, HEIGHT = 50, 720, 540
MEMORY = 45 * MEGABYTE
BESIDE = 160 * MEGABYTE
"""What one photo on its way, a few hundred Gaussians and threads may take beside the budget."""

BUILD = """
import json, resource, sys
from pathlib import Path
from lexsplat import cli
from lexsplat.features.encoders import load_clip
import torch
clip = load_clip("bundled", "cpu")
clip.encode_text(["warm"])
clip.encode_patches(torch.zeros(16, 3, 48, 48))
with open("/proc/self/status") as file:
    before = next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))
limit = before + int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
status = cli.main(sys.argv[3:])
if status == 0:
    print(json.dumps(json.loads(Path(sys.argv[2], "scene.json").read_text())["stages"]))
sys.exit(status)
"""
"""Builds under a limit of further memory; the last line of its output is the record of the stages.

The code that oneDNN makes for a processor is made before: it does not depend on the capture, and takes 30 MB more for
bfloat16.
"""

USED = (
    "lexsplat.cli", "lexsplat.pipeline", "lexsplat.rendering.cpu_backend", "lexsplat.features.encoders",
    "scipy.ndimage", "skimage.measure", "pycolmap", "tokenizers",
)  # fmt: skip
"""What a build imports does not count for its limit."""


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
    points = np.random.default_rng(0).normal(size=(300, 3)) * 0.1  # small: drawn fast
    rows = (f"{i} {a:.4f} {b:.4f} {c:.4f} 120 90 60 0.5\n" for i, (a, b, c) in enumerate(points, 1))
    (model / "points3D.txt").write_text("".join(rows))
    return folder


def build(capture: Path, output: Path, *options: str) -> Program:
    arguments = [
        str(MEMORY + BESIDE), str(output),
        "build", str(capture), "--output", str(output), "--clip", "bundled", "--dino", "none", "--device", "cpu",
        "--downscale", "1", "--iterations", "34", "--reconstruction.max-gaussians", "400",
        "--reconstruction.warm-up", "0", "--codebook.num-codes", "8", "--codebook.steps", "20",
        "--trained.iterations", "10", "--trained.render-downscale", "4",
        "--features.crop-sizes", "0.5", "--features.crop-strides", "0.5", "--features.map-cells", "16",
        "--features.max-short-side", "120", *options,
    ]  # fmt: skip
    return Program(BUILD, arguments)


@pytest.fixture(scope="module")
def builds(large_capture, tmp_path_factory) -> dict[str, Ended]:
    """What came of builds under the limit: by both methods, of which the second keeps the Gaussians of the first, and
    without the budget.
    """
    if not Path("/proc/self/status").exists():
        pytest.skip("the hard limit (RLIMIT_DATA) needs Linux")
    folder = tmp_path_factory.mktemp("built")
    programs = {
        method: build(large_capture, folder / "scene", "--memory", f"{MEMORY}", "--method", method)
        for method in ("averaged", "trained")
    }
    programs["without"] = build(large_capture, folder / "other", "--memory", "8GB")
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    ended = run_warm(Stage(USED, [[program] for program in programs.values()]), environment=threads)
    return dict(zip(programs, ended, strict=True))


@pytest.mark.parametrize(
    ("method", "stages"),
    [
        ("averaged", {"reconstruct", "features", "language"}),
        ("trained", {"reconstruct", "features", "codebook", "language"}),
    ],
)
def test_a_build_stays_under_a_hard_limit_that_its_photos_exceed(builds, method, stages):
    assert MEMORY + BESIDE < VIEWS * WIDTH * HEIGHT * 3 * 4, "the decoded photos must not fit"
    assert builds[method].status == 0, builds[method].err[-2000:]
    record = json.loads(builds[method].out.splitlines()[-1])
    assert stages <= record.keys()
    assert record["language"]["method"] == method


def test_the_limit_is_one_that_bites(builds):
    """Without the budget the same build ends, in one line, under the same limit."""
    done = builds["without"]
    assert done.status == 1, done.err[-2000:]
    assert "Traceback" not in done.err
    assert "error: " in done.err.splitlines()[-1]


def test_memory_does_not_affect_the_result():
    assert BuildConfig(memory="400MB").result_settings() == BuildConfig().result_settings()


# -- structure from motion, triangulation, giant photos, the codebook: each by itself under a hard limit

LIBRARIES = 320 * MEGABYTE
"""Address space that linear algebra libraries and stacks of threads reserve, most of it never touched."""


@pytest.fixture(scope="module")
def limited(tmp_path_factory):
    """What came of each stage that `limited_stages.py` runs."""
    if not Path("/proc/self/status").exists():
        pytest.skip("the hard limit (RLIMIT_DATA) needs Linux")
    folder = tmp_path_factory.mktemp("limited") / "capture"
    limited_stages.write_photos(folder)
    environment = {
        **os.environ,
        **TESTS_ON_PATH,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "2",
    }
    command = [sys.executable, limited_stages.__file__, str(folder), str(LIBRARIES)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("poses", "9 of 9 photos registered"),
        ("triangulation", " points"),
        ("undistortion", "1458x1087 [120, 90, 40]"),
        ("turning", "2700x3600"),
        ("codebook", "8 codes"),
    ],
)
def test_a_stage_comes_through_under_a_hard_limit_and_takes_what_its_function_says(limited, stage, expected):
    report = limited[stage]
    assert expected in report["said"], report
    assert report["resident"] < report["memory"] + limited_stages.SLACK


def test_the_photos_of_the_limited_stages_exceed_the_budget_and_the_limit(limited):
    width, height = limited_stages.LARGE
    decoded = 9 * width * height * 3
    for stage in ("poses", "triangulation"):
        assert decoded > limited[stage]["memory"]
        assert 4 * decoded > limited[stage]["memory"] + LIBRARIES
    giant = limited_stages.GIANT[0] * limited_stages.GIANT[1]
    assert limited["undistortion"]["memory"] < 30 * giant, "less than as floats at once"


# -- what is planned, and what is refused


def test_a_stage_takes_as_many_threads_as_fit_and_no_setting_that_decides_a_result(monkeypatch):
    monkeypatch.setattr(feature_budget, "_cores", lambda: 8)
    photo = (4000, 3000)
    taken = []
    for memory in (900 * MEGABYTE, 2 << 30, 4 << 30, 64 << 30):
        threads = feature_budget.extraction_threads(photo, 1600, 8192, memory)
        assert budget.extraction_bytes(photo, 1600, 8192, threads) <= memory
        taken.append(threads)
    assert taken == sorted(taken)
    assert (taken[0], taken[-1]) == (1, 8)


def one_line(error: MemoryBudgetError, *words: str) -> None:
    text = str(error)
    assert "\n" not in text
    for word in ("expected at least", "found --memory", "use --memory", *words):
        assert word in text, text


def test_photos_whose_features_do_not_fit_are_refused_with_a_size_that_does():
    with pytest.raises(MemoryBudgetError) as caught:
        feature_budget.extraction_threads((1600, 1200), 1600, 2000, 200 * MEGABYTE)
    one_line(caught.value, "photos of 1600x1200 pixels", "or --poses.max-side ")
    side = int(re.search(r"--poses.max-side (\d+)", str(caught.value))[1])
    assert feature_budget.extraction_threads((1600, 1200), side, 2000, 200 * MEGABYTE) == 1
    needed = int(str(caught.value).split("use --memory ")[1].split("MB")[0])
    assert feature_budget.extraction_threads((1600, 1200), 1600, 2000, needed * MEGABYTE) == 1


def database_of(path: Path, photos: int, features: int, matches: int) -> Path:
    import sqlite3
    from contextlib import closing

    import pycolmap

    pycolmap.Database.open(path).close()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        for number in range(1, photos + 1):
            connection.execute("INSERT INTO keypoints VALUES (?, ?, 6, x'00')", (number, features))
        connection.execute(
            "INSERT INTO two_view_geometries (pair_id, rows, cols, config) VALUES (9, ?, 2, 2)", (matches,)
        )
    return path


def test_matches_and_models_that_do_not_fit_are_refused(tmp_path):
    database = database_of(tmp_path / "a.db", 100, 8000, 400_000)
    options, held = feature_budget.matching_plan(database, 400 * MEGABYTE, least=10)
    assert options.num_threads >= 1
    assert 10 <= held <= 400 * MEGABYTE // (8000 * budget.FEATURE_BYTES)
    with pytest.raises(MemoryBudgetError) as caught:
        feature_budget.matching_plan(database, 100 * MEGABYTE, least=60)
    one_line(caught.value, "8,000 features", "or --poses.max-features ")
    feature_budget.check_mapping(database, 2 << 30)
    with pytest.raises(MemoryBudgetError) as caught:
        feature_budget.check_mapping(database, 300 * MEGABYTE)
    one_line(caught.value, "100 photos with 800,000 features and 400,000 matches")


def test_gaussians_samples_and_photos_that_do_not_fit_are_refused_with_a_number_that_does():
    config = ReconstructionConfig(max_gaussians=1_000_000)
    with pytest.raises(MemoryBudgetError) as caught:
        check_gaussians(config, "cpu", 1 << 30)
    one_line(caught.value, "1,000,000 Gaussians", "reconstruction.max-gaussians ")
    fewer = int(str(caught.value).rsplit(" ", 1)[1])
    check_gaussians(replace(config, max_gaussians=fewer), "cpu", 1 << 30)
    check_gaussians(config, "cuda", 1 << 30)  # they lie on the GPU

    clip = torch.nn.functional.normalize(torch.randn(40, 50, 64), dim=-1)
    codes = CodebookConfig(num_codes=4, steps=0, kmeans_iterations=1, batch_size=64)
    with pytest.raises(MemoryBudgetError) as caught:
        fit_codebook({"a": FeatureMap(clip)}, ["a"], codes, memory=MEGABYTE)
    one_line(caught.value, "a sample of 2,000 features", "codebook.sample-size ")
    fewer = int(str(caught.value).rsplit(" ", 1)[1])
    assert 100 < fewer < 2000
    fit_codebook({"a": FeatureMap(clip)}, ["a"], replace(codes, sample_size=fewer), memory=MEGABYTE)

    with pytest.raises(MemoryBudgetError) as caught:
        budget.check_photo((13_000, 13_000), 1 << 30)
    one_line(caught.value, "a photo of 13000x13000 pixels", "scale the photos down")


def test_a_budget_that_is_impossible_ends_in_one_line(tiny_capture, tmp_path, capsys):
    arguments = [
        "build",
        str(tiny_capture),
        "--output",
        str(tmp_path / "scene"),
        "--device",
        "cpu",
        "--clip",
        "bundled",
        "--dino",
        "bundled",
    ]
    assert cli.main([*arguments, "--memory", "100KB"]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: photos: expected at least 1MB of memory for a photo of 96x72 pixels")
    assert cli.main([*arguments, "--memory", "20MB"]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "reconstruct: expected at least" in error
    assert "--memory" in error
    photos = tiny_capture / "images"
    assert cli.main(["poses", str(photos), "--output", str(tmp_path / "poses"), "--memory", "1MB"]) == 1
    assert "structure from motion: expected at least" in capsys.readouterr().err
