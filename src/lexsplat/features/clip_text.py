"""The text tower of a CLIP model without transformers, whose import alone takes seconds.

The bundled encoder answers the first question through it. `lexsplat.features.clip` has whole models; tests compare
the two.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.hub import content_hash
from lexsplat.runtime.files import read_tensors

log = logging.getLogger("lexsplat")


class ClipText:
    """Text embeddings of a folder with a CLIP of transformers' layout (quick GELU, causal attention).

    Args:
        folder: ``config.json``, ``model.safetensors`` and ``tokenizer.json``.
        device: Where it computes.
    """

    def __init__(self, folder: Path, device: torch.device | str = "cpu") -> None:
        from tokenizers import Tokenizer

        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))["text_config"]
        self.content_hash = content_hash(folder, "clip")
        self.device = torch.device(device)
        self._heads, self._layers = config["num_attention_heads"], config["num_hidden_layers"]
        self._epsilon, self._end = config["layer_norm_eps"], config["eos_token_id"]
        tensors, _ = read_tensors(folder / "model.safetensors")
        self._weights = {
            name: value.float().to(self.device) for name, value in tensors.items() if name.startswith("text_")
        }
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._limit = config["max_position_embeddings"]
        self._tokenizer.no_truncation()
        self._tokenizer.no_padding()

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length, one by one; long prompts are truncated."""
        return torch.stack([self._encode(prompt) for prompt in prompts])

    @torch.inference_mode()
    def _encode(self, prompt: str) -> Tensor:
        tokens = self._tokenizer.encode(prompt).ids
        if len(tokens) > self._limit:
            subject, limit = prompt[:30] + "...", self._limit
            log.warning(
                "%r: prompt truncated: %d tokens, the model's limit is %d", subject, len(tokens), limit
            )
            tokens = [*tokens[: limit - 1], self._end]
        ids = torch.tensor(tokens, device=self.device)
        weights = self._weights
        rows = weights["text_model.embeddings.token_embedding.weight"][ids]
        x = (rows + weights["text_model.embeddings.position_embedding.weight"][: len(ids)])[None]
        for number in range(self._layers):
            layer = f"text_model.encoder.layers.{number}"
            x = x + self._attention(self._norm(x, f"{layer}.layer_norm1"), f"{layer}.self_attn")
            hidden = self._linear(self._norm(x, f"{layer}.layer_norm2"), f"{layer}.mlp.fc1")
            x = x + self._linear(hidden * torch.sigmoid(1.702 * hidden), f"{layer}.mlp.fc2")
        x = self._norm(x, "text_model.final_layer_norm")
        end = int((ids == self._end).int().argmax())
        return F.normalize(x[0, end] @ weights["text_projection.weight"].T, dim=-1).cpu()

    def _attention(self, x: Tensor, name: str) -> Tensor:
        q, k, v = (
            self._linear(x, f"{name}.{part}_proj").unflatten(-1, (self._heads, -1)).transpose(1, 2)
            for part in "qkv"
        )
        mixed = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        return self._linear(mixed.transpose(1, 2).flatten(2), f"{name}.out_proj")

    def _linear(self, x: Tensor, name: str) -> Tensor:
        return F.linear(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _norm(self, x: Tensor, name: str) -> Tensor:
        return F.layer_norm(
            x, x.shape[-1:], self._weights[f"{name}.weight"], self._weights[f"{name}.bias"], self._epsilon
        )
