"""Sizes in a model's ``config.json`` that no model has: refused before anything is built of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lexsplat.features.towers import MOST_LAYERS
from lexsplat.features.weights import excerpt, read_config, towers_of
from lexsplat.runtime.errors import ModelError

_SIZES = {
    **dict.fromkeys(
        (
            "hidden_size", "intermediate_size", "projection_dim", "num_attention_heads", "num_channels",
            "image_size", "patch_size", "vocab_size", "max_position_embeddings",
        ),
        1 << 20,
    ),
    "num_hidden_layers": MOST_LAYERS,
}  # fmt: skip
"""Settings that count something, and the most of it; more would fill the memory before weights could tell."""


def check_sizes(folder: Path) -> None:
    """Check the sizes that a model folder declares, of the model and of each of its towers.

    Raises:
        ModelError: If one is not a whole number, is below 1, or is absurdly large; or ``config.json`` is damaged.
    """
    path = folder / "config.json"
    for place, settings in towers_of(read_config(path, "a model configuration")):
        for key, value in settings.items():
            expected = _expected(key, value)
            if expected:
                raise ModelError(
                    f"{path}: {place}{key}",
                    expected=expected,
                    found=excerpt(value),
                    remedy="fetch config.json again, or choose another model",
                )


def _expected(key: str, value: Any) -> str:
    """What a setting should be; "" if it may be as it is, as may all that the model's family gives a default."""
    if value is None or isinstance(value, dict):
        return ""
    if key == "layer_norm_eps":
        usable = type(value) in (int, float) and 0 <= value < 1
        return "" if usable else "a number from 0 to 1"
    if key not in _SIZES:
        return ""
    most = _SIZES[key]
    numbers = value if isinstance(value, list) and value else [value]  # some count rows and columns apart
    usable = all(type(number) is int and 1 <= number <= most for number in numbers)
    return "" if usable else f"a whole number from 1 to {most:,}"
