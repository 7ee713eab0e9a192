"""The optimizers of the reconstruction: one Adam per parameter, and its state as named tensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor


class Adam(torch.optim.Adam):
    """Adam with the epsilon of 3DGS, in one pass over memory.

    On CUDA this is torch's fused Adam, on a CPU our kernel. torch's fused Adam on a CPU gives results that differ in
    the last bit.

    Every number is updated, including those of Gaussians that the view does not show: their moments decay and still
    move them, so that skipping them would be a different optimizer.

    Args:
        parameter: The parameter to optimize, float32.
        rate: Learning rate.
    """

    def __init__(self, parameter: torch.nn.Parameter, rate: float) -> None:
        super().__init__([parameter], lr=rate, eps=1e-15, fused=parameter.device.type == "cuda")

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Update the parameter by its gradient, if it has one."""
        group = self.param_groups[0]
        (parameter,) = group["params"]
        if parameter.device.type != "cpu" or closure is not None:
            return super().step(closure)
        if parameter.grad is None:
            return None
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        state["step"] += 1
        _adam_on_cpu(parameter, parameter.grad, state, group)
        return None


def _adam_on_cpu(
    parameter: Tensor, gradient: Tensor, state: dict[str, Tensor], group: dict[str, Any]
) -> None:
    from lexsplat.reconstruction.adam_kernel import adam_step

    beta1, beta2 = group["betas"]
    count = float(state["step"])
    correction = math.sqrt(1.0 - beta2**count)
    adam_step(
        parameter.detach().view(-1).numpy(),
        gradient.contiguous().view(-1).numpy(),
        state["exp_avg"].view(-1).numpy(),
        state["exp_avg_sq"].view(-1).numpy(),
        rate=group["lr"] * correction / (1.0 - beta1**count),
        epsilon=group["eps"] * correction,
        beta1=beta1,
        beta2=beta2,
    )


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Copies of the state of an optimizer with one parameter; empty before its first step."""
    (parameter,) = optimizer.param_groups[0]["params"]
    return {name: value.clone() for name, value in optimizer.state[parameter].items()}


def load_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Restore the state that `optimizer_tensors` returned, for an optimizer with one parameter.

    Raises:
        ValueError: If the state belongs to another parameter.
    """
    (parameter,) = optimizer.param_groups[0]["params"]
    check_moments(tensors, parameter)
    state = {name: value.to(parameter.device, copy=True) for name, value in tensors.items()}
    if state:
        optimizer.state[parameter] = state


def check_moments(tensors: Mapping[str, Tensor], parameter: Tensor) -> None:
    """Validate the state of an Adam optimizer.

    Raises:
        ValueError: If the state belongs to another parameter, or cannot result from a step.
    """
    if not tensors:
        return
    if not {"step", "exp_avg", "exp_avg_sq"} <= tensors.keys() or tensors["step"].numel() != 1:
        raise ValueError("the state of an optimizer is incomplete")
    if not 0 <= float(tensors["step"]) < 1e9:
        raise ValueError(f"the state of an optimizer is of step {float(tensors['step']):g}")
    for name in ("exp_avg", "exp_avg_sq"):
        if tensors[name].shape != parameter.shape or tensors[name].dtype != parameter.dtype:
            raise ValueError(
                f"the state of an optimizer is of {list(tensors[name].shape)}, not {list(parameter.shape)}"
            )
        if not bool(torch.isfinite(tensors[name]).all()):
            raise ValueError("the state of an optimizer holds NaN or infinity")


def with_prefix(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors with ``prefix`` before every name."""
    return {f"{prefix}{name}": value for name, value in tensors.items()}


def below_prefix(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names start with ``prefix``, named without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
