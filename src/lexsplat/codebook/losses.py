"""Losses of the codebook: Eq. 5 to 7 and supplement A."""

from __future__ import annotations

import torch
from torch import Tensor

from lexsplat.codebook.settings import CodebookConfig
from lexsplat.codebook.space import similarity


def load_balancing_loss(similarities: Tensor, temperature: float = 1.0) -> Tensor:
    """Eq. 6 and supplement A: sum_N r * p.

    r_i is the share of features whose best code is i (a count, without gradient), p_i the mean softmax probability
    of code i. The minimum is 1 / K, where all codes are used equally.

    Args:
        similarities: D(F_i, S) of a batch ``[M, K]``.
        temperature: Divides the similarities before the softmax; 1 in the paper.
    """
    num_codes = similarities.shape[-1]
    chosen = similarities.argmax(-1)
    used = torch.bincount(chosen, minlength=num_codes).to(similarities.dtype) / len(chosen)
    probability = (similarities / temperature).softmax(-1).mean(0)
    return (used * probability).sum()


def quantization_loss(
    clip: Tensor, dino: Tensor | None, code_clip: Tensor, code_dino: Tensor | None, config: CodebookConfig
) -> Tensor:
    """Eq. 7: lambda_cos L_cos + lambda_lb L_lb for a batch of features.

    The index m is the argmax of Eq. 4 and has no gradient; the gradient reaches the codes through Eq. 3 and the
    softmax. Eq. 5 of the chosen codes is 1 + lambda_DINO minus the similarity by which they were chosen, so no row of
    the codebook is gathered. The gradient of a gather would be a scatter-add, which torch sums in an order that
    depends on its threads.
    """
    scores = similarity(clip, dino, code_clip, code_dino, config.lambda_dino)
    chosen = scores.detach().argmax(-1, keepdim=True)
    ceiling = 1 + (0 if code_dino is None else config.lambda_dino)
    loss = config.lambda_cos * (ceiling - scores.gather(1, chosen)).mean()
    if config.load_balancing:
        loss = loss + config.lambda_lb * load_balancing_loss(scores, config.temperature)
    return loss
