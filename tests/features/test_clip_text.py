"""The light text tower against the model of transformers."""

import gc
import json
import shutil
import weakref

import pytest
import torch
from safetensors.torch import load_file, save_file
from support.encoder_folders import in_open_clip_names, save_model, seeded, unit

from lexsplat.features.clip_text import ClipText, open_clip_text
from lexsplat.features.encoders import load_clip
from lexsplat.features.hub import model_folder
from lexsplat.features.text import load_text
from lexsplat.runtime.errors import ModelError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

TEXTS = [
    "apple",
    "a red apple on the checkered cloth",
    "DUCK's  beak\t1",
    "café 🍎 日本語",
    "x " * 60,
    "<|endoftext|>",
]


def assert_same_embeddings(folder, model=None) -> None:
    """Assert that both encoders of a folder give the embeddings of transformers' model of it."""
    from transformers import AutoTokenizer, CLIPModel

    light, whole = load_text(str(folder)), load_clip(str(folder))
    assert isinstance(light, ClipText)
    model = model or CLIPModel.from_pretrained(folder)
    tokenizer, limit = AutoTokenizer.from_pretrained(folder), model.config.text_config.max_position_embeddings
    rows = []
    for text in TEXTS:
        tokens = tokenizer(text, truncation=True, max_length=limit, return_tensors="pt")
        with torch.no_grad():
            rows.append(model.text_projection(model.text_model(**tokens).pooler_output))
    found = light.encode_text(TEXTS)
    torch.testing.assert_close(found, unit(torch.cat(rows)), atol=1e-6, rtol=0)
    assert torch.equal(whole.encode_text(TEXTS), found)
    assert light.content_hash == whole.content_hash


def test_prompts_encoded_together_have_the_embeddings_of_each():
    tower = load_text("bundled")
    texts = [
        *TEXTS,
        *(f"{color} {thing}" for color in ("red", "pale yellow") for thing in ("cup", "box")),
        *TEXTS,
    ]
    torch.testing.assert_close(tower.encode_together(texts), tower.encode_text(texts), atol=1e-6, rtol=0)


def test_the_light_tower_is_exported_as_the_whole_model_is():
    light, whole = (load("bundled").text_tower() for load in (load_text, load_clip))
    assert light.tensors.keys() == whole.tensors.keys()
    assert all(torch.equal(light.tensors[name], tensor) for name, tensor in whole.tensors.items())
    for name in ("heads", "activation", "epsilon", "padding"):
        assert getattr(light, name) == getattr(whole, name)
    cut = {"truncation": None, "padding": None}  # the page cuts and pads by itself
    assert light.tokenizer == {**whole.tokenizer, **cut}


def changed_config(folder, target, **text):
    copy = shutil.copytree(folder, target)
    config = json.loads((copy / "config.json").read_text())
    config["text_config"].update(text)
    (copy / "config.json").write_text(json.dumps(config))
    return copy


def test_the_light_tower_gives_the_embeddings_of_the_bundled_model():
    assert_same_embeddings(model_folder("bundled", "clip"))


@pytest.mark.parametrize("text", [{}, {"hidden_act": "gelu"}, {"eos_token_id": 2}])
def test_the_light_tower_gives_the_embeddings_of_transformers_in_all_variants(clip_folder, tmp_path, text):
    # 2 is the end token of OpenAI's and LAION's files; the model then takes the largest number.
    assert_same_embeddings(changed_config(clip_folder, tmp_path / "copy", **text))


def test_the_light_tower_reads_the_names_of_open_clip_and_half_precision(clip_folder, tmp_path):
    from transformers import CLIPModel

    copy = shutil.copytree(clip_folder, tmp_path / "copy")
    (copy / "model.safetensors").unlink()
    model = CLIPModel.from_pretrained(clip_folder)
    foreign = in_open_clip_names(model)
    save_file({name: value.half() for name, value in foreign.items()}, copy / "open_clip_model.safetensors")
    assert_same_embeddings(copy, model.half().float())


def test_the_light_tower_equals_transformers_at_the_width_of_vit_b_16(clip_folder, tmp_path):
    from transformers import CLIPConfig, CLIPModel

    config = CLIPConfig.from_pretrained(clip_folder)
    config.text_config.update({
        "hidden_size": 512, "intermediate_size": 2048, "num_hidden_layers": 3, "num_attention_heads": 8,
        "max_position_embeddings": 77, "hidden_act": "gelu",
    })  # fmt: skip
    config.projection_dim = 512
    folder = shutil.copytree(clip_folder, tmp_path / "large")
    save_model(seeded(lambda: CLIPModel(config)), folder)
    assert_same_embeddings(folder)


def test_what_the_light_tower_does_not_know_is_left_to_transformers(clip_folder, tmp_path):
    def refused(**text) -> bool:
        place = tmp_path / str(len(list(tmp_path.iterdir())))
        return open_clip_text(changed_config(clip_folder, place, **text), "test") is None

    assert not refused()
    assert refused(hidden_act="relu")
    assert refused(num_hidden_layers=1)
    assert refused(num_hidden_layers=10**9)
    assert refused(num_attention_heads=5)
    assert refused(hidden_size="24")
    assert refused(vocab_size=999)


@pytest.mark.parametrize("load", [load_text, load_clip])
def test_a_character_of_several_bytes_may_be_several_tokens(load):
    # None of them is a word of the bundled model: 20 times 3 bytes, start and end, of which 24 tokens are read.
    assert load("bundled").tokens_over("红" * 20) == 62 - 24


def test_a_text_tower_that_is_not_whole_is_refused(clip_folder, tmp_path):
    copy = shutil.copytree(clip_folder, tmp_path / "copy")
    state = load_file(copy / "model.safetensors")
    name = "text_model.encoder.layers.0.mlp.fc1.weight"
    save_file({key: value for key, value in state.items() if key != name}, copy / "model.safetensors")
    with pytest.raises(ModelError, match="1 missing"):
        load_text(str(copy))


def test_the_text_tower_of_a_loaded_encoder_is_that_of_its_files_and_does_not_hold_the_encoder(clip_folder):
    whole = load_clip(str(clip_folder))
    light, held = whole.text_only("cpu"), weakref.ref(whole)
    assert isinstance(light, ClipText)
    del whole
    gc.collect()
    assert held() is None
    from_files = load_text(str(clip_folder))
    assert torch.equal(light.encode_text(TEXTS), from_files.encode_text(TEXTS))
    assert light.content_hash == from_files.content_hash


def test_an_encoder_of_another_architecture_answers_texts_without_its_image_tower(clip_folder, tmp_path):
    whole = load_clip(str(changed_config(clip_folder, tmp_path / "other", hidden_act="relu")))
    expected, images = whole.encode_text(TEXTS), weakref.ref(whole._images)
    texts = whole.text_only("cpu")
    gc.collect()
    assert images() is None
    assert torch.equal(texts.encode_text(TEXTS), expected)
