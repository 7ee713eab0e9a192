"""Losses of the language field: Eq. 9 to 11 and 14 of the paper. `FieldTrainer` adds them up (Eq. 12 and 15).

All are means over pixels or Gaussians, so a random sample of them is an unbiased estimate of the full loss.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

UncertaintyForm = Literal["linear", "log"]
SmoothingWeight = Literal["max", "linear"]

LOG_MARGIN = 1e-4
"""U is clamped to 1 minus this: -log(1 - U) is infinite at U = 1, which float32 rendering can reach."""

CPU_BLOCK, GPU_BLOCK = 1 << 12, 1 << 18
"""Rows of a block in `mean_in_blocks`; the activations of a CPU's block stay in its cache."""


def mean_in_blocks(
    loss: Callable[..., Tensor], rows: Sequence[Tensor], parameters: Sequence[Tensor]
) -> Tensor:
    """A mean over rows with its gradients, which holds the activations of one block of rows at a time.

    Value and gradients are those of ``loss(*rows)``, up to the order of sums. Full maps take two thirds of the time
    on a CPU, and memory for one block. Few rows are one block.

    Args:
        loss: The mean of a loss over rows of the tensors.
        rows: Tensors ``[M, ...]``.
        parameters: Tensors that the loss reads in addition to its arguments, for their gradients.
    """
    count = len(rows[0])
    block = CPU_BLOCK if rows[0].device.type == "cpu" else GPU_BLOCK
    if count <= block:
        return loss(*rows)
    return _BlockedMean.apply(loss, block, len(rows), *rows, *parameters)


class _BlockedMean(torch.autograd.Function):
    """`mean_in_blocks`: gradients are computed with the value."""

    @staticmethod
    def forward(ctx: Any, loss: Callable[..., Tensor], block: int, number: int, *tensors: Tensor) -> Tensor:
        rows, parameters = tensors[:number], list(tensors[number:])
        count, total = len(rows[0]), torch.zeros((), device=rows[0].device, dtype=torch.float64)
        by_row: list[Tensor | None] = [torch.empty_like(r) if r.requires_grad else None for r in rows]
        sums = [torch.zeros_like(parameter) for parameter in parameters]
        for start in range(0, count, block):
            part = slice(start, start + block)
            own = [r[part].detach().requires_grad_(r.requires_grad) for r in rows]
            free = [place for place, row in enumerate(own) if row.requires_grad]
            with torch.enable_grad():
                value = loss(*own) * (len(own[0]) / count)
            found = torch.autograd.grad(value, [*(own[place] for place in free), *parameters])
            total += value.detach()
            for place, gradient in zip(free, found):
                by_row[place][part] = gradient  # type: ignore[index]
            for sum_, gradient in zip(sums, found[len(free) :]):
                sum_ += gradient
        ctx.gradients = (*by_row, *sums)
        return total.to(rows[0].dtype if rows[0].is_floating_point() else torch.float32)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor | None, ...]:
        scaled = (None if gradient is None else gradient * outer[0] for gradient in ctx.gradients)
        return (None, None, None, *scaled)


def cross_entropy_loss(logits: Tensor, codes: Tensor, uncertainties: Tensor | None = None) -> Tensor:
    """Eq. 9, or Eq. 10 with uncertainties: mean of CE(M_hat, M) (1 - R_u).

    It includes the softmax of Eq. 8. The gradient of Eq. 10 reaches the uncertainties: if the codes of several views
    disagree, CE stays high and u grows.

    Args:
        logits: Decoder outputs before the softmax ``[M, K]``.
        codes: Code index of each pixel, integers ``[M]`` in 0 to K - 1.
        uncertainties: Rendered uncertainty R_u at each pixel ``[M]`` in 0..1; None gives Eq. 9.

    Raises:
        ValueError: If the shapes disagree.
    """
    if logits.ndim != 2 or codes.shape != logits.shape[:1]:
        raise ValueError(
            f"logits [M, K] and codes [M] expected, got {list(logits.shape)}, {list(codes.shape)}"
        )
    if uncertainties is None:
        return functional.cross_entropy(logits, codes.long())
    if uncertainties.shape != codes.shape:
        raise ValueError(f"uncertainties must be {list(codes.shape)}, got {list(uncertainties.shape)}")
    return (functional.cross_entropy(logits, codes.long(), reduction="none") * (1 - uncertainties)).mean()


def uncertainty_loss(uncertainties: Tensor, form: UncertaintyForm = "linear") -> Tensor:
    """Eq. 11: mean of the rendered uncertainty R_u, which keeps u low.

    Args:
        uncertainties: R_u ``[...]`` in 0..1.
        form: "linear" is the paper's. "log" is that of the authors' code, the mean of -log(1 - R_u). With Eq. 10 it
            has the stationary point U = 1 - 1 / CE; the linear form drives U to 0 or 1.
    """
    if form == "linear":
        return uncertainties.mean()
    if form == "log":
        return -torch.log1p(-uncertainties.clamp(max=1 - LOG_MARGIN)).mean()
    raise ValueError(f'form must be "linear" or "log", got {form!r}')


def smoothing_loss(
    smoothed: Tensor,
    semantics: Tensor,
    uncertainties: Tensor,
    min_weight: float = 0.1,
    *,
    weight: SmoothingWeight = "max",
    squared: bool = False,
) -> Tensor:
    """Eq. 14: mean of ||s_MLP - s_G*|| + max(u_G*, w_s) ||s_MLP* - s_G|| over the Gaussians; * stops the gradient.

    The first term fits the MLP to the Gaussians. The second pulls the Gaussians towards the MLP, uncertain ones more.
    No gradient reaches the uncertainties.

    Args:
        smoothed: Outputs of the MLP, s_MLP ``[N, S]`` (Eq. 13).
        semantics: s_G ``[N, S]``.
        uncertainties: u_G ``[N]`` in 0..1.
        min_weight: w_s, the least weight of the second term.
        weight: "max" is the paper's; "linear" is that of the authors' code, (1 - u) w_s + u.
        squared: Use squared norms, as the authors' code does.
    """
    fixed = uncertainties.detach()
    if weight == "max":
        pull = fixed.clamp(min=min_weight)
    elif weight == "linear":
        pull = (1 - fixed) * min_weight + fixed
    else:
        raise ValueError(f'weight must be "max" or "linear", got {weight!r}')
    teach = torch.linalg.vector_norm(smoothed - semantics.detach(), dim=-1)
    follow = torch.linalg.vector_norm(smoothed.detach() - semantics, dim=-1)
    if squared:
        teach, follow = teach.square(), follow.square()
    return (teach + pull * follow).mean()
