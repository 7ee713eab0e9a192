"""Small encoders saved in the layout of the Hub."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from lexsplat.features.encoders import load_clip

MEAN, STD = [0.1, 0.2, 0.3], [0.5, 0.6, 0.7]


def seeded(build):
    torch.manual_seed(0)
    model = build()
    with torch.no_grad():  # with the default initialization, all images would have nearly the same embedding
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.15)
    return model.eval()


def save_model(model, folder: Path) -> Path:
    model.save_pretrained(folder)
    preprocessing = {"image_mean": MEAN, "image_std": STD}
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessing))
    return folder


def write_clip(folder: Path) -> Path:
    """A tiny CLIP with random weights and the bundled tokenizer."""
    from transformers import CLIPConfig, CLIPModel

    tokenizer = load_clip("bundled")._tokenizer
    config = CLIPConfig(
        text_config={
            "vocab_size": len(tokenizer), "hidden_size": 24, "intermediate_size": 40, "num_hidden_layers": 2,
            "num_attention_heads": 2, "max_position_embeddings": 11, "bos_token_id": tokenizer.bos_token_id,
            "eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id,
        },
        vision_config={
            "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": 40, "patch_size": 8,
        },
        projection_dim=20,
    )  # fmt: skip
    tokenizer.save_pretrained(folder)
    return save_model(seeded(lambda: CLIPModel(config)), folder)


def tiny_vit(registers: int = 0, **changes: int):
    """A vision transformer with random weights; it has no registers, unlike models of other families."""
    from transformers import ViTConfig, ViTModel

    sizes = {"hidden_size": 24, "intermediate_size": 40, "num_hidden_layers": 3, "num_attention_heads": 2}
    return ViTModel(
        ViTConfig(**{**sizes, "image_size": 32, "patch_size": 8, **changes}), add_pooling_layer=False
    )
