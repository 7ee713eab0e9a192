"""The optimizers of the reconstruction: one Adam per parameter, and its state as named tensors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lexsplat.runtime.adam import Adam


def adam(parameter: torch.nn.Parameter, rate: float) -> torch.optim.Adam:
    """Adam with the epsilon of 3DGS, fused: one pass over memory, the same bits at any number of threads.

    Every number is updated, including those of Gaussians that the view does not show: their moments decay and still
    move them, so that skipping them would be a different optimizer.

    Args:
        parameter: The parameter to optimize, float32.
        rate: Learning rate.
    """
    return Adam([parameter], lr=rate, eps=1e-15, fused=True)


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


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors with ``prefix`` before every name."""
    return {f"{prefix}{name}": value for name, value in tensors.items()}


def below_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names start with ``prefix``, named without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
