"""Encoders: real architectures with tiny random weights, against direct calls of transformers."""

from __future__ import annotations

import gc
import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.encoder_folders import normalized, save_model, seeded, unit

from lexsplat.features import hub, pretrained
from lexsplat.features.clip import check_patches
from lexsplat.features.clip_image import ClipImages
from lexsplat.features.encoders import ClipEncoder, load_clip, load_dino
from lexsplat.features.pretrained import resize_images
from lexsplat.runtime.errors import ModelError

PROMPTS = ["a red apple", "the wooden table", "stack of books next to a lamp"]


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


@pytest.fixture(autouse=True)
def full_precision(request, monkeypatch) -> None:
    """Bfloat16 is tested separately; everything else is compared at full precision."""
    if "bfloat16" not in request.node.name:
        monkeypatch.setattr("lexsplat.features.pretrained.bfloat16_is_faster", lambda: False)


def test_crops_in_bfloat16_agree_with_float32_and_texts_do_not_change(monkeypatch):
    clip = load_clip("bundled")
    crops = torch.rand(12, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    found = []
    for on in (False, True):
        monkeypatch.setattr("lexsplat.features.pretrained.bfloat16_is_faster", lambda on=on: on)
        found.append((clip.encode_images(crops), clip.encode_text(PROMPTS)))
    cosines = (found[0][0] * found[1][0]).sum(-1)
    assert cosines.min() > 0.999
    assert not torch.equal(found[0][0], found[1][0]), "bfloat16 was used"
    assert torch.equal(found[0][1], found[1][1])


@pytest.mark.parametrize(
    ("flag", "half", "chosen"), [(True, 0.3, True), (True, 0.9, False), (False, 0.3, False)]
)
def test_bfloat16_is_chosen_by_its_time_where_the_processor_has_instructions(flag, half, chosen, monkeypatch):
    clock = iter(np.cumsum([0.0, 1.0, 0.0, half] * 3))
    monkeypatch.setattr(pretrained, "_has_bfloat16", lambda: flag)
    monkeypatch.setattr(pretrained.time, "thread_time", lambda: next(clock))
    assert pretrained.bfloat16_is_faster.__wrapped__() is chosen


def _images(count: int, size: int) -> torch.Tensor:
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def siglip_folder(tmp_path_factory) -> Path:
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, SiglipConfig, SiglipModel

    folder = tmp_path_factory.mktemp("siglip")
    words = ["<pad>", "<unk>", "a", "red", "apple", "the", "wooden", "table", "stack", "of", "books"]
    words += ["an", "blue", "sky", "car"]  # with the words of `UNLIKE_WORDS`
    backend = Tokenizer(models.WordLevel({word: i for i, word in enumerate(words)}, unk_token="<unk>"))
    backend.pre_tokenizer = pre_tokenizers.Whitespace()
    PreTrainedTokenizerFast(tokenizer_object=backend, pad_token="<pad>", unk_token="<unk>").save_pretrained(
        folder
    )
    tower = {"intermediate_size": 40, "num_hidden_layers": 2, "num_attention_heads": 2, "hidden_size": 24}
    config = SiglipConfig(
        text_config={**tower, "vocab_size": len(words), "max_position_embeddings": 9},
        vision_config={**tower, "image_size": 32, "patch_size": 8},
    )
    return save_model(seeded(lambda: SiglipModel(config)), folder)


def test_clip_image_embeddings_equal_transformers_own(clip_folder):
    from transformers import CLIPModel

    encoder = ClipEncoder(clip_folder, "tiny")
    images = _images(5, 40)
    with torch.no_grad():
        model = CLIPModel.from_pretrained(clip_folder)
        pooled = model.vision_model(pixel_values=normalized(images)).pooler_output
        expected = unit(model.visual_projection(pooled))
    assert (encoder.image_size, encoder.dim) == (40, 20)
    torch.testing.assert_close(encoder.encode_images(images), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("activation", "size"), [("quick_gelu", 24), ("gelu", 24), ("relu", 24), ("gelu", 72)]
)
def test_the_image_tower_equals_transformers_own(activation, size):
    from transformers import CLIPConfig, CLIPModel, CLIPTextConfig, CLIPVisionConfig

    vision = {"hidden_size": 24, "intermediate_size": 40, "num_attention_heads": 3, "num_hidden_layers": 3}
    vision |= {"image_size": size, "patch_size": 8, "hidden_act": activation}
    text = CLIPTextConfig(vocab_size=9, hidden_size=8, num_attention_heads=1, num_hidden_layers=1)  # not used
    config = CLIPConfig(
        text_config=text.to_dict(), vision_config=CLIPVisionConfig(**vision).to_dict(), projection_dim=16
    )
    model = seeded(lambda: CLIPModel(config))
    pixels = torch.randn(3, 3, size, size)
    with torch.no_grad():
        expected = model.visual_projection(model.vision_model(pixel_values=pixels).pooler_output)
        found, whole = (ClipImages(model)(pixels, patches=patches) for patches in (True, False))
    assert (found.shape, whole.shape) == ((3, 1 + (size // 8) ** 2, 16), (3, 1, 16))
    torch.testing.assert_close(found[:, 0], expected, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(whole[:, 0], expected, atol=1e-4, rtol=1e-5)


def test_patches_are_the_values_of_the_last_attention_layer(clip_folder):
    """Reference: the tower layer by layer, then LayerNorm, two matrices, LayerNorm and the projection by hand."""
    from transformers import CLIPModel

    images = _images(3, 40)
    model = CLIPModel.from_pretrained(clip_folder, attn_implementation="eager").eval()
    tower = model.vision_model
    with torch.no_grad():
        hidden = tower(pixel_values=normalized(images), output_hidden_states=True).hidden_states[-2]
        last = tower.encoder.layers[-1]

        def norm(x, module):
            middle = x - x.mean(-1, keepdim=True)
            return (
                middle / (middle.square().mean(-1, keepdim=True) + module.eps).sqrt() * module.weight
                + module.bias
            )

        value, out = last.self_attn.v_proj, last.self_attn.out_proj
        tokens = norm(hidden, last.layer_norm1) @ value.weight.T + value.bias
        tokens = tokens @ out.weight.T + out.bias
        tokens = norm(tokens, tower.post_layernorm) @ model.visual_projection.weight.T
    encoder = ClipEncoder(clip_folder, "tiny")
    whole, patches = encoder.encode_patches(images)
    torch.testing.assert_close(whole, encoder.encode_images(images))
    assert encoder.patches == 5
    torch.testing.assert_close(patches, unit(tokens[:, 1:]).reshape(3, 5, 5, 20), atol=1e-5, rtol=0)


def test_the_encoder_frees_its_activations_after_each_call(clip_folder):
    encoder = ClipEncoder(clip_folder, "tiny")
    encoder.encode_images(_images(2, 40))
    encoder.encode_patches(_images(2, 40))
    encoder.encode_images(_images(2, 40))
    held = [
        o for o in gc.get_objects() if issubclass(type(o), torch.Tensor) and o.shape[:2] == (2, 26)
    ]  # 25 patches, class
    assert held == []


def test_each_thread_gets_its_own_patches(clip_folder):
    encoder = ClipEncoder(clip_folder, "tiny")
    images = _images(12, 40).split(2)
    expected = [encoder.encode_patches(pair)[1] for pair in images]
    barrier = threading.Barrier(3)

    def work(index: int) -> list[torch.Tensor]:
        barrier.wait()
        return [encoder.encode_patches(images[i])[1] for i in range(index, 6, 3)]

    with ThreadPoolExecutor(3) as pool:
        for index, found in enumerate(pool.map(work, range(3))):
            for tensor, reference in zip(found, expected[index::3]):
                torch.testing.assert_close(tensor, reference, atol=1e-5, rtol=0)


def test_patches_of_another_architecture_are_refused_in_one_line(siglip_folder, clip_folder):
    encoder = ClipEncoder(siglip_folder, "tiny siglip")
    assert encoder.patches == 0
    with pytest.raises(ModelError, match=r"--features\.crop-tokens class"):
        encoder.encode_patches(_images(1, 32))
    with pytest.raises(ModelError, match=r"found siglip.*--features\.crop-tokens class"):
        check_patches(siglip_folder, "tiny siglip")
    check_patches(clip_folder, "tiny")


def test_clip_text_embeddings_equal_transformers_own_and_long_prompts_are_truncated(clip_folder):
    from transformers import AutoTokenizer, CLIPModel

    encoder = ClipEncoder(clip_folder, "tiny")
    model, tokenizer = CLIPModel.from_pretrained(clip_folder), AutoTokenizer.from_pretrained(clip_folder)
    long = " ".join(["red apple"] * 20)
    found = encoder.encode_text([*PROMPTS, long])
    for prompt, row in zip([*PROMPTS, long], found):  # one by one: padding must not matter
        ids = tokenizer(prompt)["input_ids"]
        ids = ids if len(ids) <= 11 else [*ids[:10], tokenizer.eos_token_id]
        with torch.no_grad():
            expected = model.text_projection(model.text_model(input_ids=torch.tensor([ids])).pooler_output)
        torch.testing.assert_close(row, unit(expected)[0], atol=1e-5, rtol=0)


def test_siglip_embeddings_equal_transformers_own(siglip_folder):
    from transformers import SiglipModel

    encoder = ClipEncoder(siglip_folder, "tiny siglip")
    model = SiglipModel.from_pretrained(siglip_folder)
    images = _images(3, 32)
    # Padded to the full length of 9 with <pad> = 0, no mask, lower case.
    ids = torch.tensor([[2, 3, 4, 0, 0, 0, 0, 0, 0], [5, 6, 7, 0, 0, 0, 0, 0, 0]])
    with torch.no_grad():
        by_image = model.vision_model(pixel_values=normalized(images)).pooler_output
        by_text = model.text_model(input_ids=ids).pooler_output
    assert (encoder.image_size, encoder.dim) == (32, 24)
    torch.testing.assert_close(encoder.encode_images(images), unit(by_image), atol=1e-5, rtol=0)
    found = encoder.encode_text(["A red apple", "the wooden table"])
    torch.testing.assert_close(found, unit(by_text), atol=1e-5, rtol=0)


def test_siglip2_of_variable_size_gets_the_patches_of_its_own_processor(tmp_path):
    from tokenizers import Tokenizer, models

    transformers = pytest.importorskip("transformers")
    if not hasattr(transformers, "Siglip2Model"):
        pytest.skip("this transformers has no SigLIP 2")
    words = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", *"abcdefghijklmnopqrstuvwxyz\u2581"]
    letters = Tokenizer(models.BPE({word: i for i, word in enumerate(words)}, [], unk_token="<unk>"))
    transformers.PreTrainedTokenizerFast(tokenizer_object=letters).save_pretrained(tmp_path)
    tower = {"intermediate_size": 40, "num_hidden_layers": 1, "num_attention_heads": 2, "hidden_size": 24}
    config = transformers.Siglip2Config(
        text_config={**tower, "vocab_size": len(words), "max_position_embeddings": 12},
        vision_config={**tower, "num_patches": 16, "patch_size": 8},
    )
    model = seeded(lambda: transformers.Siglip2Model(config))
    save_model(model, tmp_path)
    encoder = ClipEncoder(tmp_path, "tiny siglip2")
    assert encoder.image_size == 32
    images = _images(2, 32)
    pixels = normalized(images)
    patches = torch.stack([
        torch.stack([
            image[:, 8 * row : 8 * row + 8, 8 * col : 8 * col + 8].permute(1, 2, 0).reshape(-1)
            for row in range(4) for col in range(4)
        ])
        for image in pixels
    ])  # fmt: skip
    with torch.no_grad():
        expected = model.vision_model(patches, torch.ones(2, 16), torch.tensor([[4, 4]] * 2)).pooler_output
    torch.testing.assert_close(encoder.encode_images(images), unit(expected), atol=1e-5, rtol=0)
    ids = torch.tensor([[words.index(letter) for letter in "a\u2581car"] + [0] * 7])  # padded behind the text
    with torch.no_grad():
        expected = model.text_model(input_ids=ids).pooler_output
    torch.testing.assert_close(encoder.encode_text(["A car"]), unit(expected), atol=1e-5, rtol=0)


def test_an_empty_prompt_is_refused():
    encoder = load_clip("bundled")
    for prompts in ([], [""], ["apple", "  "]):
        with pytest.raises(ValueError, match="not empty"):
            encoder.encode_text(prompts)


@pytest.mark.parametrize(
    ("source", "target"), [((37, 53), (64, 64)), ((90, 120), (32, 48)), ((16, 16), (16, 16))]
)
def test_resizing_equals_pillow_bicubic(source, target):
    image = torch.rand(3, *source, generator=torch.Generator().manual_seed(2))
    found = resize_images(image[None], *target)[0]
    for plane, resized in zip(image, found):
        expected = Image.fromarray(plane.numpy()).resize((target[1], target[0]), Image.Resampling.BICUBIC)
        np.testing.assert_allclose(resized.numpy(), np.clip(np.asarray(expected), 0, 1), atol=2e-5)


def test_the_content_hash_follows_the_weights_and_the_configuration(clip_folder, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(clip_folder, copy)
    assert hub.content_hash(copy, "clip") == hub.content_hash(clip_folder, "clip")
    (copy / "README.md").write_text("prose does not matter")
    assert hub.content_hash(copy, "clip") == hub.content_hash(clip_folder, "clip")
    weights = bytearray((copy / "model.safetensors").read_bytes())
    weights[-1] ^= 1
    (copy / "model.safetensors").write_bytes(weights)
    assert hub.content_hash(copy, "clip") != hub.content_hash(clip_folder, "clip")


def test_normalization_falls_back_to_the_family_with_a_warning(siglip_folder, tmp_path, caplog):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(siglip_folder, copy)
    (copy / "preprocessor_config.json").unlink()
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        encoder = ClipEncoder(copy, "bare")
    assert "no image mean" in caplog.text
    assert encoder._mean.flatten().tolist() == [0.5, 0.5, 0.5]


# -- the bundled encoders


def test_the_bundled_encoders_read_sizes_from_their_configuration():
    clip, dino = load_clip("bundled"), load_dino("bundled")
    assert (clip.image_size, clip.dim) == (48, 128)
    assert (dino.patch_size, dino.dim) == (8, 128)
    assert clip.encode_images(torch.rand(2, 3, 30, 50)).shape == (2, 128)
    assert dino.encode_dense(torch.rand(3, 60, 80), short_side=48, stride=4).shape == (12, 16, 128)


def test_the_bundled_clip_distinguishes_colors():
    """Its captions name colors: uniform images of a color are most similar to that color's prompt."""
    encoder = load_clip("bundled")
    colors = {
        "red": (0.8, 0.1, 0.1),
        "green": (0.1, 0.6, 0.15),
        "blue": (0.1, 0.2, 0.8),
        "yellow": (0.9, 0.8, 0.1),
    }
    images = torch.stack([torch.tensor(rgb).reshape(3, 1, 1).expand(3, 64, 64) for rgb in colors.values()])
    similarity = (
        encoder.encode_images(images) @ encoder.encode_text([f"something {name}" for name in colors]).T
    )
    assert similarity.argmax(1).tolist() == [0, 1, 2, 3]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_embeddings_on_cuda_agree_with_the_cpu():
    images = torch.rand(4, 3, 64, 64, generator=torch.Generator().manual_seed(6))
    on_cpu, on_gpu = load_clip("bundled", "cpu"), load_clip("bundled", "cuda")
    assert (on_cpu.encode_images(images) * on_gpu.encode_images(images)).sum(-1).min() > 0.999
    assert (on_cpu.encode_text(PROMPTS) * on_gpu.encode_text(PROMPTS)).sum(-1).min() > 0.9999
    dense = [
        load_dino("bundled", device).encode_dense(images[0], short_side=64) for device in ("cpu", "cuda")
    ]
    assert (dense[0] * dense[1]).sum(-1).min() > 0.999
