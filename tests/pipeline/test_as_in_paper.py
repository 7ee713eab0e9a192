"""``--as-in-paper``: one flag builds, asks and compares as the paper describes it."""

import signal
from dataclasses import replace

import pytest
import torch
from support import color_encoder
from support.experiments import CONFIG

from lexsplat import open_scene
from lexsplat.evaluation.ablate import make_language, paper_evaluation
from lexsplat.evaluation.experiments import Bench
from lexsplat.features import FeatureConfig
from lexsplat.pipeline.build import build
from lexsplat.queries.relevancy import CANONICAL_PHRASES
from lexsplat.scenes.folder import SceneFolder

PAPER = replace(
    CONFIG, as_in_paper=True, method="averaged", features=FeatureConfig(random_crops=40, map_cells=18)
)


@pytest.fixture
def paper_folder(tiny_capture, tmp_path, monkeypatch) -> SceneFolder:
    """A build as in the paper."""
    color_encoder.install(monkeypatch)
    return build(tiny_capture, tmp_path / "scene", PAPER)


@pytest.mark.slow
def test_a_build_as_in_the_paper_trains_jointly_and_is_asked_with_a_fixed_threshold(paper_folder):
    stage = paper_folder.record["stages"]["reconstruct"]
    assert stage["joint"]
    assert "9 training photos are few" in stage["warnings"][0], "as where language comes later"
    config = paper_folder.record["config"]
    assert (config["method"], config["features"]["mode"]) == ("trained", "random")
    assert not paper_folder.read_gaussians().antialiased
    scene = open_scene(paper_folder.root)
    assert (scene.query.form, scene.query.compared) == ("feature", CANONICAL_PHRASES)
    assert scene.ask(["red", "blue"]).thresholds.tolist() == [0.5, 0.5]


@pytest.mark.slow
def test_a_row_as_in_the_paper_is_the_joint_training_of_the_build(paper_folder, tiny_capture, tmp_path):
    bench = Bench(tiny_capture, tmp_path / "bench", PAPER, paper_evaluation())
    assert bench.config.codebook.init == "uniform"
    assert bench.folder.record["config"]["features"]["mode"] == "random"
    made = make_language(bench, replace(bench.config, method="trained"))
    for name, tensor in paper_folder.read_gaussians().tensors().items():
        # The language does not change the geometry, so that rows have one in common.
        assert torch.equal(made.gaussians.tensors()[name], tensor)
        assert torch.equal(bench.gaussians.tensors()[name], tensor)
    expected = open_scene(paper_folder.root).field.tensors()
    assert expected.keys() == made.language.tensors().keys()
    assert all(torch.equal(made.language.tensors()[name], tensor) for name, tensor in expected.items())
    assert set(made.seconds) == {"codebook", "reconstruct"}
    other = make_language(bench, replace(bench.config, method="averaged"))
    assert other.gaussians is None, "only the method of the paper trains jointly"


@pytest.mark.slow
def test_a_row_that_was_stopped_goes_on_from_where_it_was(tiny_capture, tmp_path, monkeypatch):
    color_encoder.install(monkeypatch)
    seen = []

    def stopping(event):
        if event.stage == "reconstruct":
            seen.append(event.done)
            if len(seen) == stop_at:
                signal.raise_signal(signal.SIGINT)  # as Ctrl-C does

    bench = Bench(tiny_capture, tmp_path, replace(PAPER, checkpoint_seconds=0), paper_evaluation())
    bench.listener, settings = stopping, replace(bench.config, method="trained")
    stop_at = 2
    with pytest.raises(KeyboardInterrupt):
        make_language(bench, settings)
    first, stop_at = seen.copy(), 0
    make_language(bench, settings)
    assert seen[len(first)] > first[-1] > 0, "the second run starts where the first one was"
    assert not list((tmp_path / "checkpoints").iterdir()), "a finished training leaves no state"
