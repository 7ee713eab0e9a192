"""The two forms of language on the Gaussians (section 3.4), behind the protocol `LanguageField`.

`CodeField` carries a sparse distribution over codes on every Gaussian and renders it.
`TrainedField` carries s_G in R^8 and an uncertainty on every Gaussian, and decodes what is rendered (Eq. 8).

Features are rendered with geometry detached, so no field ever moves a Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lexsplat.language.fields.codes import CodeField
from lexsplat.language.fields.protocol import LanguageField
from lexsplat.language.fields.smoothing import SEMANTIC_CHANNELS, SmoothingMLP, positional_encoding, scene_box
from lexsplat.language.fields.trained import INITIAL_UNCERTAINTY, TrainedField

__all__ = [
    "INITIAL_UNCERTAINTY",
    "SEMANTIC_CHANNELS",
    "CodeField",
    "LanguageField",
    "SmoothingMLP",
    "TrainedField",
    "field_from_tensors",
    "positional_encoding",
    "scene_box",
]


def field_from_tensors(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> TrainedField | CodeField:
    """A stored field; the names of its tensors determine its form.

    Raises:
        ValueError: If the tensors are of neither form, do not fit each other, or hold NaN or infinity.
    """
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"NaN or infinity in {name}")
    try:
        if "semantics" in tensors:
            return TrainedField.from_tensors(tensors, metadata)
        if "codes" in tensors:
            return CodeField.from_tensors(tensors, metadata)
    except (IndexError, TypeError, RuntimeError) as error:  # a tensor with too few axes
        raise ValueError(f"language field does not fit: {error}") from error
    raise ValueError("neither semantics (TrainedField) nor codes (CodeField) among the tensors")
