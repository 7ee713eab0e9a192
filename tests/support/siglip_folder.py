"""A tiny SigLIP with random weights and a tokenizer of SentencePiece, in the layout of the published ones."""

from __future__ import annotations

import io
import json
from pathlib import Path

from support.encoder_folders import save_model, seeded

WORDS = "an apple a wooden table blue sky a car red mug the books"


def siglip_folder(folder: Path, width: int = 24):
    """Write the model; returns its SentencePiece processor. Needs sentencepiece."""
    import sentencepiece as spm
    from transformers import SiglipConfig, SiglipModel

    model = io.BytesIO()
    spm.SentencePieceTrainer.train(
        sentence_iterator=iter([WORDS] * 50),
        model_writer=model,
        vocab_size=60,
        pad_id=-1,
        bos_id=-1,
        eos_id=1,
        unk_id=0,
        hard_vocab_limit=False,
        minloglevel=5,
    )
    (folder / "spiece.model").write_bytes(model.getvalue())
    (folder / "tokenizer_config.json").write_text(
        json.dumps({"tokenizer_class": "SiglipTokenizer", "pad_token": "</s>", "eos_token": "</s>"})
    )
    reference = spm.SentencePieceProcessor(model_proto=model.getvalue())
    tower = {"intermediate_size": 40, "num_hidden_layers": 2, "num_attention_heads": 2, "hidden_size": width}
    text = {**tower, "vocab_size": reference.get_piece_size(), "max_position_embeddings": 9}
    config = SiglipConfig(text_config=text, vision_config={**tower, "image_size": 32, "patch_size": 8})
    save_model(seeded(lambda: SiglipModel(config)), folder)
    return reference
