"""Language beside geometry from the first step: geometry receives nothing of it, language follows density control."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lexsplat.captures import Capture, load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints, initial_points
from lexsplat.codebook import Codebook
from lexsplat.language.methods.joint import JointTrainer
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.runtime.training import Checkpoint

pytestmark = pytest.mark.slow

STEPS = 40
GEOMETRY = ReconstructionConfig(iterations=STEPS, sh_degree=1, densify_min_every=5, max_gaussians=3000)
LANGUAGE = TrainedConfig(pixel_sample=256, smoothing_sample=64)
CODES = 4


@pytest.fixture(scope="module")
def capture(tiny_capture) -> Capture:
    return load_capture(tiny_capture, downscale=2.0)


@pytest.fixture(scope="module")
def points(capture) -> InitialPoints:
    return initial_points(capture)


def trainer(capture, points, strategy="default") -> JointTrainer:
    from dataclasses import replace

    cameras = {name: capture.views[name].camera for name in capture.train_names}
    rng = np.random.default_rng(0)
    code_maps = {name: rng.integers(0, CODES, (12, 16), dtype=np.uint8) for name in cameras}
    codebook = Codebook(torch.eye(CODES, 6), None, 0.0)
    reconstructor = Reconstructor(capture, replace(GEOMETRY, strategy=strategy), points, seed=1)
    return JointTrainer(reconstructor, cameras, code_maps, codebook, LANGUAGE, seed=2)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_language_does_not_change_geometry(capture, points, strategy):
    joint = trainer(capture, points, strategy)
    joint.run()
    gaussians, field = joint.result()
    alone = Reconstructor(capture, joint.reconstructor.config, points, seed=1)
    alone.run()
    for name, tensor in alone.gaussians().tensors().items():
        assert torch.equal(gaussians.tensors()[name], tensor), name
    assert len(field.semantics) == len(gaussians)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_language_follows_density_control(capture, points, strategy):
    joint = trainer(capture, points, strategy)
    changes = 0
    while not joint.reconstructor.done:
        before = joint.language.field.semantics.detach().clone()
        colors = joint.reconstructor.gaussians().sh0.clone()
        joint.reconstructor.step()
        origins = joint.reconstructor.origins
        after = joint.reconstructor.gaussians()
        if origins is None:
            assert len(after) == len(before)
            continue
        changes += 1
        assert len(origins) == len(after)
        assert int(origins.max()) < len(before)
        # A copy has the color of what it was copied from, up to the step that the optimizer takes.
        assert (after.sh0 - colors[origins]).abs().max() < 0.05
        joint.language.replace_gaussians(after, origins)
        assert torch.equal(joint.language.field.semantics.detach(), before[origins])
    assert changes > 2


def test_a_resumed_joint_training_is_bit_identical(capture, points, tmp_path):
    whole = trainer(capture, points)
    whole.run()

    class StopsHalfway(Checkpoint):
        def after_step(self, trainer) -> None:
            if trainer.reconstructor.steps_done == STEPS // 2:
                self.save(trainer)
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer(capture, points).run(checkpoint=StopsHalfway(tmp_path / "state", "same"))
    resumed = trainer(capture, points)
    assert Checkpoint(tmp_path / "state", "same").resume(resumed)
    assert resumed.reconstructor.steps_done == STEPS // 2
    resumed.run()
    for (name, ours), theirs in zip(
        whole.result()[1].tensors().items(), resumed.result()[1].tensors().values()
    ):
        assert torch.equal(ours, theirs), name


def test_joint_training_is_of_the_trained_field_only():
    with pytest.raises(ValueError, match="trained"):
        BuildConfig(joint=True)
    assert BuildConfig(joint=True, method="trained").joint


def test_the_command_line_trains_jointly(tiny_capture, tmp_path):
    import json

    from lexsplat import cli, open_scene

    output = tmp_path / "scene"
    options = ["--clip", "bundled", "--dino", "none", "--device", "cpu", "--iterations", "20",
               "--codebook.num-codes", "8", "--codebook.steps", "5", "--method", "trained", "--joint",
               "--downscale", "2", "--features.crop-sizes", "0.5",
               "--features.crop-strides", "0.5"]  # fmt: skip
    assert cli.main(["build", str(tiny_capture), "--output", str(output), *options]) == 0
    stages = json.loads((output / "scene.json").read_text())["stages"]
    assert list(stages) == ["features", "codebook", "reconstruct", "language"]
    opened = open_scene(output)
    assert opened.field.method == "trained"
    assert opened.scores(["ball"]).shape == (1, len(opened.gaussians))
