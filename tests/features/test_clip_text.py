"""The light text tower against the model of transformers."""

import pytest
import torch

from lexsplat.features.clip_text import ClipText
from lexsplat.features.encoders import load_clip
from lexsplat.features.hub import model_folder

TEXTS = [
    "apple",
    "a red apple on the checkered cloth",
    "DUCK's  beak\t1",
    "café 🍎 日本語",
    "x " * 60,
    "<|endoftext|>",
]


@pytest.mark.slow
def test_the_light_tower_gives_the_embeddings_of_the_whole_model():
    light, whole = ClipText(model_folder("bundled", "clip")), load_clip("bundled")
    expected = torch.cat([whole.encode_text([text]) for text in TEXTS])
    torch.testing.assert_close(light.encode_text(TEXTS), expected, atol=1e-6, rtol=0)
    assert light.content_hash == whole.content_hash


@pytest.mark.slow
def test_a_question_of_the_bundled_encoder_needs_no_transformers():
    import subprocess
    import sys

    code = (
        "import sys, lexsplat; lexsplat.open_scene('demo', device='cpu').embed('mug'); "
        "print([m for m in ('transformers', 'simplemma') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
