"""``--as-in-paper``: one flag builds, asks and compares as the paper describes it."""

from dataclasses import replace

import pytest
from support import color_encoder
from support.experiments import CONFIG

from lexsplat import open_scene
from lexsplat.evaluation.ablate import paper_evaluation
from lexsplat.evaluation.experiments import Bench
from lexsplat.features import FeatureConfig
from lexsplat.pipeline.build import build
from lexsplat.queries.relevancy import CANONICAL_PHRASES

PAPER = replace(
    CONFIG, as_in_paper=True, method="averaged", features=FeatureConfig(random_crops=40, map_cells=18)
)


@pytest.mark.slow
def test_a_build_as_in_the_paper_trains_jointly_and_is_asked_with_a_fixed_threshold(
    tiny_capture, tmp_path, monkeypatch
):
    color_encoder.install(monkeypatch)
    folder = build(tiny_capture, tmp_path / "scene", PAPER)
    assert folder.record["stages"]["reconstruct"]["joint"]
    config = folder.record["config"]
    assert (config["method"], config["features"]["mode"]) == ("trained", "random")
    assert not folder.read_gaussians().antialiased
    scene = open_scene(folder.root)
    assert (scene.query.form, scene.query.compared) == ("feature", CANONICAL_PHRASES)
    assert scene.ask(["red", "blue"]).thresholds.tolist() == [0.5, 0.5]


@pytest.mark.slow
def test_a_bench_as_in_the_paper_shares_one_geometry(tiny_capture, tmp_path, monkeypatch):
    color_encoder.install(monkeypatch)
    bench = Bench(tiny_capture, tmp_path, PAPER, paper_evaluation())
    assert not bench.config.joint
    assert bench.config.codebook.init == "uniform"
    assert bench.folder.record["config"]["features"]["mode"] == "random"
