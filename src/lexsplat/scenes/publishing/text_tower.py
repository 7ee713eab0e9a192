"""The text tower of a CLIP or SigLIP for the browser: its weights as safetensors, and its ``tokenizer.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lexsplat.features.portable import TextWeights
from lexsplat.features.text import load_text
from lexsplat.runtime.files import save_tensors
from lexsplat.scenes.scene import Scene

PRECISE_BYTES = 8_000_000
"""Largest matrices that are written with 16 bits a weight: the page loads a tower of this size without asking."""


def write_text_tower(scene: Scene, weights: Path, tokenizer: Path) -> dict[str, Any] | None:
    """Write what the page needs to embed any phrase and compare it with the codes.

    Args:
        scene: The scene, whose text encoder is taken.
        weights: Safetensors to write: the tower, the codewords of unit length ``[K, D]``, and the mean embedding
            ``[D]`` and the best height at each code ``[K]`` of everyday words.
        tokenizer: The ``tokenizer.json`` to write.

    Returns:
        The entry "text" of the manifest; None if the encoder is neither a CLIP nor a SigLIP.
    """
    encoder = load_text(scene.clip)
    tower: TextWeights | None = getattr(encoder, "text_tower", lambda: None)()
    if tower is None:
        return None
    tensors = _quantized(tower.tensors)
    codewords = torch.nn.functional.normalize(scene.field.codebook.clip.detach().cpu().float(), dim=-1)
    tensors |= {"codewords": codewords, "mean": scene.everyday_scale.mean, "best": scene.everyday_scale.best}
    if scene.field.segments is not None:
        classifier = scene.presence_classifier
        tables = {**classifier.tables, "part_fits": classifier.part_fits.T}
        tensors |= {name: table.float() for name, table in tables.items()}
    save_tensors(
        {name: tensor.contiguous().cpu() for name, tensor in tensors.items()},
        weights,
        scene.encoder_identity(),
    )
    tokenizer.write_text(
        json.dumps(tower.tokenizer, ensure_ascii=False, separators=(",", ":")), encoding="utf-8"
    )
    return {
        "weights": weights.name,
        "tokenizer": tokenizer.name,
        **{name: getattr(tower, name) for name in ("heads", "activation", "epsilon", "padding")},
        "templates": list(scene.query.templates),
    }


def _quantized(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Matrices as integers with a factor for each row (``NAME.factor``); vectors in float32.

    Weights have 16 bits where the tower then takes at most `PRECISE_BYTES`, else 8. Text embeddings of the bundled
    encoder turn by a cosine of 6e-8 with 16 bits and of 4e-5 with 8, which moves scores by up to 4/255.
    """
    precise = 2 * sum(tensor.numel() for tensor in tensors.values() if tensor.ndim > 1) <= PRECISE_BYTES
    kind = torch.int16 if precise else torch.int8
    stored: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if tensor.ndim < 2:
            stored[name] = tensor.float()
            continue
        factor = tensor.float().abs().amax(1).clamp_min(1e-12) / torch.iinfo(kind).max
        stored[name] = (tensor.float() / factor[:, None]).round().to(kind)
        stored[f"{name}.factor"] = factor
    return stored
