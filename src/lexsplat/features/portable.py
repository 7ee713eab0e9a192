"""The text half of an encoder for other programs: its weights, and its tokenizer as a ``tokenizer.json``."""

from __future__ import annotations

import json
import string
from dataclasses import dataclass
from typing import Any

from torch import Tensor

_SPACE = "\u2581"
"""How SentencePiece writes a space."""


@dataclass(frozen=True, eq=False)
class TextWeights:
    """The text half of a CLIP or a SigLIP.

    Args:
        tensors: Weights by their names in transformers, without the prefix "text_model."; the last layer is always
            "text_projection".
        heads: Attention heads of a layer.
        activation: "quick_gelu", "gelu" or "gelu_pytorch_tanh".
        epsilon: Of the layer norms.
        tokenizer: The content of a ``tokenizer.json``.
        padding: Token that fills every text up to the full length, where all tokens see each other (SigLIP); None for
            a tower whose tokens see those before them only (CLIP).
    """

    tensors: dict[str, Tensor]
    heads: int
    activation: str
    epsilon: float
    tokenizer: dict[str, Any]
    padding: int | None


def tokenizer_content(tokenizer: Any) -> dict[str, Any] | None:
    """A tokenizer of transformers as the content of a ``tokenizer.json``; None if its kind is not known."""
    if backend := getattr(tokenizer, "backend_tokenizer", None):
        return dict(json.loads(backend.to_str()))
    pieces = getattr(tokenizer, "sp_model", None)
    if pieces is None or type(tokenizer).__name__ != "SiglipTokenizer":
        return None
    end, marks = tokenizer.eos_token, "".join(f"\\{mark}" for mark in string.punctuation)
    template = [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": end, "type_id": 0}}]
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [{"id": tokenizer.eos_token_id, "content": end, **flags}],
        "normalizer": {
            "type": "Sequence",
            "normalizers": [
                {"type": "Lowercase"},
                {"type": "Replace", "pattern": {"Regex": f"[{marks}]"}, "content": ""},
                {"type": "NFKC"},
                {"type": "Replace", "pattern": {"Regex": r"\s+"}, "content": " "},
                {"type": "Strip", "strip_left": True, "strip_right": True},
            ],
        },
        "pre_tokenizer": {
            "type": "Metaspace",
            "replacement": _SPACE,
            "prepend_scheme": "always",
            "split": True,
        },
        "post_processor": {
            "type": "TemplateProcessing",
            "single": template,
            "pair": template,
            "special_tokens": {end: {"id": end, "ids": [tokenizer.eos_token_id], "tokens": [end]}},
        },
        "decoder": None,
        "model": {
            "type": "Unigram",
            "unk_id": pieces.unk_id(),
            "vocab": [[pieces.id_to_piece(n), pieces.get_score(n)] for n in range(pieces.get_piece_size())],
            "byte_fallback": False,
        },
    }
