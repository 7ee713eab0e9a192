"""Adam on the CPU compared with torch's Adam, and its state as tensors."""

import pytest
import torch

from lexsplat.reconstruction.optimizers import adam, load_optimizer_tensors, optimizer_tensors


def gradients(shape: tuple[int, ...], count: int, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=generator) * 10.0 ** (-i) for i in range(count)]


@pytest.mark.parametrize("shape", [(5,), (7, 3), (100_001,)])
def test_steps_equal_torchs_in_double_precision(shape):
    start = torch.linspace(-1, 1, 5).repeat(shape[-1])[: shape[-1]].expand(shape).clone()
    ours = torch.nn.Parameter(start.clone())
    reference = torch.nn.Parameter(start.double())
    optimizer, expected = adam(ours, 1e-2), torch.optim.Adam([reference], lr=1e-2, eps=1e-15)
    for gradient in gradients(shape, 6):
        ours.grad, reference.grad = gradient.clone(), gradient.double()
        optimizer.step()
        expected.step()
        torch.testing.assert_close(ours.detach(), reference.detach().float(), rtol=1e-5, atol=1e-6)
    for name in ("exp_avg", "exp_avg_sq", "step"):
        torch.testing.assert_close(
            optimizer.state[ours][name].double(),
            expected.state[reference][name].double(),
            rtol=1e-4,
            atol=1e-8,
        )


def test_rows_without_any_gradient_do_not_change():
    parameter = torch.nn.Parameter(torch.ones(4))
    optimizer = adam(parameter, 0.1)
    parameter.grad = torch.tensor([0.0, 1.0, 0.0, -1.0])
    optimizer.step()
    torch.testing.assert_close(parameter.detach(), torch.tensor([1.0, 0.9, 1.0, 1.1]))


def test_rows_whose_gradient_becomes_zero_follow_torchs_adam():
    # The gradient of every second row is zero from the second step on, as that of a Gaussian in none of the views.
    ours, reference = torch.nn.Parameter(torch.ones(40, 3)), torch.nn.Parameter(torch.ones(40, 3).double())
    optimizer, expected = adam(ours, 1e-2), torch.optim.Adam([reference], lr=1e-2, eps=1e-15)
    before = torch.ones(20, 3)
    for i, gradient in enumerate(gradients((40, 3), 4)):
        if i:
            gradient[::2] = 0.0
        ours.grad, reference.grad = gradient.clone(), gradient.double()
        optimizer.step()
        expected.step()
        assert ((ours.detach()[::2] - before).abs() > 1e-4).all()
        before = ours.detach()[::2].clone()
        torch.testing.assert_close(ours.detach(), reference.detach().float(), rtol=1e-5, atol=1e-6)


def test_no_gradient_means_no_step():
    parameter = torch.nn.Parameter(torch.ones(4))
    optimizer = adam(parameter, 0.1)
    optimizer.step()
    assert torch.equal(parameter.detach(), torch.ones(4))
    assert optimizer_tensors(optimizer) == {}


def test_results_are_bit_identical_for_any_number_of_threads():
    results = []
    threads = torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        parameter = torch.nn.Parameter(torch.zeros(200_000))
        optimizer = adam(parameter, 1e-2)
        for gradient in gradients((200_000,), 3):
            parameter.grad = gradient
            optimizer.step()
        results.append(parameter.detach())
    torch.set_num_threads(threads)
    assert torch.equal(*results)


def test_a_loaded_state_continues_bit_for_bit():
    straight = torch.nn.Parameter(torch.ones(6))
    optimizer = adam(straight, 1e-2)
    steps = gradients((6,), 4)
    for i, gradient in enumerate(steps):
        if i == 2:
            saved, value = optimizer_tensors(optimizer), straight.detach().clone()
        straight.grad = gradient
        optimizer.step()
    resumed = torch.nn.Parameter(value)
    other = adam(resumed, 1e-2)
    load_optimizer_tensors(other, saved)
    for gradient in steps[2:]:
        resumed.grad = gradient
        other.step()
    assert torch.equal(straight.detach(), resumed.detach())
