"""Claims about the language training: it follows the equations, moves no geometry, and learns."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.language_scene import IGNORED, LanguageScene, label_accuracy, make_scene

from lexsplat.language.code_maps import codes_at_pixels
from lexsplat.language.methods import trained
from lexsplat.language.methods.trained import _prepare_views, train_field
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import NOTE, Event
from lexsplat.runtime.training import Checkpoint

QUICK = TrainedConfig(
    iterations=80,
    render_downscale=1.0,
    pixel_sample=200,
    smoothing_sample=100,
    semantics_lr=0.1,
    decoder_lr=5e-3,
)


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene()


def train(balls, config, **options):
    return train_field(balls.gaussians, balls.cameras, balls.code_maps, balls.codebook, config, **options)


@settings(max_examples=60)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(1, 40), st.integers(1, 40))
def test_a_pixel_takes_the_cell_its_center_lies_in(rows: int, columns: int, height: int, width: int) -> None:
    code_map = torch.arange(rows * columns).reshape(rows, columns)
    found = codes_at_pixels(code_map, height, width, torch.arange(height * width))
    for pixel, code in enumerate(found.tolist()):
        y, x = divmod(pixel, width)
        row = math.floor((y + Fraction(1, 2)) * rows / height)
        column = math.floor((x + Fraction(1, 2)) * columns / width)
        assert code == row * columns + column


def test_training_recovers_known_labels_and_keeps_geometry(balls) -> None:
    before = {name: tensor.clone() for name, tensor in balls.gaussians.tensors().items()}
    events: list[Event] = []
    field = train(balls, QUICK, listener=events.append)
    assert label_accuracy(field, balls) > 0.95
    for name, tensor in balls.gaussians.tensors().items():
        assert torch.equal(tensor, before[name]), name
        assert tensor.grad is None
    assert events[-1].done == events[-1].total == 80
    assert events[-1].metrics["cross_entropy"] < events[1].metrics["cross_entropy"]


def test_coarse_index_maps_are_enough_for_coarse_balls(balls) -> None:
    coarse = {name: code_map[::2, ::2] for name, code_map in balls.code_maps.items()}
    field = train_field(balls.gaussians, balls.cameras, coarse, balls.codebook, QUICK)
    assert label_accuracy(field, balls) > 0.9


def test_rendering_smaller_learns_too(balls) -> None:
    assert label_accuracy(train(balls, replace(QUICK, render_downscale=2.0)), balls) > 0.9


def test_products_of_bfloat16_recover_known_labels(balls) -> None:
    assert label_accuracy(train(balls, replace(QUICK, mlp_precision="bfloat16")), balls) > 0.95


@pytest.mark.parametrize(("released", "bfloat16"), [(False, False), (True, False), (False, True)])
def test_a_full_step_has_the_loss_of_equation_15(balls, released: bool, bfloat16: bool) -> None:
    config = TrainedConfig().as_in_paper()
    if released:  # the options of the authors' code (docs/method.md)
        config = replace(
            config,
            uncertainty_form="log",
            smoothing_weight="linear",
            smoothing_squared=True,
            normalize_rendering=True,
        )
    config = replace(config, lambda_ce=0.7, lambda_u=1.3, lambda_s=0.9, lambda_smo=0.4)
    config = replace(config, mlp_precision="bfloat16" if bfloat16 else "float32")
    trainer = FieldTrainer(balls.gaussians, balls.codebook, config, seed=4)
    with torch.no_grad():
        trainer.field.uncertainty_logits.copy_(torch.randn(len(balls.gaussians)))
    camera, code_map = balls.cameras["view0"], balls.code_maps["view0"]
    with torch.no_grad():
        semantics, uncertainty = (
            part.double() for part in trainer.field.render_semantics(balls.gaussians, camera)
        )
        smoothed = trainer.field.smoother(balls.gaussians.means).double().numpy()
        own = trainer.field.semantics.double().numpy().copy()
        u = trainer.field.uncertainties.double().numpy()
        cross_entropy, regularizer, known = 0.0, 0.0, 0
        for y in range(camera.height):
            for x in range(camera.width):
                certain = 1 - float(uncertainty[y, x])
                regularizer += -math.log(certain) if released else 1 - certain
                if code_map[y, x] == IGNORED:
                    continue
                logits = trainer.field.decode(semantics[y, x].float()).double().numpy()
                entropy = math.log(sum(math.exp(value) for value in logits)) - logits[code_map[y, x]]
                cross_entropy, known = cross_entropy + entropy * certain, known + 1
    distance = np.linalg.norm(smoothed - own, axis=1)
    pull = (1 - u) * 0.1 + u if released else np.maximum(u, 0.1)
    smoothing = np.mean((1 + pull) * (distance**2 if released else distance))
    semantic = 0.7 * cross_entropy / known + 1.3 * regularizer / (camera.width * camera.height)
    losses = trainer.step(camera, code_map)
    error = abs(float(losses["loss"]) / (0.9 * semantic + 0.4 * smoothing) - 1)
    assert error < (4e-3 if bfloat16 else 1e-4)  # bfloat16 has eight significant bits
    assert not bfloat16 or error > 1e-7


def test_the_field_depends_on_the_seed_only(balls) -> None:
    config = replace(QUICK, iterations=6)
    torch.manual_seed(1)
    first = train(balls, config, seed=3).tensors()
    torch.manual_seed(2)
    second = train(balls, config, seed=3).tensors()
    other = train(balls, config, seed=4).tensors()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["semantics"], other["semantics"])


def test_a_resumed_training_is_bit_identical(balls, tmp_path) -> None:
    config = replace(QUICK, iterations=20)
    whole = train(balls, config, seed=5)

    class StopsAfterSeven(Checkpoint):
        def after_step(self, trainer) -> None:
            if trainer.steps_done == 7:
                self.save(trainer)
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(balls, config, seed=5, checkpoint=StopsAfterSeven(tmp_path / "state", "same"))
    trainer = FieldTrainer(balls.gaussians, balls.codebook, config, seed=5)
    checkpoint = Checkpoint(tmp_path / "state", "same")
    assert checkpoint.resume(trainer)
    assert trainer.iteration == 7
    resumed = train(balls, config, seed=5, checkpoint=checkpoint)
    for name, tensor in whole.tensors().items():
        assert torch.equal(resumed.tensors()[name], tensor), name


def test_a_state_of_another_scene_is_refused(balls) -> None:
    small = make_scene(per_ball=3, views=1)
    state = FieldTrainer(small.gaussians, small.codebook, QUICK).state_dict()
    with pytest.raises(ValueError, match="does not fit"):
        FieldTrainer(balls.gaussians, balls.codebook, QUICK).load_state_dict(state)


def test_every_view_has_its_turn_before_one_comes_again(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, QUICK, seed=2)
    names, order = sorted(balls.cameras), []
    for trainer.iteration in range(3 * len(names)):
        order.append(trainer.view_of_step(names))
    epochs = [order[i : i + len(names)] for i in range(0, len(order), len(names))]
    assert all(sorted(epoch) == names for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


def test_views_without_a_camera_are_not_looked_at(balls) -> None:
    class Explosive(dict):
        def __getitem__(self, name):
            assert name != "view7", "a held-out view was read"
            return super().__getitem__(name)

    cameras = {name: camera for name, camera in balls.cameras.items() if name != "view7"}
    code_maps = Explosive(balls.code_maps)
    train_field(balls.gaussians, cameras, code_maps, balls.codebook, replace(QUICK, iterations=20))


def test_projections_are_kept_as_long_as_the_memory_lasts(balls) -> None:
    views = _prepare_views(balls.gaussians, balls.cameras, QUICK, 1 << 30)
    assert all(prepared is not None for _, prepared in views.values())
    first = next(iter(views.values()))[1].nbytes
    few = _prepare_views(
        balls.gaussians, balls.cameras, QUICK, 4 * (first + 1)
    )  # a quarter is for projections
    assert [prepared is not None for _, prepared in few.values()] == [True, True] + [False] * (len(views) - 2)


@pytest.mark.parametrize(
    ("switch", "untouched"),
    [("use_uncertainty", "uncertainty_logits"), ("use_smoothing", "smoother.layers.0.weight")],
)
def test_an_ablation_leaves_its_parameters_alone(balls, switch: str, untouched: str) -> None:
    config = replace(QUICK, iterations=3)
    start = FieldTrainer(balls.gaussians, balls.codebook, config, seed=1).field.tensors()
    on, off = (train(balls, replace(config, **{switch: value}), seed=1).tensors() for value in (True, False))
    assert torch.equal(off[untouched], start[untouched])
    assert not torch.equal(on[untouched], start[untouched])


def test_without_uncertainty_the_cross_entropy_keeps_its_weight(balls) -> None:
    losses = {}
    for weight in (1.0, 0.5):
        config = replace(QUICK, use_uncertainty=False, use_smoothing=False, lambda_ce=weight)
        trainer = FieldTrainer(balls.gaussians, balls.codebook, config, seed=1)
        losses[weight] = trainer.step(balls.cameras["view0"], balls.code_maps["view0"])["loss"]
    assert float(losses[0.5]) == pytest.approx(0.5 * float(losses[1.0]))


def test_without_uncertainty_the_smoothing_has_its_least_weight(balls) -> None:
    config = replace(QUICK, use_uncertainty=False, smoothing_sample=0, min_smoothing_weight=0.25)
    trainer = FieldTrainer(balls.gaussians, balls.codebook, config, seed=1)
    with torch.no_grad():
        trainer.field.uncertainty_logits.fill_(5.0)  # a field that was tuned with uncertainties before
        distance = trainer.field.smoother(balls.gaussians.means) - trainer.field.semantics
        expected = 1.25 * float(distance.norm(dim=1).mean())
    losses = trainer.step(balls.cameras["view0"], balls.code_maps["view0"])
    assert float(losses["smoothing"]) == pytest.approx(expected, rel=1e-5)


def test_training_starts_as_the_paper_and_the_settings_say(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, replace(QUICK, num_frequencies=2))
    assert trainer.field.smoother.num_frequencies == 2
    assert not trainer.field.normalize_rendering
    assert trainer.field.uncertainties.tolist() == pytest.approx([0.01] * len(balls.gaussians))
    assert trainer.field.semantics.std().item() == pytest.approx(1, abs=0.1)  # N(0, 1)
    assert all(group["betas"] == (0.9, 0.999) for group in trainer.optimizer.param_groups)


def test_every_part_has_its_learning_rate_and_its_decay(balls) -> None:
    config = replace(
        QUICK, iterations=8, semantics_lr=0.1, uncertainty_lr=0.2, decoder_lr=0.3, smoothing_lr=0.4
    )
    config = replace(config, decoder_weight_decay=0.01, final_lr_factor=0.25)
    trainer = FieldTrainer(balls.gaussians, balls.codebook, config)
    field = trainer.field
    firsts = [field.semantics, field.uncertainty_logits, field.decoder[0].weight]
    firsts.append(field.smoother.layers[0].weight)

    def of_parts(key: str) -> list[float]:
        groups = [
            next(g for g in trainer.optimizer.param_groups if any(p is first for p in g["params"]))
            for first in firsts
        ]
        return [group[key] for group in groups]

    assert of_parts("weight_decay") == [0, 0, 0.01, 0]
    for iteration, factor in ((0, 1.0), (4, 0.5), (8, 0.25)):  # exponential: half way it is the root
        trainer.iteration = iteration
        trainer.step(balls.cameras["view0"], balls.code_maps["view0"])
        assert of_parts("lr") == pytest.approx([factor * rate for rate in (0.1, 0.2, 0.3, 0.4)])


def test_equations_12_and_15_weight_their_terms(balls) -> None:
    config = replace(QUICK, lambda_ce=2.0, lambda_u=0.5, lambda_s=3.0, lambda_smo=0.25)
    trainer = FieldTrainer(balls.gaussians, balls.codebook, config)
    found = trainer.step(balls.cameras["view0"], balls.code_maps["view0"])
    assert float(found["semantic"]) == pytest.approx(
        2.0 * float(found["cross_entropy"]) + 0.5 * float(found["uncertainty"])
    )
    assert float(found["loss"]) == pytest.approx(
        3.0 * float(found["semantic"]) + 0.25 * float(found["smoothing"])
    )


def test_smoothing_runs_every_so_many_steps(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, replace(QUICK, smoothing_every=3))
    steps = [trainer.step(balls.cameras["view0"], balls.code_maps["view0"]) for _ in range(6)]
    assert ["smoothing" in losses for losses in steps] == [True, False, False, True, False, False]


@pytest.mark.parametrize("form", ["linear", "log"])
def test_uncertainty_grows_where_views_disagree(balls, form: str) -> None:
    rng = np.random.default_rng(0)
    code_maps = {}
    for name, code_map in balls.code_maps.items():
        code_maps[name] = code_map.copy()
        ball = code_map == 1
        code_maps[name][ball] = rng.integers(0, balls.codebook.num_codes, int(ball.sum()))
    config = replace(QUICK, uncertainty_form=form, uncertainty_lr=0.1)
    field = train_field(balls.gaussians, balls.cameras, code_maps, balls.codebook, config)
    u = field.uncertainties.numpy()
    assert u[balls.labels == 1].mean() > 2 * u[balls.labels != 1].mean()


def test_a_stronger_w_s_gives_smoother_semantics(balls) -> None:
    rough = {}
    for weight in (0.0, 5.0):
        field = train(balls, replace(QUICK, min_smoothing_weight=weight, use_uncertainty=False))
        with torch.no_grad():
            distance = field.semantics - field.smoother(balls.gaussians.means)
            rough[weight] = float((distance.norm(dim=1) / field.semantics.norm(dim=1).mean()).mean())
    assert rough[5.0] < rough[0.0]


def test_ignored_views_teach_nothing_and_break_nothing(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, replace(QUICK, use_smoothing=False))
    before = trainer.field.semantics.detach().clone()
    losses = trainer.step(balls.cameras["view0"], np.full((3, 3), IGNORED, np.uint8))
    assert float(losses["loss"]) == 0
    assert torch.equal(trainer.field.semantics, before)


def test_language_follows_density_control(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, QUICK)
    trainer.step(balls.cameras["view0"], balls.code_maps["view0"])
    old = trainer.field.semantics.detach().clone()
    moment = trainer.optimizer.state[trainer.field.semantics]["exp_avg"].clone()
    parents = torch.tensor([5, 5, 0, 299, 17])
    trainer.replace_gaussians(balls.gaussians.select(parents), parents)
    assert torch.equal(trainer.field.semantics, old[parents])
    assert torch.equal(trainer.optimizer.state[trainer.field.semantics]["exp_avg"], moment[parents])
    trainer.step(balls.cameras["view1"], balls.code_maps["view1"])
    assert not torch.equal(trainer.field.semantics, old[parents])


def test_clipping_bounds_the_decoders_gradient(balls) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, replace(QUICK, clip_decoder_grad=1e-3))
    trainer.step(balls.cameras["view0"], balls.code_maps["view0"])
    squares = sum(float(p.grad.square().sum()) for p in trainer.field.decoder.parameters())
    assert math.sqrt(squares) <= 1e-3 * (1 + 1e-3)


def test_divergence_is_an_error_with_a_remedy(balls, monkeypatch) -> None:
    trainer = FieldTrainer(balls.gaussians, balls.codebook, QUICK)
    with torch.no_grad():
        trainer.field.semantics.fill_(torch.nan)
    monkeypatch.setattr("lexsplat.language.methods.trained.FieldTrainer", lambda *_, **__: trainer)
    with pytest.raises(TrainingError, match="lower the learning rates"):
        train(balls, replace(QUICK, iterations=25))


def test_bad_input_is_refused(balls) -> None:
    with pytest.raises(ValueError, match="no training view"):
        train_field(balls.gaussians, {}, {}, balls.codebook, QUICK)
    code_maps = {name: value for name, value in balls.code_maps.items() if name != "view1"}
    with pytest.raises(ValueError, match="no index map for view1"):
        train_field(balls.gaussians, balls.cameras, code_maps, balls.codebook, QUICK)
    with pytest.raises(ValueError, match="must be positive"):
        TrainedConfig(render_downscale=0)


def test_the_time_is_that_of_a_few_steps_and_they_leave_no_trace(balls, monkeypatch, caplog) -> None:
    short, clock, step = replace(QUICK, iterations=12), [0.0], FieldTrainer.step
    silent = train(balls, short)

    def timed(self, *view, **options):
        clock[0] += 50.0 if self.iteration < 2 else 7.0  # the first steps load kernels
        return step(self, *view, **options)

    monkeypatch.setattr(FieldTrainer, "step", timed)
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    monkeypatch.setattr(trained, "_TOLD_FROM", 12)
    with caplog.at_level(NOTE, "lexsplat"):
        told = train(balls, short)
    assert caplog.messages == ["language: about 1:24 min for 12 iterations"]
    assert torch.equal(told.semantics, silent.semantics)
