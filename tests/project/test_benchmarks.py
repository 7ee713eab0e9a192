"""Benchmarks run by hand and rarely; these tests check that they fit the package."""

import json
import logging
import runpy
import sys
from pathlib import Path

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


def test_operations_of_an_encoder_are_those_of_its_matrix_products(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import features

    layer = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 4, 4), torch.nn.Flatten(2), torch.nn.Linear(4, 5))
    with torch.inference_mode(), features.Products() as products:
        layer(torch.rand(2, 3, 8, 8))
    # The convolution has 2 x 4 outputs of 48 inputs, the linear layer 2 x 8 rows.
    assert dict(products.sizes) == {(1, 8, 48, 8): 1, (1, 16, 4, 5): 1}


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
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    clock = forecasts.PosesClock()
    for at, stage, done, total in (
        (0, "poses", 0, 21), (20, "poses", 10, 21), (21, "matching", 0, 45), (60, "matching", 45, 45),
        (61, "poses", 11, 21), (90, "poses", 21, 21),
    ):  # fmt: skip
        now[0] = float(at)
        clock(Event(stage, done, total))
    assert clock.taken == {"SIFT features": 21.0, "matching": 39.0}
