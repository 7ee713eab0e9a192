"""The text tower of a CLIP without transformers, whose import alone takes seconds.

It answers questions for every model of CLIP's original architecture, in the files of transformers or of OpenCLIP.
`lexsplat.features.clip` has whole models; tests compare the two.
"""

from __future__ import annotations

import itertools
import json
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.hub import content_hash
from lexsplat.features.portable import TextWeights
from lexsplat.features.towers import ACTIVATIONS, settings_of
from lexsplat.features.weights import load_weights, read_config

log = logging.getLogger("lexsplat")

_DEFAULTS = {  # of transformers' CLIPTextConfig, which files may leave out
    "vocab_size": 49408, "hidden_size": 512, "intermediate_size": 2048, "num_hidden_layers": 12,
    "num_attention_heads": 8, "max_position_embeddings": 77, "hidden_act": "quick_gelu", "layer_norm_eps": 1e-5,
    "eos_token_id": 49407,
}  # fmt: skip
LEGACY_END = 2
"""An end token of this number stands for the largest number in the prompt, as in OpenAI's code."""
_TOGETHER = 64
"""Prompts in one pass of `ClipText.encode_together`, at most."""
UNLIKE = 1e-5
"""Largest distance of two unit vectors that are equal up to rounding."""
UNLIKE_WORDS = ("an apple", "a wooden table", "blue sky", "a car")
"""Words to which every encoder gives different embeddings."""


def open_clip_text(folder: Path, name: str, device: torch.device | str = "cpu") -> ClipText | None:
    """The text tower of a model folder; None for a model that it does not know or that is not whole.

    Whatever is refused here, the loader of whole models refuses in words, or loads.
    """
    tower = light_tower(folder, lambda: load_weights(folder, name), device)
    if tower is not None:
        tower.content_hash = content_hash(folder, "clip")
    return tower


def light_tower(
    folder: Path, load: Callable[[], Mapping[str, Tensor]], device: torch.device | str
) -> ClipText | None:
    """The text tower of a model folder; None where `open_clip_text` has none.

    Args:
        folder: The folder, for its configuration and tokenizer.
        load: Returns the weights by their names in transformers, from files or from a loaded model.
        device: Device of the tower.

    Returns:
        The tower, without its ``content_hash``, which is left to the caller.
    """
    if not (folder / "tokenizer.json").is_file():
        return None
    config = read_config(folder / "config.json", "a model configuration")
    settings = settings_of(config.get("text_config") or config.get("text_config_dict") or {}, _DEFAULTS)
    if settings is None or config.get("model_type") != "clip":
        return None
    weights = {
        key: value
        for key, value in load().items()
        if key.startswith(("text_model.", "text_projection.")) and not key.endswith("position_ids")
    }
    if _shapes(settings, config.get("projection_dim", 512)) != {
        key: tuple(value.shape) for key, value in weights.items()
    }:
        return None
    tokenizer = _tokenizer(folder / "tokenizer.json", settings["vocab_size"])
    if tokenizer is None:
        return None
    tower = ClipText(settings, weights, tokenizer, device)
    finite = all(bool(value.isfinite().all()) for value in weights.values())
    if not finite or not tower.ends_prompts():
        return None
    words = tower.encode_text(UNLIKE_WORDS)
    return tower if bool(words.isfinite().all()) and F.pdist(words).min() >= UNLIKE else None


def _tokenizer(path: Path, size: int) -> Any:
    """The tokenizer of a file; None if it cannot be read, or its vocabulary is not the model's."""
    from tokenizers import Tokenizer

    try:
        tokenizer = Tokenizer.from_file(str(path))
    except Exception:  # its errors have no type of their own
        return None
    tokenizer.no_truncation()
    tokenizer.no_padding()
    known = is_vocabulary(tokenizer.get_vocab_size(), size)
    ids = tokenizer.encode(UNLIKE_WORDS[0]).ids
    return tokenizer if known and not misnumbered(tokenizer.get_vocab(), ids, size) else None


def is_vocabulary(words: int, size: int) -> bool:
    """Whether a tokenizer of so many words belongs to a model of ``size``, padded to a multiple of at most 128."""
    return size - 128 < words <= size


def misnumbered(vocabulary: Mapping[str, int], ids: Sequence[int], size: int) -> str:
    """The first number of a token for which a model has no row, or which two tokens share; "" if there is none.

    Args:
        vocabulary: The number of each token.
        ids: Numbers in a prompt, some of which a tokenizer adds by other rules.
        size: Rows of the model's token embedding.
    """
    owners: dict[int, str] = {}
    for token, number in vocabulary.items():
        if not 0 <= number < size:
            return f"token {token[:30]!r} with the number {number}"
        if owners.setdefault(number, token) != token:
            return f"the number {number} for both {owners[number][:30]!r} and {token[:30]!r}"
    outside = [number for number in ids if not 0 <= number < size]
    return f"the number {outside[0]} in a prompt" if outside else ""


def warn_truncated(prompt: str, tokens: int, limit: int) -> None:
    """Warn of a prompt with more tokens than the model reads."""
    subject = prompt[:30] + "..."
    log.warning("%r: prompt truncated: %d tokens, the model's limit is %d", subject, tokens, limit)


