"""Claims about the language losses; references are NumPy float64 loops and their difference quotients."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lexsplat.language import losses
from lexsplat.language.losses import cross_entropy_loss, mean_in_blocks, smoothing_loss, uncertainty_loss


def numeric_gradient(function: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    gradient = np.zeros_like(at)
    for index in np.ndindex(at.shape):
        step = np.zeros_like(at)
        step[index] = 1e-6
        gradient[index] = (function(at + step) - function(at - step)) / 2e-6
    return gradient


def reference_cross_entropy(logits: np.ndarray, codes: np.ndarray, uncertainties: np.ndarray | None) -> float:
    total = 0.0
    for i, row in enumerate(logits):
        probability = math.exp(row[codes[i]]) / sum(math.exp(value) for value in row)
        total += -math.log(probability) * (1 if uncertainties is None else 1 - uncertainties[i])
    return total / len(logits)


@pytest.fixture
def pixels() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(6, 5)), rng.integers(0, 5, 6), rng.random(6)


def test_cross_entropy_is_equation_9(pixels) -> None:
    logits, codes, _ = pixels
    tensor = torch.tensor(logits, requires_grad=True)
    loss = cross_entropy_loss(tensor, torch.tensor(codes))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(reference_cross_entropy(logits, codes, None), rel=1e-12)
    expected = numeric_gradient(lambda at: reference_cross_entropy(at, codes, None), logits)
    np.testing.assert_allclose(tensor.grad, expected, atol=1e-8)


def test_cross_entropy_with_uncertainty_is_equation_10(pixels) -> None:
    logits, codes, uncertainties = pixels
    tensor, u = torch.tensor(logits, requires_grad=True), torch.tensor(uncertainties, requires_grad=True)
    loss = cross_entropy_loss(tensor, torch.tensor(codes), u)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(
        reference_cross_entropy(logits, codes, uncertainties), rel=1e-12
    )
    by_logits = numeric_gradient(lambda at: reference_cross_entropy(at, codes, uncertainties), logits)
    by_u = numeric_gradient(lambda at: reference_cross_entropy(logits, codes, at), uncertainties)
    np.testing.assert_allclose(tensor.grad, by_logits, atol=1e-8)
    np.testing.assert_allclose(u.grad, by_u, atol=1e-8)


def test_cross_entropy_takes_byte_codes(pixels) -> None:
    logits, codes, _ = pixels
    assert float(
        cross_entropy_loss(torch.tensor(logits), torch.tensor(codes, dtype=torch.uint8))
    ) == pytest.approx(reference_cross_entropy(logits, codes, None))


@pytest.mark.parametrize(
    ("form", "reference"),
    [
        ("linear", lambda u: float(np.mean(u))),
        ("log", lambda u: float(np.mean([-math.log(1 - value) for value in u.ravel()]))),
    ],
)
def test_uncertainty_loss_is_equation_11_or_the_released_form(form, reference) -> None:
    uncertainties = np.random.default_rng(1).random((4, 3)) * 0.9
    tensor = torch.tensor(uncertainties, requires_grad=True)
    loss = uncertainty_loss(tensor, form)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(reference(uncertainties), rel=1e-12)
    np.testing.assert_allclose(tensor.grad, numeric_gradient(reference, uncertainties), rtol=1e-6)


def test_log_form_is_finite_where_rendering_reaches_one() -> None:
    tensor = torch.tensor([1.0, 1.0 + 1e-6, 0.5], requires_grad=True)
    loss = uncertainty_loss(tensor, "log")
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(tensor.grad).all()


@pytest.mark.parametrize("cross_entropy", [2.0, 5.0])
def test_log_form_has_the_stationary_point_the_linear_form_lacks(cross_entropy: float) -> None:
    # d/dU [CE (1 - U) - log(1 - U)] = 0 at U = 1 - 1 / CE; with the linear form the derivative is 1 - CE
    # everywhere.
    u = torch.tensor(1 - 1 / cross_entropy, dtype=torch.float64, requires_grad=True)
    (cross_entropy * (1 - u) + uncertainty_loss(u, "log")).backward()
    assert float(u.grad) == pytest.approx(0, abs=1e-12)
    u = torch.tensor(1 - 1 / cross_entropy, dtype=torch.float64, requires_grad=True)
    (cross_entropy * (1 - u) + uncertainty_loss(u, "linear")).backward()
    assert float(u.grad) == pytest.approx(1 - cross_entropy)


def reference_smoothing(
    smoothed, fixed_smoothed, semantics, fixed_semantics, u, least, weight, squared
) -> float:
    """Eq. 14 with the arguments under a stop-gradient passed separately."""
    total = 0.0
    for n in range(len(u)):
        teach = math.sqrt(sum((smoothed[n] - fixed_semantics[n]) ** 2))
        follow = math.sqrt(sum((fixed_smoothed[n] - semantics[n]) ** 2))
        if squared:
            teach, follow = teach**2, follow**2
        pull = max(u[n], least) if weight == "max" else (1 - u[n]) * least + u[n]
        total += teach + pull * follow
    return total / len(u)


@pytest.mark.parametrize("weight", ["max", "linear"])
@pytest.mark.parametrize("squared", [False, True])
def test_smoothing_loss_is_equation_14_with_its_stop_gradients(weight: str, squared: bool) -> None:
    rng = np.random.default_rng(2)
    smoothed, semantics, u = (
        rng.normal(size=(5, 8)),
        rng.normal(size=(5, 8)),
        np.array([0, 0.05, 0.3, 0.8, 1]),
    )
    tensors = [torch.tensor(value, requires_grad=True) for value in (smoothed, semantics, u)]
    loss = smoothing_loss(*tensors, 0.1, weight=weight, squared=squared)
    loss.backward()

    def reference(a: np.ndarray, b: np.ndarray) -> float:
        return reference_smoothing(a, smoothed, b, semantics, u, 0.1, weight, squared)

    assert float(loss.detach()) == pytest.approx(reference(smoothed, semantics), rel=1e-12)
    by_smoothed = numeric_gradient(lambda at: reference(at, semantics), smoothed)
    by_semantics = numeric_gradient(lambda at: reference(smoothed, at), semantics)
    np.testing.assert_allclose(tensors[0].grad, by_smoothed, atol=1e-8)
    np.testing.assert_allclose(tensors[1].grad, by_semantics, atol=1e-8)
    assert tensors[2].grad is None


def test_smoothing_gradient_is_finite_where_the_mlp_is_exact() -> None:
    same = torch.randn(3, 8, requires_grad=True)
    copy = same.detach().clone().requires_grad_()
    smoothing_loss(same, copy, torch.zeros(3)).backward()
    assert torch.equal(same.grad, torch.zeros(3, 8))
    assert torch.equal(copy.grad, torch.zeros(3, 8))


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_the_two_smoothing_weights_agree_at_the_ends_only(seed: int, u: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    smoothed, semantics = torch.randn(2, 4, 8, generator=generator, dtype=torch.float64)
    uncertainties = torch.full((4,), u, dtype=torch.float64)
    paper = smoothing_loss(smoothed, semantics, uncertainties, 0.1)
    released = smoothing_loss(smoothed, semantics, uncertainties, 0.1, weight="linear")
    assert float(released) >= float(paper) - 1e-12
    if u in (0.0, 1.0):
        assert float(released) == pytest.approx(float(paper))


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="logits"):
        cross_entropy_loss(torch.zeros(3, 2), torch.zeros(4, dtype=torch.long))
    with pytest.raises(ValueError, match="uncertainties"):
        cross_entropy_loss(torch.zeros(3, 2), torch.zeros(3, dtype=torch.long), torch.zeros(3, 1))
    with pytest.raises(ValueError, match="linear"):
        uncertainty_loss(torch.zeros(1), "cubic")
    with pytest.raises(ValueError, match="max"):
        smoothing_loss(torch.zeros(1, 8), torch.zeros(1, 8), torch.zeros(1), weight="min")


@pytest.mark.parametrize("count", [7, 8, 21])
def test_a_mean_in_blocks_has_the_value_and_the_gradients_of_the_whole(monkeypatch, count):
    monkeypatch.setattr(losses, "CPU_BLOCK", 8)
    rng = torch.Generator().manual_seed(0)
    decoder = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.ReLU(), torch.nn.Linear(4, 5)).double()
    given = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    codes = torch.randint(5, (count,), generator=rng)
    uncertain = torch.rand(count, generator=rng, dtype=torch.float64)

    def found(mean) -> tuple[torch.Tensor, ...]:
        x, u = given.clone().requires_grad_(), uncertain.clone().requires_grad_()
        parameters = list(decoder.parameters())
        value = mean(lambda *rows: cross_entropy_loss(decoder(rows[0]), *rows[1:]), (x, codes, u), parameters)
        return (value.detach(), *torch.autograd.grad(3 * value + u.sum(), [x, u, *parameters]))

    whole = found(lambda loss, rows, parameters: loss(*rows))
    for one, other in zip(found(mean_in_blocks), whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
