"""Whatever a file contains, a reader returns a valid result or raises a typed error of one line.

`support.hostile` registers every reader with a valid input and its mutations. They run in two forks with one
gigabyte of spare memory and a few seconds per input; a crash, a hang or another exception fails the reader's test.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.forked_commands import Command
from support.hostile import READERS, mutations, running
from support.hostile.running import BASE_BYTES, GIGABYTE
from support.hostile.scenes import check_open_scene
from support.tiny_capture import write_capture
from support.written_captures import write_colmap, write_transforms

from lexsplat.captures import load_capture
from lexsplat.runtime.errors import CaptureError, FileFormatError, LexsplatError
from lexsplat.runtime.files import PICKLES, read_tensors
from lexsplat.scenes.formats.reading import read_splats

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the memory limit needs Linux"),
]

LEAST_INPUTS = 25_000
LEAST_SPLATS = 11_000
PROCESSES = 2
SPLATS = [name for name, make in READERS.items() if make.__module__.endswith(".splats")]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """The report of every reader. The processes share the readers: each takes the next unclaimed reader."""
    shared = Path("/dev/shm")
    base = tmp_path_factory.mktemp("hostile")
    claims = base / "claims"
    claims.mkdir()
    runs = []
    for number in range(PROCESSES):
        # A folder in memory: ten thousand small files would otherwise wait for a disk.
        work = (shared if os.access(shared, os.W_OK) else base) / f"lexsplat-hostile-{os.getpid()}-{number}"
        output = base / f"{number}.json"
        words = map(str, (work, output, claims))
        runs.append((Command(*words, program=running.main, heard=False), work, output))
    reports = {}
    for process, work, output in runs:
        try:
            status = process.wait(1500)
        finally:
            process.__exit__()
            shutil.rmtree(work, ignore_errors=True)
        if output.exists():
            reports.update(json.loads(output.read_text()))
        if status:
            current = output.with_suffix(".current")
            tried = current.read_text().strip() if current.exists() else ""
            tried = tried or "the start"
            reports[tried.split()[0]] = {
                "crash": f"ended with {status} at {tried}: {process.errors()[-2000:]}"
            }
    return reports


@pytest.mark.parametrize("name", sorted(READERS))
def test_every_input_is_read_correctly_or_refused_with_a_typed_error_of_one_line(corpus, name):
    assert name in corpus, "all processes ended before this reader"
    report = corpus[name]
    assert "crash" not in report, report.get("crash")
    assert not report["failures"], "\n".join(report["failures"][:20])
    assert report["peak"] < BASE_BYTES + GIGABYTE


def test_the_corpus_has_twenty_five_thousand_inputs_of_all_kinds(corpus):
    counts = {name: report["inputs"] for name, report in corpus.items()}
    assert sum(counts.values()) >= LEAST_INPUTS
    assert sum(counts[name] for name in SPLATS) >= LEAST_SPLATS
    kinds = {kind for report in corpus.values() for kind in report["kinds"]}
    assert {"truncated", "flipped", "numbers", "moved", "foreign", "structure", "names", "counts"} <= kinds
    # The corpus must exercise both acceptance and refusal.
    refused = sum(sum(report["errors"].values()) for report in corpus.values())
    right = sum(report["right"] for report in corpus.values())
    assert refused > 20_000
    assert right > 5000


def test_every_format_of_splats_that_is_read_has_mutations():
    formats = {
        "splat_ply",
        "splat_text_ply",
        "compressed_ply",
        "splat",
        "ksplat",
        "spz_2",
        "spz",
        "spz_4",
        "glb",
        "gltf",
    }
    formats |= {"sog", "sog_folder", "sog_version_1", "sog_streamed"}
    assert set(SPLATS) == formats


@pytest.mark.parametrize("name", SPLATS)
def test_some_damaged_splats_of_every_format_are_read_and_some_are_refused(corpus, name):
    assert corpus[name]["right"]
    assert sum(corpus[name]["errors"].values())


def test_the_corpus_is_deterministic():
    content = bytes(range(200))
    first, second = (list(mutations.binary(content, np.random.default_rng(1))) for _ in range(2))
    assert first == second


# -- inputs that are not mutations of bytes


@pytest.mark.parametrize("ending", PICKLES)
def test_pickles_are_refused_with_a_remedy(tmp_path, ending):
    path = tmp_path / f"model{ending}"
    path.write_bytes(b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94\x93\x94.")
    for read in (read_splats, read_tensors):
        with pytest.raises(FileFormatError, match=r"safetensors\.torch\.save_file, or export a \.ply"):
            read(path)


def test_a_pickle_among_features_is_refused_with_a_remedy(tmp_path):
    from lexsplat.features import load_external_features

    write_transforms(tmp_path / "capture", ["a.png", "b.png"])
    (tmp_path / "features").mkdir()
    (tmp_path / "features" / "a.pt").write_bytes(b"PK\x03\x04")
    with pytest.raises(FileFormatError, match=r"safetensors\.torch\.save_file"):
        load_external_features(tmp_path / "features", load_capture(tmp_path / "capture"))


def test_broken_and_circular_symlinks_are_missing_photos(tmp_path):
    write_colmap(tmp_path, ["a.png", "b.png", "c.png", "d.png"])
    for name, target in (("b.png", "nowhere.png"), ("c.png", "c.png"), ("d.png", "../images")):
        (tmp_path / "images" / name).unlink()
        (tmp_path / "images" / name).symlink_to(target)
    capture = load_capture(tmp_path)
    assert list(capture.views) == ["a.png"]
    assert "3 of 4 images have no file" in capture.warnings[0]


def test_photos_that_are_not_regular_files_are_skipped(tmp_path):
    write_colmap(tmp_path, ["a.png", "b.png"])
    (tmp_path / "images" / "b.png").unlink()
    os.mkfifo(tmp_path / "images" / "b.png")  # opening it blocks forever
    assert list(load_capture(tmp_path).views) == ["a.png"]


def test_names_in_other_alphabets_are_names(tmp_path):
    names = ["写真/景色.png", "дом и сад.png", "صورة.png", "e\u0301te\u0301.png", "a\u202fb.png"]
    write_colmap(tmp_path / "colmap", names)
    write_transforms(tmp_path / "json", names)
    assert set(load_capture(tmp_path / "colmap").views) == set(names)
    assert set(load_capture(tmp_path / "json").views) == set(names)


def test_photos_that_differ_only_in_their_suffix_are_refused(tmp_path):
    write_colmap(tmp_path, ["a.png", "a.jpg"])
    with pytest.raises(CaptureError, match="differ in more than their suffix"):
        load_capture(tmp_path)


def turn_around(model: Path) -> None:
    """Turn all cameras around: everything is behind them."""
    lines = []
    for line in (model / "images.txt").read_text().split("\n"):
        words = line.split()
        if len(words) == 10:
            w, x, y, z = map(float, words[1:5])
            # Half a turn about the camera's y axis, before the pose: (0, 0, 1, 0) times the quaternion.
            words[1:5] = map(str, (-y, z, w, -x))
            tx, ty, tz = map(float, words[5:8])
            words[5:8] = map(str, (-tx, ty, -tz))
        lines.append(" ".join(words))
    (model / "images.txt").write_text("\n".join(lines))


def same_pose(model: Path) -> None:
    lines = (model / "images.txt").read_text().split("\n")
    pose = lines[0].split()[1:8]
    for row, line in enumerate(lines):
        words = line.split()
        if len(words) == 10:
            lines[row] = " ".join([words[0], *pose, *words[8:]])
    (model / "images.txt").write_text("\n".join(lines))


@pytest.mark.parametrize("kind", ["behind", "one view", "identical views", "identical photos"])
def test_degenerate_captures_yield_a_finite_scene_or_a_typed_error(tmp_path, kind):
    """Cameras that see nothing, a single view, views at one position: a finite scene, or a typed error."""
    from lexsplat.codebook import CodebookConfig
    from lexsplat.features import FeatureConfig
    from lexsplat.pipeline.build import build
    from lexsplat.pipeline.config import BuildConfig
    from lexsplat.reconstruction import ReconstructionConfig
    from lexsplat.scenes.scene import open_scene

    capture = write_capture(tmp_path / "capture", views=1 if kind == "one view" else 3, width=32, height=24)
    shutil.rmtree(capture / "segmentations", ignore_errors=True)
    model = capture / "sparse" / "0"
    if kind == "behind":
        turn_around(model)
    elif kind.startswith("identical"):
        same_pose(model)
        if kind == "identical photos":
            for path in (capture / "images").iterdir():
                Image.fromarray(np.full((24, 32, 3), 77, np.uint8)).save(path)
    config = BuildConfig(
        clip="bundled", dino="none", device="cpu", iterations=20, downscale=1.0,
        reconstruction=ReconstructionConfig(max_gaussians=300, sh_degree=1),
        features=FeatureConfig(crop_sizes=(0.5,), crop_strides=(0.5,), map_cells=8, max_short_side=24),
        codebook=CodebookConfig(num_codes=4, steps=5),
    )  # fmt: skip
    message = ""
    try:
        build(capture, tmp_path / "scene", config)
    except LexsplatError as error:
        message = str(error)
    assert "\n" not in message
    if not message:
        check_open_scene(open_scene(tmp_path / "scene", device="cpu"))
