"""The losses of the training of the image-text encoder, on similarities and answers."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from clip_batches import KINDS, PART_NAMES, TINTS
from torch import Tensor
from vocabulary import CANONICAL
from words import FALSE, OPEN, TRUE


def contrastive_loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Cross-entropy of rows with several right answers ``[B, T]``; open answers are left out."""
    right = (truth == TRUE).float()
    rows = right.sum(1) > 0
    log_probabilities = logits.masked_fill(truth == OPEN, -torch.inf).log_softmax(1)
    picked = torch.where(right > 0, log_probabilities, 0.0)
    return -(picked.sum(1)[rows] / right.sum(1)[rows]).mean()


def patch_loss(answers: Tensor, truth: Tensor, left_out: Tensor) -> Tensor:
    """Cross-entropy of kind, color and part of the patches ``[B, P, 3]``; kinds left out are no answer."""
    kinds, *others = answers.split([len(KINDS), len(TINTS), len(PART_NAMES)], dim=-1)
    split = [kinds.masked_fill(left_out, -torch.inf), *others]
    losses = [
        F.cross_entropy(part.flatten(0, 1), truth[..., place].flatten()) for place, part in enumerate(split)
    ]
    return losses[0] + 0.5 * (losses[1] + losses[2])


def composition_loss(corners: Tensor) -> Tensor:
    """Deviation of texts of kinds and colors from parallelograms: |t(k, c) - t(k, d) - t(l, c) + t(l, d)|^2.

    Args:
        corners: Unit vectors ``[4 n, D]``, in the order of ``words.parallelogram``.
    """
    first, second, third, fourth = corners.unflatten(0, (-1, 4)).unbind(1)
    return (first - second - third + fourth).square().sum(-1).mean()


def relevancy_loss(similarity: Tensor, canonical: Tensor, truth: Tensor, temperature: float) -> Tensor:
    """Cross-entropy of LERF's relevancy with the truth; right and wrong phrases weigh the same.

    Args:
        similarity: Of crops and phrases ``[B, T]``.
        canonical: Of crops and canonical phrases ``[B, C]``.
        truth: ``[B, T]``.
        temperature: Of the relevancy.
    """
    sharpness = 40.0  # a maximum that lets gradients reach all canonical phrases
    above = (
        torch.logsumexp(sharpness * canonical, 1, keepdim=True) - math.log(canonical.shape[1])
    ) / sharpness
    logits = temperature * (similarity - above)
    return F.softplus(-logits[truth == TRUE]).mean() + F.softplus(logits[truth == FALSE]).mean()


def asking_losses(
    similarity: Tensor, truth: Tensor, scale: Tensor, temperature: float
) -> tuple[Tensor, Tensor]:
    """Contrast, of images among phrases plus of phrases among images, and relevancy.

    Args:
        similarity: Of crops or patches and texts ``[B, T + C]``, the canonical phrases last.
        truth: Of the phrases before those ``[B, T]``.
        scale: Of the similarities in the contrast; a scalar, which is trained too.
        temperature: Of the relevancy.
    """
    phrases, canonical = similarity[:, : -len(CANONICAL)], similarity[:, -len(CANONICAL) :]
    # Canonical phrases stand among the wrong answers, so a right phrase is drawn above them.
    with_canonical = F.pad(truth, (0, len(CANONICAL)), value=FALSE)
    contrast = contrastive_loss(scale * similarity, with_canonical) + contrastive_loss(
        scale * phrases.T, truth.T
    )
    return contrast, relevancy_loss(phrases, canonical, truth, temperature)


def dense_loss(values: Tensor, texts: Tensor, places: Tensor, scale: Tensor, temperature: float) -> Tensor:
    """Contrast and relevancy of single patches, as for crops.

    Args:
        values: What the patches say ``[B, P, D]`` (`Trainer.see`), of any length.
        texts: Unit vectors of the phrases, the canonical ones last ``[T + C, D]``.
        places: Truth of the phrases ``[B, P, T]``; a patch of which all is ``OPEN`` is not asked.
        scale: As in `asking_losses`.
        temperature: Of the relevancy.
    """
    asked = (places != OPEN).any(-1)
    similarity = F.normalize(values[asked].float(), dim=-1) @ texts.T
    contrast, relevancy = asking_losses(similarity, places[asked], scale, temperature)
    return 0.5 * contrast + relevancy
