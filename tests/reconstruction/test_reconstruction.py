"""Reconstruction of a ray-traced capture: quality, bit-identical resumption and error messages."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from support.held_out import held_out_psnr

from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor, reconstruct
from lexsplat.rendering import render
from lexsplat.runtime.errors import TrainingError

SHORT = ReconstructionConfig(
    iterations=24, sh_degree=1, max_gaussians=1_300, densify_min_every=5, warm_up=0.2, reset_opacities=True
)


@pytest.fixture(scope="module")
def trained(capture, points):
    config = ReconstructionConfig(
        iterations=150,
        sh_degree=1,
        max_gaussians=2_000,
        densify_min_every=20,
        means_rate=5e-4,
        scales_rate=2e-2,
        sh0_rate=2e-2,
    )
    trainer = Reconstructor(capture, config, points)
    before = held_out_psnr(trainer, capture)
    trainer.run()
    return trainer, before


@pytest.mark.slow
def test_held_out_views_become_sharp(capture, trained):
    trainer, before = trained
    assert held_out_psnr(trainer, capture) > max(18.0, before + 6.0)


@pytest.mark.slow
def test_density_control_adds_gaussians_within_the_cap(points, trained):
    assert len(points.points) < len(trained[0].gaussians()) <= 2_000


def test_the_result_is_detached_and_records_the_mip_filter(trained):
    gaussians = trained[0].gaussians()
    assert gaussians.antialiased
    assert not any(tensor.requires_grad for tensor in gaussians.tensors().values())


@pytest.mark.slow
@pytest.mark.parametrize("change", [{}, {"strategy": "mcmc"}, {"exposure": True}])
def test_a_resumed_training_equals_an_uninterrupted_one_bit_for_bit(capture, points, change):
    config = dataclasses.replace(SHORT, **change)
    straight = Reconstructor(capture, config, points, seed=5)
    straight.run()

    first = Reconstructor(capture, config, points, seed=5)
    for _ in range(13):
        first.step()
    saved = {name: value.clone() for name, value in first.state_dict().items()}
    first.step()  # the saved state must not change with the training
    second = Reconstructor(capture, config, points, seed=6)
    second.load_state_dict(saved)
    second.run()

    left, right = straight.state_dict(), second.state_dict()
    assert left.keys() == right.keys()
    for name in left:
        assert torch.equal(left[name], right[name]), name


def test_state_survives_safetensors(capture, points, tmp_path):
    from safetensors.torch import load_file, save_file

    trainer = Reconstructor(capture, SHORT, points)
    for _ in range(12):
        trainer.step()
    save_file(trainer.state_dict(), tmp_path / "state.safetensors")
    other = Reconstructor(capture, SHORT, points, seed=1)
    other.load_state_dict(load_file(tmp_path / "state.safetensors"))
    assert trainer.step() == other.step()


@pytest.mark.slow
def test_results_depend_on_the_seed_but_not_on_the_global_generator_or_threads(capture, points):
    def means(seed: int, outside: int) -> torch.Tensor:
        threads = torch.get_num_threads()
        torch.manual_seed(outside)
        torch.set_num_threads(1 + 2 * outside)
        trainer = Reconstructor(capture, SHORT, points, seed=seed)
        for _ in range(8):
            trainer.step()
        torch.set_num_threads(threads)
        return trainer.gaussians().means

    assert torch.equal(means(0, 0), means(0, 1))
    assert not torch.equal(means(0, 0), means(1, 0))


def test_every_view_is_visited_once_per_round(capture, points):
    trainer = Reconstructor(capture, SHORT, points)
    visited = []
    for _ in range(2 * len(capture.train_names)):
        visited.append(trainer._next_view())
        trainer.steps_done += 1
    rounds = np.array(visited).reshape(2, -1)
    assert (np.sort(rounds, axis=1) == np.arange(len(capture.train_names))).all()
    assert (rounds[0] != rounds[1]).any()


@pytest.mark.slow
def test_events_count_up_to_the_end(capture):
    events = []
    reconstruct(
        capture, dataclasses.replace(SHORT, iterations=25, reset_opacities=False), listener=events.append
    )
    events = [event for event in events if event.stage != "kernels"]  # of the first training on a machine
    assert [event.done for event in events] == [0, 10, 20, 25]
    assert {event.stage for event in events} == {"reconstruct"}
    assert all(event.total == 25 for event in events)
    assert all(event.metrics["gaussians"] > 0 for event in events[1:])
    assert all(5 < event.metrics["psnr"] < 50 for event in events[1:])


@pytest.mark.slow
def test_a_memory_budget_of_zero_does_not_change_results(capture, points):
    results = []
    for memory in (0, 4 << 30):
        trainer = Reconstructor(capture, SHORT, points, memory=memory)
        for _ in range(15):
            trainer.step()
        results.append(trainer.gaussians().means)
    assert torch.equal(*results)


@pytest.mark.slow
def test_masked_pixels_do_not_affect_the_result(tiny_capture, tmp_path, points):
    captures = []
    for name, paint in (("plain", False), ("painted", True)):
        folder = shutil.copytree(tiny_capture, tmp_path / name)
        (folder / "masks").mkdir()
        for file in (folder / "images").iterdir():
            image = np.array(Image.open(file))
            mask = np.full(image.shape[:2], 255, np.uint8)
            mask[:30, :40] = 0
            Image.fromarray(mask).save(folder / "masks" / file.name)
            if paint:
                image[:30, :40] = 255
                Image.fromarray(image).save(file)
        captures.append(load_capture(folder))
    assert captures[0].train_views[0].load_valid() is not None
    colors = []
    for capture in captures:
        trainer = Reconstructor(capture, dataclasses.replace(SHORT, warm_up=0.5), points)
        for _ in range(12):
            trainer.step()
        colors.append(trainer.gaussians().sh0)
    assert torch.equal(*colors)


@pytest.mark.slow
def test_the_exposure_model_fits_a_darker_photo(capture, points, tiny_capture, tmp_path):
    folder = shutil.copytree(tiny_capture, tmp_path / "dark")
    dark = capture.train_names[2]
    image = np.array(Image.open(folder / "images" / dark)) * 0.6
    Image.fromarray(image.astype(np.uint8)).save(folder / "images" / dark)
    config = dataclasses.replace(
        SHORT, iterations=60, densify_min_every=60, reset_opacities=False, exposure=True, exposure_rate=2e-2
    )
    trainer = Reconstructor(load_capture(folder), config, points)
    trainer.run()
    gains = trainer._exposures.matrices.detach()[:, :, :3].diagonal(dim1=1, dim2=2).mean(1)
    assert int(gains.argmin()) == 2
    assert float(gains.mean()) == pytest.approx(1.0, abs=1e-5)


def test_divergence_is_detected(capture, points):
    trainer = Reconstructor(capture, SHORT, points)
    with torch.no_grad():
        trainer._parameters["sh0"].fill_(float("nan"))
    with pytest.raises(TrainingError, match="nan at iteration 1"):
        trainer.step()


def test_a_capture_without_points_or_training_views_is_refused(capture):
    nothing = InitialPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), "capture", "")
    with pytest.raises(TrainingError, match="initial points"):
        Reconstructor(capture, SHORT, nothing)
    with pytest.raises(TrainingError, match="training view"):
        Reconstructor(dataclasses.replace(capture, train_names=()), SHORT, nothing)


def test_points_beyond_the_cap_are_thinned(capture, points):
    trainer = Reconstructor(capture, dataclasses.replace(SHORT, max_gaussians=100), points)
    means = trainer.gaussians().means
    assert len(means) == 100
    known = {tuple(point) for point in points.points.tolist()}
    assert len({tuple(mean) for mean in means.tolist()} & known) == 100


def test_an_incomplete_checkpoint_is_refused(capture, points):
    trainer = Reconstructor(capture, SHORT, points)
    state = trainer.state_dict()
    del state["parameters/means"]
    with pytest.raises(ValueError, match="parameters/means"):
        trainer.load_state_dict(state)


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": 0},
        {"ssim_weight": 1.5},
        {"sh_degree": 5},
        {"warm_up": -0.1},
        {"initial_opacity": 1.0},
        {"cool_down": 1.1},
        {"renewal": 1.0},
    ],
)
def test_settings_out_of_range_are_named(change):
    (name,) = change
    with pytest.raises(ValueError, match=name):
        ReconstructionConfig(**change)


def test_the_full_length_uses_the_rates_and_schedule_of_3dgs():
    config = ReconstructionConfig()
    expected = {"means": 3.2e-4, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 5e-2, "sh0": 2.5e-3}
    assert config.rates(extent=2.0) == pytest.approx({**expected, "shN": 2.5e-3 / 20})
    assert config.warm_up_iterations == 0
    assert config.renewed_share == 0
    assert config.cooling(29_999) == 1.0
    assert config.is_long


def test_short_trainings_use_higher_rates_and_start_at_low_resolution():
    config = ReconstructionConfig(iterations=3_750)
    assert config.rates(1.0)["means"] == pytest.approx(3.2 * 1.6e-4)
    assert config.rates(1.0)["opacity_logits"] == 5e-2
    assert config.warm_up_iterations == 1_125
    assert config.renewed_share == 0.15
    assert not config.is_long


@pytest.mark.parametrize(
    ("changes", "scale"),
    [
        ({}, 3.2),
        ({"cool_down": 0.0}, 2),
        ({"strategy": "mcmc"}, 2),
        ({"iterations": 100}, 4.8),
        ({"iterations": 100, "cool_down": 0.0}, 3),
        ({"iterations": 30_000, "cool_down": 0.25}, 1.6),
    ],
)
def test_rates_are_higher_where_a_cool_down_settles_them(changes, scale):
    config = ReconstructionConfig(**{"iterations": 3_750, **changes})
    assert config.scale_of_rates == pytest.approx(scale)


@pytest.mark.parametrize(("renewal", "left"), [(None, 0), (0.15, 0), (0.0, 20)])
def test_rounds_at_the_cap_replace_the_gaussians_that_no_view_shows(capture, points, renewal, left):
    far = np.full((20, 3), 1e4, np.float32)  # beyond everything, and outside of every view
    started = dataclasses.replace(
        points,
        points=np.concatenate([points.points, far]),
        colors=np.concatenate([points.colors, np.zeros_like(far)]),
    )
    config = dataclasses.replace(SHORT, renewal=renewal, max_gaussians=len(started.points))
    trainer = Reconstructor(capture, config, started)
    for _ in range(5):
        trainer.step()
    assert count_far(trainer) == 20, "the first round is after the fifth step"
    trainer.step()
    assert count_far(trainer) == left
    assert len(trainer.gaussians()) <= config.max_gaussians


def test_below_the_cap_nothing_is_replaced(capture, points):
    trainer = Reconstructor(capture, dataclasses.replace(SHORT, max_gaussians=100_000), points)
    for _ in range(5):
        trainer.step()
    assert trainer._density.number_to_renew(5) == 0


def count_far(trainer) -> int:
    return int((trainer.gaussians().means > 1e3).all(1).sum())


def test_rates_fall_linearly_to_a_twentieth_at_the_end_of_a_short_training():
    config = ReconstructionConfig(iterations=1_000)
    steps = [0, 750, 800, 875, 975, 990, 1_000]
    assert [config.cooling(step) for step in steps] == pytest.approx([1, 1, 0.8, 0.5, 0.1, 0.05, 0.05])
    assert dataclasses.replace(config, cool_down=0.0).cooling(1_000) == 1.0


def test_all_optimizers_follow_the_cool_down_also_after_a_resume(capture, points):
    config = dataclasses.replace(SHORT, cool_down=0.5)
    trainer, resumed = (Reconstructor(capture, config, points) for _ in range(2))
    for _ in range(SHORT.iterations - 5):
        trainer.step()
    resumed.load_state_dict(trainer.state_dict())
    plain = config.rates(trainer._extent)
    for each in (trainer, resumed):
        each.step()
        groups = {name: optimizer.param_groups[0] for name, optimizer in each._optimizers.items()}
        cooled = {name: plain[name] * 5 / 12 for name in plain if name != "means"}
        assert {name: groups[name]["lr"] for name in cooled} == pytest.approx(cooled)
        assert groups["means"]["lr"] < plain["means"] * 5 / 12


def test_explicit_settings_take_precedence():
    config = ReconstructionConfig(iterations=100, warm_up=0.0, rate_scale=1.0, max_gaussians=7)
    assert config.warm_up_iterations == 0
    assert config.rates(1.0)["means"] == pytest.approx(1.6e-4)
    assert config.cap(torch.device("cuda")) == config.cap(torch.device("cpu")) == 7


def test_the_learning_rate_of_the_means_decays_to_a_hundredth(capture, points):
    trainer = Reconstructor(capture, dataclasses.replace(SHORT, cool_down=0.0), points)
    first = trainer._means_rate()
    trainer.steps_done = SHORT.iterations
    assert trainer._means_rate() == pytest.approx(first / 100)


@pytest.mark.parametrize("masked", [False, True])
def test_the_psnr_of_a_training_is_that_of_the_unmasked_pixels(tiny_capture, tmp_path, points, masked):
    folder = shutil.copytree(tiny_capture, tmp_path / "capture")
    for file in (folder / "images").iterdir() if masked else ():
        (folder / "masks").mkdir(exist_ok=True)
        mask = np.zeros(np.asarray(Image.open(file)).shape[:2], np.uint8)
        mask[10:30, 20:40] = 255
        Image.fromarray(mask).save(folder / "masks" / file.name)
    capture = load_capture(folder)
    trainer = Reconstructor(capture, dataclasses.replace(SHORT, warm_up=0.0), points)
    before = trainer.gaussians()
    before = before.select(torch.arange(len(before)))  # a copy: the step changes the parameters in place
    trainer.step()
    view = capture.views[trainer.last_view]
    background = torch.tensor(capture.background, dtype=torch.float32)
    image = render(before, view.camera, sh_degree=0, background=background).image.numpy()
    errors = (image.astype(float) - view.load_image()) ** 2
    counted = errors[10:30, 20:40] if masked else errors
    assert trainer.metrics["psnr"] == pytest.approx(-10 * np.log10(counted.mean()), abs=1e-3)
    nothing = (np.array(capture.background) - view.load_image()) ** 2
    counted = nothing[10:30, 20:40] if masked else nothing
    assert float(trainer.state_dict()["nothing_error"]) == pytest.approx(counted.mean(), rel=1e-4)


def test_a_photo_that_is_masked_everywhere_says_nothing_about_the_psnr(
    capture, tiny_capture, tmp_path, points
):
    folder = shutil.copytree(tiny_capture, tmp_path / "capture")
    (folder / "masks").mkdir()
    shown = capture.train_names[0]
    for file in (folder / "images").iterdir():
        size = Image.open(file).size
        Image.new("L", size, 255 * (file.name == shown)).save(folder / "masks" / file.name)
    trainer = Reconstructor(load_capture(folder), SHORT, points)
    for _ in capture.train_names:
        before = trainer.state_dict()["recent_error"]
        trainer.step()
        changed = not trainer.state_dict()["recent_error"].allclose(before, rtol=0, equal_nan=True)
        assert changed == (trainer.last_view == shown)
