"""What a scene says: language on the Gaussians, trained as in the paper (section 3.4) or lifted from the
index maps.

`TrainedField` carries s_G in R^8 and an uncertainty on every Gaussian and decodes what is rendered (Eq. 8).
`LiftedField` carries a sparse distribution over codes on every Gaussian and renders it. Both answer the same
questions, `LanguageField`.

Geometry is deaf to language: features are rendered with geometry detached, so training a field moves no
Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lexsplat.language.fields.lifted import LiftedField
from lexsplat.language.fields.protocol import LanguageField
from lexsplat.language.fields.smoothing import (
    SEMANTIC_CHANNELS,
    SmoothingMLP,
    positional_encoding,
    scene_box,
)
from lexsplat.language.fields.trained import INITIAL_UNCERTAINTY, TrainedField

__all__ = [
    "INITIAL_UNCERTAINTY",
    "SEMANTIC_CHANNELS",
    "LanguageField",
    "LiftedField",
    "SmoothingMLP",
    "TrainedField",
    "field_from_tensors",
    "positional_encoding",
    "scene_box",
]


def field_from_tensors(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> TrainedField | LiftedField:
    """The field that was stored, whichever kind it is.

    Raises:
        ValueError: If the tensors are of neither kind, do not fit each other, or hold a number that is not finite.
    """
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"NaN or infinity in {name}")
    try:
        if "semantics" in tensors:
            return TrainedField.from_tensors(tensors, metadata)
        if "codes" in tensors:
            return LiftedField.from_tensors(tensors, metadata)
    except (IndexError, TypeError, RuntimeError) as error:  # a tensor with fewer axes than it must have
        raise ValueError(f"language field does not fit: {error}") from error
    raise ValueError("neither semantics (trained) nor codes (lifted) among the tensors of the language field")
