"""Benchmarks run by hand and rarely; these tests check that they fit the package."""

import json
import logging
import os
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lexsplat.rendering import render
from lexsplat.runtime.progress import Event

BENCHMARKS = [
    script
    for script in sorted((Path(__file__).parents[2] / "benchmarks").glob("*.py"))
    if "__main__" in script.read_text()
]


@pytest.mark.parametrize("script", BENCHMARKS, ids=lambda script: script.name)
def test_every_benchmark_has_help(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.syspath_prepend(str(script.parent))
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_the_benchmark_of_reconstruction_trains_few_photos_from_as_many_points_as_asked(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import reconstruction

    path = tmp_path / "rows.json"
    arguments = ["second=2", "--iterations", "2", "--variants", "default", "quarter-cap"]
    monkeypatch.setattr(
        sys, "argv", ["reconstruction.py", *arguments, "--points", "0", "3000", "--json", str(path)]
    )
    reconstruction.main()
    rows = json.loads(path.read_text())["rows"]
    assert [row["variant"] for row in rows] == ["default"] * 2 + ["quarter-cap"] * 2
    few, many = (row["points"] for row in rows[:2])
    assert few < many < 3010
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.slow
def test_the_gpu_benchmark_runs_on_a_cpu_and_records_its_conditions(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import gpu

    path = tmp_path / "benchmark_gpu.json"
    arguments = ["--device", "cpu", "--counts", "300", "--size", "32x24", "--seconds", "0.05"]
    monkeypatch.setattr(sys, "argv", ["/some/folder/gpu.py", *arguments, "--json", str(path)])
    gpu.main()
    assert "synthetic 300" in capsys.readouterr().out
    record = json.loads(path.read_text())
    assert record["command"].startswith("python benchmarks/gpu.py --device cpu --counts 300")
    assert record["commit"]
    assert record["machine"]["cores"] >= 1
    rates = record["rows"][0]
    assert all(rates[name] > 0 for name in ("rgb", "prompt", "paper", "training", "memory"))


def test_the_peer_of_gsplats_torch_functions_renders_our_image(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import peers
    from support.rendering_reference import front_camera, random_gaussians

    gaussians, camera = random_gaussians(60, 3, antialiased=True), front_camera()
    background = torch.tensor([0.1, 0.5, 0.9])
    projection = peers.project(gaussians, camera, 0.01)
    colors = peers.shade(gaussians, camera, projection, 3)
    image, alpha = peers.blend(projection, peers.find_tiles(projection, camera), colors, None, background)
    expected = render(gaussians, camera, background=background)
    # gsplat's boxes end at 3.33 standard deviations, where alpha can still exceed 1/255.
    assert (image - expected.image).abs().mean() < 2e-4
    assert (image - expected.image).abs().max() < 2e-2
    assert (alpha - expected.alpha).abs().max() < 2e-2


def test_the_naive_port_renders_our_image(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import naive
    from support.rendering_reference import front_camera, random_gaussians

    gaussians, camera = random_gaussians(60, 0, degree=0), front_camera()
    background = torch.tensor([0.1, 0.5, 0.9])
    image = naive.draw(gaussians, camera, background)
    expected = render(gaussians, camera, background=background).image
    assert (image - expected).abs().max() < 1e-5


def test_the_naive_ports_ssim_is_that_of_scikit_image_away_from_the_border(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import naive
    from skimage.metrics import structural_similarity

    image, photo = torch.rand(2, 24, 20, 3, generator=torch.Generator().manual_seed(0))
    # Zeros around both images are equal there, as are images of 40 pixels more.
    wide = [torch.nn.functional.pad(each, (0, 0, 20, 20, 20, 20)) for each in (image, photo)]
    expected = structural_similarity(
        *(each.numpy() for each in wide), data_range=1.0, channel_axis=2, gaussian_weights=True,
        sigma=1.5, use_sample_covariance=False, full=True,
    )[1]  # fmt: skip
    assert abs(float(naive.ssim(image, photo)) - expected[20:-20, 20:-20].mean()) < 1e-5


@pytest.mark.slow
def test_the_naive_port_learns(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    from naive import NaiveTrainer

    from lexsplat.captures import initial_points, load_capture
    from lexsplat.evaluation.demo import demo_capture

    capture = load_capture(demo_capture("second")).downscaled(8)
    points = initial_points(capture)
    fewer = replace(points, points=points.points[::16], colors=points.colors[::16])
    trainer = NaiveTrainer(capture, fewer, 48)
    losses = [trainer.step() for _ in range(48)]  # each of 24 views twice
    assert np.mean(losses[24:]) < 0.9 * np.mean(losses[:24])


def test_trainings_in_slices_start_from_the_points_of_a_build(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import training_slices

    from lexsplat import reconstruction
    from lexsplat.captures import load_capture
    from lexsplat.evaluation.demo import demo_capture

    capture, started = load_capture(demo_capture("second")), []
    capture = replace(capture, points=capture.points[::4], point_colors=capture.point_colors[::4])

    class Started(Exception):
        pass

    def start(capture, config, points, **options):
        started.append(points)
        raise Started

    monkeypatch.setattr(reconstruction, "Reconstructor", start)
    with pytest.raises(Started):
        reconstruction.reconstruct(capture, reconstruction.ReconstructionConfig(iterations=1), seed=3)
    points = training_slices.starting_points(capture, 3)
    assert len(points.points) > len(capture.points)  # 24 photos and 666 points are few
    assert np.array_equal(points.points, started[0].points)
    assert np.array_equal(points.colors, started[0].colors)
    # Commits before the module have no points to add.
    monkeypatch.setitem(sys.modules, "lexsplat.reconstruction.few_photos", None)
    earlier = runpy.run_path(training_slices.__file__)["starting_points"]
    assert np.array_equal(earlier(capture, 3).points, capture.points)


@pytest.mark.slow
def test_a_project_for_opensplat_holds_the_training_views_and_points(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import opensplat
    from plyfile import PlyData

    from lexsplat.captures import initial_points, load_capture
    from lexsplat.evaluation.demo import demo_capture

    capture = load_capture(demo_capture("second")).downscaled(5)
    opensplat.write_project(tmp_path, capture, initial_points(capture))
    read = load_capture(tmp_path)
    assert len(read.views) == len(capture.train_names) == 24
    vertices = PlyData.read(tmp_path / "points.ply")["vertex"]
    assert np.allclose(np.stack([vertices[axis] for axis in "xyz"], 1), capture.points)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], 1) / 255
    assert np.abs(colors - capture.point_colors).max() <= 0.5 / 255 + 1e-6
    for view, found in zip(capture.train_views, read.views.values()):
        assert np.allclose(found.camera.viewmat, view.camera.viewmat, atol=1e-6)
        assert np.allclose(found.camera.K, view.camera.K)
        assert np.abs(found.load_image() - view.load_image()).max() <= 0.5 / 255 + 1e-6


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the clock of another process as Linux has it")
def test_steps_of_another_program_are_timed_and_its_failure_is_a_reason(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import opensplat

    program = """
import sys, time
block = bytearray(64 << 20)
for step in range(3):
    print("Step", step, flush=True)
    end = time.process_time() + 0.05
    while time.process_time() < end:
        pass
    time.sleep(0.05)
if sys.argv[1:]:
    sys.exit("no such camera")
"""
    clocks, peak = opensplat.timed_steps([sys.executable, "-c", program], threads=1)
    processor, wall = np.diff(clocks, axis=0).T
    assert ((processor > 0.045) & (processor < 0.09)).all()
    assert (wall > 0.095).all()
    assert 64 << 20 < peak < 128 << 20
    with pytest.raises(opensplat.Skipped, match="status 1: no such camera"):
        opensplat.timed_steps([sys.executable, "-c", program, "fail"], threads=1)
    with pytest.raises(opensplat.Skipped, match="does not start"):
        opensplat.timed_steps(["/nowhere/opensplat"], threads=1)


def test_peers_are_medians_of_repeats_and_absent_ones_have_a_reason(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import peers

    found = iter([1.0, 5.0, 2.0])

    def train(peer, options):
        if peer == "gsplat":
            return {"skipped": "no gsplat"}
        time = next(found) if peer == "naive" else 7.0
        return {"processor_ms": time, "wall_ms": 9.0, "psnr": 20.0, "peak_bytes": 3e6, "gaussians": 1234}

    monkeypatch.setattr(peers, "train_elsewhere", train)
    monkeypatch.setattr(peers.shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["peers.py"])
    peers.main()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[2] == ["naive", "2.0", "9.0", "20.00", "3", "1,234"]
    assert lines[3][:4] == ["OpenSplat", "skipped:", "no", "program"]
    assert lines[4] == ["gsplat", "skipped:", "no", "gsplat"]


def test_operations_of_an_encoder_are_those_of_its_matrix_products(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import features

    layer = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 4, 4), torch.nn.Flatten(2), torch.nn.Linear(4, 5))
    with torch.inference_mode(), features.Products() as products:
        layer(torch.rand(2, 3, 8, 8))
    # The convolution has 2 x 4 outputs of 48 inputs, the linear layer 2 x 8 rows.
    assert dict(products.counts) == {(1, 8, 48, 8, torch.float32): 1, (1, 16, 4, 5, torch.float32): 1}
    assert sum(product.operations for product in products.counts) == 2 * (8 * 48 * 8 + 16 * 4 * 5)


@pytest.mark.slow
def test_encoders_are_measured_with_the_settings_and_in_the_precision_of_a_build(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import features
    from torch.utils.flop_counter import FlopCounterMode

    from lexsplat.features.clip import DEFAULT_CLIP
    from lexsplat.pipeline.config import BuildConfig

    monkeypatch.setattr(features, "vit_b16_tower", lambda: SimpleNamespace(patches=14))
    monkeypatch.setattr("lexsplat.pipeline.config.patch_grid", lambda name: 14)
    bundled, vision = features.cases()
    for case, clip in ((bundled, "bundled"), (vision, DEFAULT_CLIP)):
        assert case.config == BuildConfig(clip=clip).resolved("cpu", (640, 480)).features
        assert case.config.tokens == "both"
    monkeypatch.setattr(features, "cases", lambda: [bundled])
    monkeypatch.setattr(features, "cpu_batch", lambda side: 2)
    for faster, expected in ((True, ["bfloat16", "float32"]), (False, ["float32"])):
        monkeypatch.setattr(features.pretrained, "bfloat16_is_faster", lambda faster=faster: faster)
        rows = features.run_encoders(1)
        assert [row["precision"] for row in rows] == expected
        with torch.inference_mode(), FlopCounterMode(display=False) as counter:
            bundled.encode(torch.rand(2, 3, bundled.side, bundled.side))
        assert {round(row["crop_gflop"] * 2e9) for row in rows} == {counter.get_total_flops()}


def test_borders_near_the_outlines_of_masks_are_counted(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import boundaries

    shown = np.zeros((12, 20), int)
    shown[:, 10:] = 7  # the border is column 9
    borders = boundaries.borders_of(shown)
    assert np.array_equal(borders.nonzero()[1], np.full(12, 9))
    outline = np.zeros((12, 20), bool)
    outline[3, 5:10] = True  # 4, 3, 2, 1 and 0 pixels away
    assert boundaries.recall_and_chance(borders, outline, 2) == (3 / 5, 5 / 20)
    assert boundaries.recall_and_chance(np.zeros_like(borders), outline, 2) == (0, 0)


@pytest.mark.slow
def test_segments_of_two_balls_end_at_their_outlines(built, monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import boundaries

    monkeypatch.setattr(sys, "argv", ["boundaries.py", str(built), "--pictures", str(tmp_path)])
    boundaries.main()
    lines = capsys.readouterr().out.splitlines()
    recall, chance = (float(word) for word in lines[-1].replace(",", "").split()[5::2])
    assert recall > chance + 0.2
    assert len(list(tmp_path.glob("view_*-0.png"))) == 3


def test_told_times_are_read_from_what_a_build_says(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import forecasts

    from lexsplat.features.estimate import Estimate

    notes = forecasts.Notes()
    for message in (
        "reconstruct: about 2:05 min for 2,250 iterations",
        f"features on cpu: {Estimate(1176, 90.0).describe(100)}",
        "language: about 0:08 min for 60 views and 39,989 Gaussians",
        "SIFT features: about 1:00:02 hours for 5,000 photos",
        "workers: 2 nodes, 4 cores",
    ):
        notes.emit(logging.LogRecord("lexsplat", 25, "", 0, message, (), None))
    expected = {"reconstruct": 125.0, "features": 9000.0, "language": 8.0, "SIFT features": 3602.0}
    assert notes.told == expected
    notes.emit(
        logging.LogRecord(
            "lexsplat", 25, "", 0, f"features on cpu: {Estimate(12, 1.2).describe(50)}", (), None
        )
    )
    assert notes.told["features"] == 60.0


def test_the_parts_of_structure_from_motion_are_timed_by_their_events(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import forecasts

    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    clock = forecasts.PosesClock()
    for at, stage, done, total in (
        (0, "poses", 0, 21), (20, "poses", 10, 21), (21, "matching", 0, 45), (60, "matching", 45, 45),
        (61, "mapping", 0, 10), (62, "poses", 12, 21), (85, "mapping", 10, 10), (90, "poses", 21, 21),
    ):  # fmt: skip
        now[0] = float(at)
        clock(Event(stage, done, total))
    assert clock.taken == {"SIFT features": 21.0, "matching": 39.0, "mapping": 24.0}
    clock = forecasts.PosesClock()
    for at, stage, done, total in (
        (0, "triangulate", 0, 23), (5, "triangulate", 10, 23), (15, "triangulate", 20, 23), (16, "matching", 0, 45),
        (30, "matching", 45, 45), (35, "triangulate", 23, 23),
    ):  # fmt: skip
        now[0] = float(at)
        clock(Event(stage, done, total))
    assert clock.taken == {"SIFT features": 11.0, "matching": 14.0}, "without the time of writing the images"


def test_the_demo_is_summed_up_by_medians_of_clocks_and_the_spread_of_quality_over_seeds(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import demo_time

    content = {
        "quality": {"psnr": 31.0, "lpips": None, "per_view": {"a": 1.0}},
        "language": {"strict": {"mAP": 0.9}},
    }
    assert demo_time.numbers(content) == {"quality.psnr": 31.0, "language.strict.mAP": 0.9}
    runs = [
        {"seed": seed, "wall": wall, "processor": 2 * wall, "peak_gb": 1.0, "quality": {"psnr": psnr}}
        for seed, wall, psnr in ((0, 10.0, 30.0), (1, 40.0, 32.0), (0, 20.0, 30.0))
    ]
    found = demo_time.summary(runs)
    assert (found["wall"], found["processor"]) == (20.0, 40.0)
    assert found["quality"]["psnr"] == pytest.approx([31.0, 2**0.5])
    assert not capsys.readouterr().err
    demo_time.summary([*runs, {**runs[0], "quality": {"psnr": 30.5}}])
    assert "seed 0: two runs differ" in capsys.readouterr().err


def test_opensplat_is_fetched_once_built_and_skipped_with_the_reason(monkeypatch, tmp_path):
    import opensplat

    programs, sources, log = tmp_path / "bin", tmp_path / "sources", tmp_path / "log"
    programs.mkdir()
    for name in ("git", "cmake"):  # stand-ins: one makes the sources, the other the program
        program = programs / name
        program.write_text(
            f'#!/bin/sh\necho {name} "$@" >> {log}\n'
            f'[ "$1" != clone ] || {{ mkdir {sources} && touch {sources}/CMakeLists.txt; }}\n'
            f"[ ! -e {tmp_path}/broken ] || {{ echo no OpenCV; exit 3; }}\n"
        )
        program.chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=":")
    for _ in range(2):
        assert opensplat.find_opensplat("fetch", sources) == str(sources / "build" / "opensplat")
    lines = log.read_text().splitlines()
    assert lines[-1].endswith(f"--parallel {os.cpu_count()}")
    commands = [line.split()[:2] for line in lines]
    built = [["cmake", "-S"], ["cmake", "--build"]]
    assert commands == [["git", "clone"], ["git", "-C"], *built, *built]
    assert opensplat.find_opensplat("/usr/bin/opensplat", sources) == "/usr/bin/opensplat"
    (tmp_path / "broken").touch()
    with pytest.raises(opensplat.Skipped, match="cmake ended with status 3: no OpenCV"):
        opensplat.find_opensplat(str(sources), tmp_path)
    with pytest.raises(opensplat.Skipped, match="name one, or its sources, with --opensplat"):
        opensplat.find_opensplat(None, tmp_path)
