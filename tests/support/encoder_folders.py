"""Small encoders saved in the layout of the Hub."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import torch

from lexsplat.features.hub import model_folder

MEAN, STD = [0.1, 0.2, 0.3], [0.5, 0.6, 0.7]


def normalized(images: torch.Tensor) -> torch.Tensor:
    """Pixels as the encoders of this module expect them."""
    pixels = (images.double().numpy() - np.reshape(MEAN, (3, 1, 1))) / np.reshape(STD, (3, 1, 1))
    return torch.from_numpy(pixels).float()


def unit(features: torch.Tensor) -> torch.Tensor:
    return features / features.norm(dim=-1, keepdim=True)


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


def write_clip(folder: Path, width: int = 20) -> Path:
    """A tiny CLIP with random weights, embeddings of a width and the bundled tokenizer."""
    from transformers import AutoTokenizer, CLIPConfig, CLIPModel

    tokenizer = AutoTokenizer.from_pretrained(model_folder("bundled", "clip"))
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
        projection_dim=width,
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


def in_open_clip_names(model) -> dict[str, torch.Tensor]:
    """The weights of a CLIP of transformers as OpenCLIP stores them, tensor by tensor."""
    text, vision, state = model.text_model, model.vision_model, {}

    def put(name: str, module) -> None:
        state.update({f"{name}.{key}": value for key, value in module.state_dict().items()})

    def put_layers(prefix: str, layers) -> None:
        for number, layer in enumerate(layers):
            place, attention = f"{prefix}transformer.resblocks.{number}", layer.self_attn
            projections = attention.q_proj, attention.k_proj, attention.v_proj
            state[f"{place}.attn.in_proj_weight"] = torch.cat([p.weight for p in projections])
            state[f"{place}.attn.in_proj_bias"] = torch.cat([p.bias for p in projections])
            put(f"{place}.attn.out_proj", attention.out_proj)
            put(f"{place}.ln_1", layer.layer_norm1)
            put(f"{place}.ln_2", layer.layer_norm2)
            put(f"{place}.mlp.c_fc", layer.mlp.fc1)
            put(f"{place}.mlp.c_proj", layer.mlp.fc2)

    state["logit_scale"] = model.logit_scale
    state["positional_embedding"] = text.embeddings.position_embedding.weight
    state["text_projection"] = model.text_projection.weight.T
    put("token_embedding", text.embeddings.token_embedding)
    put("ln_final", text.final_layer_norm)
    put_layers("", text.encoder.layers)
    state["visual.class_embedding"] = vision.embeddings.class_embedding
    state["visual.positional_embedding"] = vision.embeddings.position_embedding.weight
    state["visual.proj"] = model.visual_projection.weight.T
    put("visual.conv1", vision.embeddings.patch_embedding)
    put("visual.ln_pre", vision.pre_layrnorm)
    put("visual.ln_post", vision.post_layernorm)
    put_layers("visual.", vision.encoder.layers)
    return {name: value.detach().clone().contiguous() for name, value in state.items()}


def in_timm_names(model) -> dict[str, torch.Tensor]:
    """The weights of a ViT of transformers as timm and the original DINO store them."""
    hub = revert_names(model)
    state = {
        "cls_token": hub["embeddings.cls_token"],
        "pos_embed": hub["embeddings.position_embeddings"],
    }
    for part in ("weight", "bias"):
        state[f"patch_embed.proj.{part}"] = hub[f"embeddings.patch_embeddings.projection.{part}"]
        state[f"norm.{part}"] = hub[f"layernorm.{part}"]
        for number in range(model.config.num_hidden_layers):
            old, new = f"encoder.layer.{number}", f"blocks.{number}"
            names = [f"{old}.attention.attention.{name}.{part}" for name in ("query", "key", "value")]
            state[f"{new}.attn.qkv.{part}"] = torch.cat([hub[name] for name in names])
            state[f"{new}.attn.proj.{part}"] = hub[f"{old}.attention.output.dense.{part}"]
            state[f"{new}.norm1.{part}"] = hub[f"{old}.layernorm_before.{part}"]
            state[f"{new}.norm2.{part}"] = hub[f"{old}.layernorm_after.{part}"]
            state[f"{new}.mlp.fc1.{part}"] = hub[f"{old}.intermediate.dense.{part}"]
            state[f"{new}.mlp.fc2.{part}"] = hub[f"{old}.output.dense.{part}"]
    return {name: value.clone().contiguous() for name, value in state.items()}


def revert_names(model) -> dict[str, torch.Tensor]:
    """The tensors of a model as ``save_pretrained`` writes them: in the names of the Hub's files."""
    from safetensors.torch import load_file

    with tempfile.TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        return load_file(Path(folder) / "model.safetensors")