def _shapes(settings: Mapping[str, Any], projection: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all tensors of the text tower."""
    width, hidden = settings["hidden_size"], settings["intermediate_size"]
    found: dict[str, tuple[int, ...]] = {
        "text_model.embeddings.token_embedding.weight": (settings["vocab_size"], width),
        "text_model.embeddings.position_embedding.weight": (settings["max_position_embeddings"], width),
        "text_projection.weight": (projection, width),
    }
    norms = ["text_model.final_layer_norm"]
    for number in range(settings["num_hidden_layers"]):
        layer = f"text_model.encoder.layers.{number}"
        norms += [f"{layer}.layer_norm1", f"{layer}.layer_norm2"]
        linear = {f"self_attn.{part}_proj": (width, width) for part in ("q", "k", "v", "out")}
        linear |= {"mlp.fc1": (hidden, width), "mlp.fc2": (width, hidden)}
        for part, shape in linear.items():
            found |= {f"{layer}.{part}.weight": shape, f"{layer}.{part}.bias": shape[:1]}
    return found | {f"{norm}.{part}": (width,) for norm in norms for part in ("weight", "bias")}


class ClipText:
    """Text embeddings by a CLIP's text tower: causal attention, pre-norm, the embedding of the end token.

    Args:
        settings: The text part of its ``config.json``.
        weights: Its tensors by their names in transformers.
        tokenizer: Its tokenizer, without truncation and padding.
        device: Device of the tower.
    """

    content_hash: str

    def __init__(
        self,
        settings: Mapping[str, Any],
        weights: Mapping[str, Tensor],
        tokenizer: Any,
        device: torch.device | str = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self._heads, self._layers = settings["num_attention_heads"], settings["num_hidden_layers"]
        self._epsilon, self._end = settings["layer_norm_eps"], settings["eos_token_id"]
        self._limit = settings["max_position_embeddings"]
        self._activation_name = settings["hidden_act"]
        self._activation = ACTIVATIONS[self._activation_name]
        # Copies, because tensors in a file are not aligned, and alignment affects the rounding of sums.
        self._weights = {
            re.sub(r"^text_model\.", "", name): value.to(self.device, torch.float32, copy=True)
            for name, value in weights.items()
        }
        self._tokenizer = tokenizer

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length, one by one; long prompts are truncated."""
        return torch.stack([self._encode(prompt) for prompt in prompts])

    @torch.inference_mode()
    def _encode(self, prompt: str) -> Tensor:
        ids = self._tokens(prompt)
        return self._projected(self._hidden(ids[None])[0, self._place_of_end(ids)])

    @torch.inference_mode()
    def encode_together(self, prompts: Sequence[str]) -> Tensor:
        """`encode_text` of thousands of prompts, several times as fast and equal up to rounding.

        Prompts with the same number of tokens share a pass, so that none is padded.
        """
        tokens = [self._tokens(prompt) for prompt in prompts]
        order = sorted(range(len(tokens)), key=lambda number: len(tokens[number]))
        found: list[Tensor] = [torch.empty(0)] * len(tokens)
        for _, alike in itertools.groupby(order, key=lambda number: len(tokens[number])):
            numbers = list(alike)
            for start in range(0, len(numbers), _TOGETHER):
                batch = numbers[start : start + _TOGETHER]
                hidden = self._hidden(torch.stack([tokens[number] for number in batch]))
                ends = [self._place_of_end(tokens[number]) for number in batch]
                for number, row in zip(batch, self._projected(hidden[torch.arange(len(batch)), ends])):
                    found[number] = row
        return torch.stack(found)

    def text_tower(self) -> TextWeights:
        """The tower for other programs."""
        return TextWeights(
            {name: tensor.cpu() for name, tensor in self._weights.items()},
            self._heads,
            self._activation_name,
            self._epsilon,
            json.loads(self._tokenizer.to_str()),
            None,
        )

    def _hidden(self, ids: Tensor) -> Tensor:
        """The last layer's output ``[B, T, W]`` at tokens ``[B, T]``."""
        weights = self._weights
        x = weights["embeddings.token_embedding.weight"][ids]
        x = x + weights["embeddings.position_embedding.weight"][: ids.shape[1]]
        for number in range(self._layers):
            layer = f"encoder.layers.{number}"
            x = x + self._attention(self._norm(x, f"{layer}.layer_norm1"), f"{layer}.self_attn")
            hidden = self._linear(self._norm(x, f"{layer}.layer_norm2"), f"{layer}.mlp.fc1")
            x = x + self._linear(self._activation(hidden), f"{layer}.mlp.fc2")
        return self._norm(x, "final_layer_norm")

    def _projected(self, hidden: Tensor) -> Tensor:
        return F.normalize(hidden @ self._weights["text_projection.weight"].T, dim=-1).cpu()

    def ends_prompts(self) -> bool:
        """Whether the tokenizer ends a prompt with the token whose embedding is that of the prompt."""
        ids = self._tokens(UNLIKE_WORDS[0])
        return len(ids) > 2 and self._place_of_end(ids) == len(ids) - 1

    def _place_of_end(self, ids: Tensor) -> int:
        """Place of the end token among the tokens ``[T]`` of a prompt."""
        return int((ids if self._end == LEGACY_END else (ids == self._end).int()).argmax())

    def on(self, device: torch.device | str) -> ClipText:
        """The same tower on a device."""
        tower = copy(self)
        tower.device = torch.device(device)
        tower._weights = {name: value.to(tower.device) for name, value in self._weights.items()}
        return tower

    def tokens_over(self, prompt: str) -> int:
        """Number of tokens by which a prompt exceeds the positions of the model and is truncated."""
        return max(len(self._tokenizer.encode(prompt).ids) - self._limit, 0)

    def _tokens(self, prompt: str) -> Tensor:
        """Numbers of the tokens ``[T]``, with start and end, at most as many as the model has positions."""
        tokens = self._tokenizer.encode(prompt).ids
        if len(tokens) > self._limit:
            warn_truncated(prompt, len(tokens), self._limit)
            tokens = [*tokens[: self._limit - 1], tokens[-1]]
        return torch.tensor(tokens, device=self.device)

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
