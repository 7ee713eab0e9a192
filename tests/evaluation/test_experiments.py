"""The bench of ablate and compare: shared stages, kept runs, damaged files, and the files of the results."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.experiments import CONFIG
from support.schemas import validated

from lexsplat.evaluation.ablate import make_language, paper_evaluation
from lexsplat.evaluation.experiments import Bench, Row
from lexsplat.runtime.errors import CaptureError, SceneFolderError
from lexsplat.scenes.folder import SceneFolder

pytestmark = pytest.mark.usefixtures("color_encoders")

AVERAGED = replace(CONFIG, method="averaged", iterations=4)


@pytest.fixture
def open_bench(tiny_capture, tmp_path_factory):
    """Opens a bench on the same output folder each time."""
    output = tmp_path_factory.getbasetemp() / "shared bench"
    return lambda: Bench(tiny_capture, output, AVERAGED, paper_evaluation())


def row(bench, calls, name="mine", settings=()):
    """A row of the language of the bench's settings; counts how often it is made."""

    def make(seed):
        calls.append(seed)
        return make_language(bench, replace(bench.config, seed=seed))

    return Row(name, settings, make)


@pytest.mark.slow
def test_features_have_dino_whatever_the_method_of_the_settings(open_bench):
    bench = open_bench()
    assert bench.config.method == "averaged"
    assert next(iter(bench.maps.values())).dino is not None
    assert list(bench.folder.record["stages"]) == ["reconstruct", "features"]


@pytest.mark.slow
def test_a_codebook_is_made_once_and_again_if_its_file_is_damaged(open_bench):
    bench = open_bench()
    first, maps, _ = bench.codebook(CONFIG.codebook, 0)
    (path,) = (bench.output / "codebooks").iterdir()
    time = path.stat().st_mtime_ns
    again, same, _ = open_bench().codebook(CONFIG.codebook, 0)
    assert path.stat().st_mtime_ns == time
    assert torch.equal(first.clip, again.clip)
    assert all(np.array_equal(maps[name], same[name]) for name in maps)
    assert set(maps) == set(bench.capture.train_names)
    path.write_bytes(b"damaged")
    repaired, _, _ = open_bench().codebook(CONFIG.codebook, 0)
    assert torch.equal(first.clip, repaired.clip)
    assert path.stat().st_size > 100


@pytest.mark.slow
def test_a_run_is_kept_until_its_settings_change_or_its_file_is_damaged(open_bench):
    bench, calls = open_bench(), []
    first = bench.run(row(bench, calls), 0)
    bench = open_bench()
    kept = bench.run(row(bench, calls), 0)
    assert kept.result == json.loads(json.dumps(first.result))
    assert calls == [0]
    bench.run(row(bench, calls, settings=["another"]), 0)
    assert calls == [0, 0]
    path = bench.output / "runs" / "mine" / "seed-0.json"
    path.write_text("{")
    bench.run(row(bench, calls, settings=["another"]), 0)
    assert json.loads(path.read_text())["name"] == "mine"


@pytest.mark.slow
def test_every_file_is_written_after_every_run_and_both_commands_keep_their_own(open_bench):
    bench = open_bench()

    def stop(seed):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench.measure(
            "comparison", [row(bench, [], "one"), Row("two", ["stopped"], stop)], [0], ("mIoU", "mAP")
        )
    names = {f"comparison.{ending}" for ending in ("json", "csv", "tex", "html")}
    assert names <= {path.name for path in bench.output.iterdir()}
    record = json.loads((bench.output / "comparison.json").read_text())
    assert [row["name"] for row in record["rows"]] == ["one"]
    assert record["ground_truth"]["layout"] == "segmentations"
    validated("comparison", record)
    before = (bench.output / "comparison.html").read_bytes()
    bench.measure("ablation", [row(bench, [], "one")], [0])
    assert (bench.output / "comparison.html").read_bytes() == before
    assert (bench.output / "ablation.html").is_file()
    validated("ablation", json.loads((bench.output / "ablation.json").read_text()))


@pytest.mark.slow
def test_crop_sizes_of_features_of_another_program_are_refused(open_bench, tmp_path):
    bench = open_bench()
    averaged = replace(bench.config.averaged, sightings=0)
    bench.config = replace(bench.config, averaged=averaged, features_from=tmp_path)
    with pytest.raises(CaptureError, match="several crop sizes"):
        bench.level_maps("view_01.png")


def test_results_are_not_written_into_a_scene(tiny_capture, tmp_path):
    SceneFolder(tmp_path / "scene").save()
    with pytest.raises(
        SceneFolderError, match="expected a folder of its own for all results, found a scene; give"
    ):
        Bench(tiny_capture, tmp_path / "scene", AVERAGED, paper_evaluation())
    assert [path.name for path in (tmp_path / "scene").iterdir()] == ["scene.json"]
