"""Density control compared with gsplat's strategies, or with the MCMC paper where gsplat requires CUDA."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from lexsplat.geometry.rotations import covariances
from lexsplat.reconstruction.densification import DensityControl, relocate
from lexsplat.reconstruction.settings import DensitySchedule, ReconstructionConfig


class Rules(ReconstructionConfig):
    density_schedule = DensitySchedule(start=2, stop=100, every=5, reset_every=20)


def some_parameters(count: int = 40, seed: int = 0) -> tuple[dict, dict]:
    """Parameters under gsplat's names, with optimizers that contain a state."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (3, 3)}
    parameters = {
        name: torch.nn.Parameter(torch.randn(count, *shape, generator=generator))
        for name, shape in shapes.items()
    }
    with torch.no_grad():
        parameters["scales"].mul_(0.5).sub_(4.0)
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in parameters.items()}
    for name, value in parameters.items():
        value.grad = torch.randn(value.shape, generator=generator)
        optimizers[name].step()
        value.grad = None
    return parameters, optimizers


def projected(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Projected centers with gradients, and radii, some of them zero."""
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.zeros(count, 2, requires_grad=True)
    means2d.grad = 3e-6 * torch.randn(count, 2, generator=generator)
    return means2d, torch.randint(0, 4, (count,), generator=generator).float()


def run(control: DensityControl, parameters: dict, optimizers: dict, steps: range) -> None:
    for step in steps:
        means2d, radii = projected(len(parameters["means"]), seed=step)
        control.step(
            parameters,
            optimizers,
            step,
            means2d=means2d,
            radii=radii,
            image_size=(200, 100),
            means_learning_rate=1e-5,
        )


def new_control(strategy: str = "default", **options) -> DensityControl:
    seed = options.pop("seed", 3)
    rules = {"strategy": strategy, "max_gaussians": 10_000, "reset_opacities": True, **options}
    return DensityControl(Rules(**rules), extent=1.0, seed=seed)


def assert_same(left: dict, right: dict) -> None:
    for name in left:
        assert torch.equal(left[name], right[name]), name


def test_default_control_equals_gsplats_strategy_up_to_its_missing_reset():
    from gsplat.strategy import DefaultStrategy

    ours, our_optimizers = some_parameters()
    run(new_control(), ours, our_optimizers, range(20))

    reference, optimizers = some_parameters()
    strategy = DefaultStrategy(refine_start_iter=2, refine_stop_iter=100, refine_every=5, reset_every=20)
    state = strategy.initialize_state(scene_scale=1.0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        for step in range(20):
            means2d, radii = projected(len(reference["means"]), seed=step)
            batched = torch.zeros(1, len(radii), 2, requires_grad=True)
            batched.grad = means2d.grad[None]
            info = {"means2d": batched, "radii": radii[None, :, None].expand(-1, -1, 2).contiguous()}
            info |= {"width": 200, "height": 100, "n_cameras": 1, "gaussian_ids": None}
            strategy.step_post_backward(reference, optimizers, state, step, info)

    assert len(ours["means"]) > 50
    assert_same(ours, reference)
    for name in ours:
        assert_same(our_optimizers[name].state[ours[name]], optimizers[name].state[reference[name]])


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(40, 120), st.sampled_from(["default", "mcmc"]), st.integers(0, 50))
def test_the_cap_is_never_exceeded(cap, strategy, seed):
    parameters, optimizers = some_parameters(seed=seed)
    control = new_control(strategy, max_gaussians=cap)
    for step in range(40):
        run(control, parameters, optimizers, range(step, step + 1))
        assert len(parameters["means"]) <= cap


def test_under_a_cap_the_gaussians_of_highest_gradient_grow():
    parameters, optimizers = some_parameters(count=10)
    with torch.no_grad():
        parameters["opacities"].fill_(2.0)
        parameters["scales"].fill_(-6.0)  # small enough to be cloned, not split
    originals = parameters["means"].detach().clone()
    means2d = torch.zeros(10, 2, requires_grad=True)
    means2d.grad = torch.linspace(1e-3, 1e-2, 10)[:, None].repeat(1, 2)
    control = new_control(max_gaussians=13)
    for step in range(3, 6):
        control.step(
            parameters,
            optimizers,
            step,
            means2d=means2d,
            radii=torch.ones(10),
            image_size=(100, 100),
            means_learning_rate=0.0,
        )
    assert torch.equal(parameters["means"].detach(), torch.cat([originals, originals[7:]]))


def test_opacities_are_reset_on_schedule_only():
    parameters, optimizers = some_parameters()
    control = new_control(min_opacity=0.005)
    run(control, parameters, optimizers, range(20))
    assert float(parameters["opacities"].detach().sigmoid().max()) > 0.5
    run(control, parameters, optimizers, range(20, 21))
    assert float(parameters["opacities"].detach().sigmoid().max()) == pytest.approx(0.01, rel=1e-5)
    assert not optimizers["opacities"].state[parameters["opacities"]]["exp_avg"].any()


@pytest.mark.parametrize("resets", [False, True])
def test_large_gaussians_are_removed_only_if_opacities_are_reset(resets):
    parameters, optimizers = some_parameters()
    with torch.no_grad():
        parameters["opacities"].fill_(3.0)
        parameters["scales"][:10] = -1.0  # 0.37, more than a tenth of the extent of 1
    run(new_control(reset_opacities=resets, grow_gradient=1.0), parameters, optimizers, range(26))
    assert len(parameters["means"]) == (30 if resets else 40)


def test_nothing_changes_after_the_stop():
    parameters, optimizers = some_parameters()
    before = {name: value.detach().clone() for name, value in parameters.items()}
    run(new_control(), parameters, optimizers, range(100, 125))
    assert_same(before, parameters)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_resumed_run_continues_bit_for_bit(strategy):
    straight, straight_optimizers = some_parameters()
    run(new_control(strategy), straight, straight_optimizers, range(40))

    parameters, optimizers = some_parameters()
    first = new_control(strategy)
    run(first, parameters, optimizers, range(23))
    second = new_control(strategy, seed=99)
    second.load_state_tensors(first.state_tensors())
    run(second, parameters, optimizers, range(23, 40))
    assert_same(straight, parameters)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_global_generator_is_neither_used_nor_changed(strategy):
    results = []
    for outside in (0, 1):
        torch.manual_seed(outside)
        before = torch.get_rng_state()
        parameters, optimizers = some_parameters()
        run(new_control(strategy), parameters, optimizers, range(12))
        assert torch.equal(torch.get_rng_state(), before)
        results.append(parameters)
    assert_same(*results)


def test_mcmc_relocates_faint_gaussians_and_grows_by_a_twentieth():
    parameters, optimizers = some_parameters(count=100)
    with torch.no_grad():
        parameters["opacities"][:30] = -8.0
    run(new_control("mcmc"), parameters, optimizers, range(5, 6))
    assert len(parameters["means"]) == 105
    assert float(parameters["opacities"].detach().sigmoid().min()) >= 0.005 * (1 - 1e-5)


def test_mcmc_moves_nothing_where_all_gaussians_are_faint():
    parameters, optimizers = some_parameters(count=100)
    with torch.no_grad():
        parameters["opacities"].fill_(-8.0)
    before = parameters["means"].detach().clone()
    run(new_control("mcmc", noise=0.0), parameters, optimizers, range(5, 6))
    assert torch.equal(parameters["means"], before)


def test_mcmc_noise_follows_the_covariance_and_spares_opaque_gaussians():
    parameters, optimizers = some_parameters(count=4000)
    with torch.no_grad():
        parameters["quats"].copy_(torch.tensor([1.0, 0, 0, 0]).expand(4000, 4))
        parameters["scales"].copy_(torch.tensor([-1.0, -2.0, -3.0]).expand(4000, 3))
        parameters["opacities"].fill_(-20.0)
        parameters["opacities"][2000:] = 8.0
    before = parameters["means"].detach().clone()
    run(new_control("mcmc", noise=1e5), parameters, optimizers, range(1))
    moved = parameters["means"].detach() - before
    # Sigma times standard normal numbers times the learning rate (1e-5) times the noise, times sigmoid(0.5).
    expected = torch.exp(2 * torch.tensor([-1.0, -2.0, -3.0])) / (1 + math.exp(-0.5))
    torch.testing.assert_close(moved[:2000].std(0), expected, rtol=0.06, atol=0)
    assert float(moved[2000:].abs().max()) < 1e-6


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20, 51])
@pytest.mark.parametrize("opacity", [0.02, 0.4, 0.95])
def test_copies_blend_to_the_gaussian_they_replace(copies, opacity):
    """By definition, copies have the same opacity at the center and the same integral along a line."""
    new_opacity, new_scale = relocate(
        torch.tensor([opacity]), torch.tensor([[0.7, 1.0, 2.0]]), torch.tensor([copies]), torch.empty(0)
    )
    o, s = float(new_opacity), float(new_scale[0, 1])
    blended = quad(lambda x: 1 - (1 - o * math.exp(-x * x / (2 * s * s))) ** copies, -12, 12, limit=200)[0]
    assert 1 - (1 - o) ** copies == pytest.approx(opacity, rel=1e-4)
    assert blended == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-4)
    torch.testing.assert_close(new_scale / new_scale[0, 1], torch.tensor([[0.7, 1.0, 2.0]]))


def test_relocation_equals_the_double_sum_of_the_paper():
    rng = np.random.default_rng(0)
    opacities, ratios = rng.uniform(0.01, 0.99, 50), rng.integers(1, 30, 50)
    scales = rng.uniform(0.1, 2, (50, 3))
    expected = []
    for o, n in zip(opacities, ratios, strict=True):
        new = 1 - (1 - o) ** (1 / n)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        expected.append((new, o / total))
    tensors = (torch.tensor(opacities), torch.tensor(scales), torch.tensor(ratios), torch.empty(0))
    new_opacities, new_scales = relocate(*tensors)
    np.testing.assert_allclose(new_opacities, [e[0] for e in expected], rtol=1e-9)
    np.testing.assert_allclose(new_scales, scales * np.array([e[1] for e in expected])[:, None], rtol=1e-9)


def test_copy_counts_beyond_the_table_use_its_last_entry():
    tensors = torch.tensor([0.5]), torch.ones(1, 3)
    most = relocate(*tensors, torch.tensor([51]), torch.empty(0))
    beyond = relocate(*tensors, torch.tensor([1000]), torch.empty(0))
    assert torch.equal(most[0], beyond[0])
    assert torch.equal(most[1], beyond[1])


def test_covariances_equal_gsplats_torch_function():
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(30, 4, generator=generator)
    scales = torch.rand(30, 3, generator=generator)
    expected, _ = _quat_scale_to_covar_preci(quats, scales, True, False)
    torch.testing.assert_close(covariances(quats, scales), expected, rtol=1e-5, atol=1e-6)


def test_gsplats_own_operators_are_restored():
    from gsplat.strategy import ops

    before = ops.compute_relocation, ops.quat_scale_to_covar_preci
    parameters, optimizers = some_parameters()
    run(new_control("mcmc"), parameters, optimizers, range(6))
    assert (ops.compute_relocation, ops.quat_scale_to_covar_preci) == before


def test_the_full_length_schedule_equals_that_of_3dgs():
    assert ReconstructionConfig().density_schedule == DensitySchedule(500, 15_000, 100, 3_000)
    assert ReconstructionConfig(strategy="mcmc").density_schedule.stop == 25_000


def test_short_and_long_trainings_have_the_same_number_of_mcmc_rounds():
    """Each round adds a twentieth; a tenth of the rounds would mean growth by 3 instead of 150,000."""
    configs = [ReconstructionConfig(iterations=count, strategy="mcmc") for count in (3_000, 30_000)]
    schedules = [config.density_schedule for config in configs]
    rounds = [(schedule.stop - schedule.start) // schedule.every for schedule in schedules]
    assert rounds == [245, 245]


def test_a_short_mcmc_training_has_steps_between_its_rounds():
    """Rounds after every step would halve opacities faster than steps can raise them, until all are faint."""
    assert ReconstructionConfig(strategy="mcmc", iterations=400).density_schedule.every == 2


@settings(max_examples=50)
@given(st.integers(1, 100_000), st.integers(1, 200))
def test_every_schedule_is_in_order(iterations, minimum):
    schedule = ReconstructionConfig(iterations=iterations, densify_min_every=minimum).density_schedule
    assert 0 <= schedule.start <= schedule.stop <= iterations
    assert schedule.every >= minimum
    assert schedule.reset_every >= 1


def test_a_cap_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="max_gaussians"):
        new_control(max_gaussians=0)


def test_an_unknown_strategy_is_refused():
    with pytest.raises(ValueError, match="strategy"):
        new_control("newest")
