"""Divergence is detected, reported and undone; captures that show nothing give finite scenes."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.language_scene import make_scene
from support.tiny_capture import write_capture

from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import initial_points
from lexsplat.language.methods.trained import train_field
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.training import ATTEMPTS, KEEP_EVERY, DivergenceGuard, run_training

pytestmark = pytest.mark.slow

ITERATIONS = 60


class Walk:
    """The smallest training: adds its rate to a number, and gets an invalid number at some value."""

    parameter_prefixes = ("value",)
    device, total_steps, metrics = torch.device("cpu"), 30, {"count": 1.0}

    def __init__(self, falls_at: float = float("inf"), wrong: float = float("nan")) -> None:
        self.value, self.rate_factor, self.steps_done = torch.zeros(2), 1.0, 0
        self.falls_at, self.wrong = falls_at, wrong

    def step(self) -> None:
        self.steps_done += 1
        self.value = self.value + self.rate_factor
        if self.rate_factor > 0.25 and float(self.value[0]) > self.falls_at:
            self.value[1] = self.wrong

    def find_invalid(self) -> str:
        return "" if bool(torch.isfinite(self.value).all()) else "NaN or Inf in value"

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"value": self.value.clone(), "steps": torch.tensor(self.steps_done)}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.value, self.steps_done = state["value"].clone(), int(state["steps"])


def run(walk: Walk) -> Walk:
    run_training(walk, stage="walk", name="walk", every=10)
    return walk


@pytest.fixture(autouse=True)
def copies_every_five_steps(monkeypatch):
    monkeypatch.setitem(KEEP_EVERY, "cpu", 5)


def test_a_healthy_training_takes_every_step_once(caplog):
    walk = run(Walk())
    assert walk.value.tolist() == [30.0, 30.0]
    assert not caplog.records


def test_an_invalid_parameter_restores_the_last_good_state_halves_the_rates_and_logs_one_line(caplog):
    walk = run(Walk(falls_at=12.0))
    # Steps of 1 as far as 10, the last good state; from there steps of 1/2, from 12 (step 14) of 1/4, as far as 30.
    assert walk.rate_factor == 0.25
    assert torch.isfinite(walk.value).all()
    assert walk.steps_done == 30
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 2
    assert all("walk diverged (NaN or Inf in value)" in line and "\n" not in line for line in lines)
    assert "learning rates are now 0.5 " in lines[0]
    assert "learning rates are now 0.25 " in lines[1]


def test_the_result_is_always_checked(monkeypatch):
    monkeypatch.setitem(KEEP_EVERY, "cpu", 1000)
    walk = run(Walk(falls_at=28.0))
    assert torch.isfinite(walk.value).all()


def test_a_training_that_always_diverges_fails_with_a_remedy():
    class Hopeless(Walk):
        def step(self) -> None:
            self.steps_done += 1
            self.value[0] = float("inf")

    walk = Hopeless()
    with pytest.raises(TrainingError, match=r"NaN or Inf in value.*lower the learning rates"):
        run(walk)
    assert walk.rate_factor == 0.5**ATTEMPTS


def test_other_errors_pass_through():
    guard = DivergenceGuard(Walk(), "walk")
    with pytest.raises(KeyError), guard:
        raise KeyError("no view")
    with pytest.raises(KeyboardInterrupt), guard:
        raise KeyboardInterrupt


# -- real trainings


def paint(folder, color_of) -> None:
    for number, path in enumerate(sorted((folder / "images").iterdir())):
        with Image.open(path) as image:
            size = image.size
        Image.fromarray(np.full((size[1], size[0], 3), color_of(number), np.uint8)).save(path)


def capture(tmp_path, name: str):
    """A capture without information, or with contradictory photos."""
    folder = write_capture(tmp_path / name, views=6, width=48, height=36)
    shutil.rmtree(folder / "segmentations")
    if name == "black":
        paint(folder, lambda number: 0)
    elif name == "white":
        paint(folder, lambda number: 255)
    elif name == "constant":
        paint(folder, lambda number: (200, 30, 60))
    elif name == "a color a view":
        paint(folder, lambda number: (40 * number, 255 - 40 * number, 128))
    elif name == "one point":
        points = folder / "sparse" / "0" / "points3D.txt"
        points.write_text("".join(f"{i} 0.1 0.2 0.3 200 100 50 0.5\n" for i in range(1, 3001)))
    return load_capture(folder)


CONFIG = ReconstructionConfig(iterations=ITERATIONS, sh_degree=1, max_gaussians=4000)


def reconstructed(scene, config=CONFIG):
    trainer = Reconstructor(scene, config, initial_points(scene))
    trainer.run()
    return trainer


@pytest.mark.parametrize("name", ["black", "white", "constant", "a color a view", "one point"])
def test_captures_without_content_give_finite_gaussians(tmp_path, name):
    gaussians = reconstructed(capture(tmp_path, name)).gaussians()
    assert len(gaussians) > 0
    assert not gaussians.find_invalid()


@pytest.mark.parametrize("times", [10.0, 1000.0])
def test_excessive_learning_rates_give_finite_numbers_or_one_error(tmp_path, times, caplog):
    rates = ("means_rate", "scales_rate", "quats_rate", "opacities_rate", "sh0_rate", "shN_rate")
    config = replace(CONFIG, **{name: getattr(CONFIG, name) * times for name in rates})
    trainer, message = None, ""
    try:
        trainer = reconstructed(capture(tmp_path, "sound"), config)
    except TrainingError as error:
        message = str(error)
    if trainer is None:
        assert "lower the learning rates" in message
    else:
        assert not trainer.find_invalid()
    assert all("diverged" in record.getMessage() for record in caplog.records)


def test_a_reconstruction_recovers_from_nan(tmp_path, caplog):
    scene = capture(tmp_path, "sound")
    trainer = Reconstructor(scene, CONFIG, initial_points(scene))
    healthy, steps = trainer.step, []

    def poisoned() -> float:
        value = healthy()
        steps.append(trainer.steps_done)
        if len(steps) == 30:  # as an overflowing gradient would leave it
            with torch.no_grad():
                trainer._parameters["log_scales"][3, 1] = float("nan")
        return value

    trainer.step = poisoned  # type: ignore[method-assign]
    with caplog.at_level(logging.WARNING, "lexsplat"):
        trainer.run()
    assert trainer.done
    assert not trainer.find_invalid()
    assert trainer.rate_factor == 0.5
    assert [r.getMessage().split(" (")[0] for r in caplog.records] == ["reconstruction diverged"]
    rates = [optimizer.param_groups[0]["lr"] for optimizer in trainer._optimizers.values()]
    full = [optimizer.param_groups[0]["lr"] for optimizer in reconstructed(scene)._optimizers.values()]
    assert rates == pytest.approx([rate / 2 for rate in full])


def test_renderings_much_worse_than_the_background_are_divergence(tmp_path):
    scene = capture(tmp_path, "sound")
    trainer = Reconstructor(scene, CONFIG, initial_points(scene))
    with torch.no_grad():
        trainer._parameters["sh0"].fill_(1e3)
    with pytest.raises(TrainingError, match="mean squared error"):
        trainer.step()


def test_the_guard_does_not_change_a_healthy_reconstruction(tmp_path):
    scene = capture(tmp_path, "sound")
    watched = reconstructed(scene).gaussians()
    bare = Reconstructor(scene, CONFIG, initial_points(scene))
    while not bare.done:
        bare.step()
    for name, tensor in bare.gaussians().tensors().items():
        assert torch.equal(tensor, watched.tensors()[name])


@pytest.mark.parametrize("times", [1.0, 10.0, 1e4])
def test_language_trained_with_any_rates_is_finite_or_fails_with_a_remedy(times, caplog):
    scene = make_scene(per_ball=10, views=4)
    config = TrainedConfig(iterations=60, pixel_sample=128, smoothing_sample=32, clip_decoder_grad=None)
    names = ("semantics_lr", "uncertainty_lr", "decoder_lr", "smoothing_lr")
    config = replace(config, **{name: getattr(config, name) * times for name in names})
    field, message = None, ""
    try:
        field = train_field(scene.gaussians, scene.cameras, scene.code_maps, scene.codebook, config)
    except TrainingError as error:
        message = str(error)
    if field is None:
        assert times > 10
        assert "lower the learning rates" in message
    else:
        assert all(bool(torch.isfinite(t).all()) for t in field.tensors().values() if t.is_floating_point())
    if times == 1.0:
        assert not caplog.records


def test_a_language_training_recovers_from_nan(caplog, monkeypatch):
    scene = make_scene(per_ball=10, views=4)
    config = TrainedConfig(iterations=60, pixel_sample=128, smoothing_sample=32)
    trainer = FieldTrainer(scene.gaussians, scene.codebook, config)
    healthy, count = trainer.step, []

    def poisoned(*arguments, **options):
        losses = healthy(*arguments, **options)
        count.append(1)
        if len(count) == 40:
            with torch.no_grad():
                trainer.field.semantics[0, 0] = float("inf")
        return losses

    trainer.step = poisoned  # type: ignore[method-assign]
    monkeypatch.setattr("lexsplat.language.methods.trained.FieldTrainer", lambda *_, **__: trainer)
    field = train_field(scene.gaussians, scene.cameras, scene.code_maps, scene.codebook, config)
    assert bool(torch.isfinite(field.semantics).all())
    assert trainer.iteration == 60
    assert trainer.rate_factor == 0.5
    assert sum("language field diverged" in record.getMessage() for record in caplog.records) == 1
