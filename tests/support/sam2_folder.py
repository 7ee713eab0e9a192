"""A small SAM 2 with random weights, saved in the layout of the Hub."""

from __future__ import annotations

from pathlib import Path

from support.encoder_folders import save_model, seeded

SIDE = 64


def write_sam2(folder: Path, *, video: bool = False) -> Path:
    """The class for photos, or the one for videos, in which SAM 2 is published; both have the same photo weights."""
    from transformers import Sam2Config, Sam2Model, Sam2VideoConfig, Sam2VideoModel

    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE],
        "window_positional_embedding_background_size": [4, 4], "blocks_per_stage": [1, 1, 1, 1],
        "embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 1, 2, 2],
        "window_size_per_stage": [4, 4, 4, 4], "global_attention_blocks": [],
    }  # fmt: skip
    parts = {
        "vision_config": {
            "model_type": "sam2_vision_model", "backbone_config": backbone, "fpn_hidden_size": 32,
            "backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        },
        "prompt_encoder_config": {"hidden_size": 32, "image_size": SIDE, "mask_input_channels": 4},
        "mask_decoder_config": {
            "hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16,
        },
    }  # fmt: skip
    model = seeded(lambda: Sam2Model(Sam2Config(**parts)))
    if video:
        sizes = {"image_size": SIDE, "num_maskmem": 2, "memory_encoder_hidden_size": 32}
        wrapped = Sam2VideoModel(Sam2VideoConfig(**parts, **sizes))
        wrapped.load_state_dict(model.state_dict(), strict=False)
        model = wrapped
    return save_model(model, folder)
