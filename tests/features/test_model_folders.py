"""Model folders as they occur: a model loads whole, or is refused in one line."""

from __future__ import annotations

import functools
import json
import logging
import os
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from support.encoder_folders import (
    in_open_clip_names,
    in_timm_names,
    revert_names,
    save_model,
    seeded,
    tiny_vit,
)
from support.refusals import assert_reports
from support.siglip_folder import siglip_folder

from lexsplat.features import hub
from lexsplat.features.clip_image import ClipImages
from lexsplat.features.encoders import load_clip, load_dino
from lexsplat.runtime.errors import ModelError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

TOKENIZER = ("tokenizer.json", "tokenizer_config.json")


def rewrite(folder: Path, change, name: str = "model.safetensors") -> None:
    """Replace the weights of a folder by ``change`` of them, under another name if one is given."""
    state = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    save_file(change(state), folder / name, metadata={"format": "pt"})


def refused(folder: Path, *parts: str, load=load_clip) -> None:
    with pytest.raises(ModelError) as caught:
        load(str(folder))
    assert_reports(caught.value, *parts)


def assert_same_model(found, folder: Path) -> None:
    """Assert that every tensor is that of transformers' own loading of a folder."""
    from transformers import AutoModel

    model = AutoModel.from_pretrained(folder)
    if getattr(found, "_images", None) is None:
        own = not isinstance(found._model, type(model))
        expected, state = revert_names(model) if own else model.state_dict(), found._model.state_dict()
    else:  # both towers as lexsplat arranges them
        names = {name: name.removeprefix("text_model.") for name in model.state_dict() if "text_" in name}
        expected = {names[name]: value for name, value in model.state_dict().items() if name in names}
        expected |= tensors_of(ClipImages(model))
        state = found.text_tower().tensors | tensors_of(found._images)
    assert {name for name in expected if "pooler" not in name} <= set(state)
    for name, tensor in state.items():
        if "pooler" not in name:
            torch.testing.assert_close(tensor, expected[name], atol=0, rtol=0)


def tensors_of(value, name: str = "images") -> dict[str, torch.Tensor]:
    """All tensors in an object, by their place in it."""
    if isinstance(value, torch.Tensor):
        return {name: value}
    if isinstance(value, torch.nn.Module):
        return {f"{name}.{key}": tensor for key, tensor in value.state_dict().items()}
    if isinstance(value, functools.partial):
        value = list(value.keywords.values())
    parts = dict(enumerate(value)) if isinstance(value, list) else getattr(value, "__dict__", {})
    return {
        key: tensor
        for part, one in parts.items()
        for key, tensor in tensors_of(one, f"{name}.{part}").items()
    }


# -- what loads


def test_weights_in_the_names_of_open_clip_give_every_tensor_its_place(clip_folder, clip_copy):
    from transformers import CLIPModel

    foreign = in_open_clip_names(CLIPModel.from_pretrained(clip_folder))
    rewrite(clip_copy, lambda state: foreign, "open_clip_model.safetensors")
    assert_same_model(load_clip(str(clip_copy)), clip_folder)
    newer = {
        f"text.{name}": value for name, value in foreign.items() if not name.startswith(("visual", "logit"))
    }
    newer |= {name: value for name, value in foreign.items() if name.startswith(("visual", "logit"))}
    save_file(newer, clip_copy / "open_clip_model.safetensors")
    assert_same_model(load_clip(str(clip_copy)), clip_folder)


def test_the_weights_of_transformers_are_preferred_to_those_of_open_clip(clip_folder, clip_copy):
    save_file({"visual.proj": torch.zeros(1)}, clip_copy / "open_clip_model.safetensors")
    (clip_copy / "pytorch_model.bin").write_bytes(b"no pickle")
    assert_same_model(load_clip(str(clip_copy)), clip_folder)


def test_weights_in_the_names_of_timm_give_every_tensor_its_place(vit_folder, tmp_path):
    folder = shutil.copytree(vit_folder, tmp_path / "timm")
    rewrite(folder, lambda state: in_timm_names(seeded(tiny_vit)))
    assert_same_model(load_dino(str(folder)), vit_folder)


@pytest.mark.parametrize("wrapped", [False, True])
def test_pickled_weights_are_read_with_a_note(clip_folder, clip_copy, caplog, wrapped):
    state = load_file(clip_copy / "model.safetensors")
    (clip_copy / "model.safetensors").unlink()
    content = {"state_dict": {f"module.{name}": value for name, value in state.items()}} if wrapped else state
    torch.save(content, clip_copy / "pytorch_model.bin")
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        assert_same_model(load_clip(str(clip_copy)), clip_folder)
    assert "pytorch_model.bin is read without running its code" in caplog.text


def test_pickled_code_does_not_run(clip_copy, tmp_path):
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    (clip_copy / "model.safetensors").unlink()
    torch.save({"weight": Trap()}, clip_copy / "pytorch_model.bin")
    refused(clip_copy, "pytorch_model.bin", "tensors only")
    assert not (tmp_path / "ran").exists()


def test_old_and_new_layouts_of_transformers_load_whole(vit_folder, clip_folder, clip_copy, tmp_path):
    from transformers import ViTConfig, ViTForImageClassification

    names = list(load_file(vit_folder / "model.safetensors"))
    assert any(name.startswith("encoder.layer.0.attention.attention.key") for name in names), (
        "the Hub's layout"
    )
    assert_same_model(load_dino(str(vit_folder)), vit_folder)
    newer = shutil.copytree(vit_folder, tmp_path / "newer")
    rewrite(newer, lambda state: seeded(tiny_vit).state_dict())
    assert_same_model(load_dino(str(newer)), vit_folder)
    # A classifier has its layers under "vit." and a head that is not used.
    classifier = ViTForImageClassification(ViTConfig.from_pretrained(vit_folder))
    headed = save_model(classifier.eval(), tmp_path / "headed")
    for name, tensor in load_dino(str(headed))._model.state_dict().items():
        if "pooler" not in name:
            torch.testing.assert_close(tensor, classifier.vit.state_dict()[name], atol=0, rtol=0)
    # Old CLIP files hold positions, which newer versions compute.
    rewrite(clip_copy, lambda state: {**state, "text_model.embeddings.position_ids": torch.arange(11)[None]})
    assert_same_model(load_clip(str(clip_copy)), clip_folder)


def test_shards_load_whole_and_every_shard_is_needed(clip_folder, clip_copy):
    state = load_file(clip_copy / "model.safetensors")
    (clip_copy / "model.safetensors").unlink()
    shards = [f"model-0000{number}-of-00002.safetensors" for number in (1, 2)]
    table = {name: shards[place % 2] for place, name in enumerate(state)}
    for shard in shards:
        save_file({name: state[name] for name in table if table[name] == shard}, clip_copy / shard)
    (clip_copy / "model.safetensors.index.json").write_text(json.dumps({"weight_map": table}))
    assert_same_model(load_clip(str(clip_copy)), clip_folder)
    (clip_copy / shards[1]).unlink()
    refused(clip_copy, "all shards of model.safetensors", "save_pretrained")
    (clip_copy / "model.safetensors.index.json").write_text('{"weight_map": {"a": "../copy/config.json"}}')
    refused(clip_copy, "all shards of model.safetensors")


# -- what is refused


def test_pickled_shards_are_named_and_how_to_write_safetensors_of_them(clip_copy):
    (clip_copy / "model.safetensors").unlink()
    for number in range(1, 9):
        (clip_copy / f"a-{number}.bin").write_bytes(b"")
    (clip_copy / "pytorch_model.bin.index.json").write_text("{}")
    refused(
        clip_copy,
        "expected a model folder with model.safetensors, found pytorch_model.bin.index.json",
        f"AutoModel.from_pretrained({str(clip_copy)!r}).save_pretrained({str(clip_copy)!r})",
    )


def test_a_model_saved_without_its_tokenizer_is_refused(clip_copy):
    for name in TOKENIZER:
        (clip_copy / name).unlink()
    refused(clip_copy, "a tokenizer (tokenizer.json)", "copy the tokenizer files")
    (clip_copy / "vocab.json").write_text("{}")
    refused(clip_copy, "a tokenizer (tokenizer.json)")  # without its merges


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "tokenizer.json", ""])
def test_a_file_without_permission_is_refused(clip_copy, monkeypatch, name):
    closed, access = clip_copy / name, os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != closed and access(path, mode))
    refused(clip_copy, str(closed), "permission to read it", "none", "chmod")


def test_the_tokenizer_of_another_model_is_refused(clip_copy):
    content = json.loads((clip_copy / "tokenizer.json").read_text())
    vocabulary = content["model"]["vocab"]
    kept = dict(sorted(vocabulary.items(), key=lambda item: item[1])[:600])
    content["model"] |= {"vocab": kept, "merges": []}
    content["added_tokens"] = []
    (clip_copy / "tokenizer.json").write_text(json.dumps(content))
    refused(clip_copy, f"a tokenizer with the {len(vocabulary):,} words of the model", "fetch")


def test_a_layer_without_its_attention_is_refused(clip_copy):
    rewrite(
        clip_copy,
        lambda state: {n: t for n, t in state.items() if "vision_model.encoder.layers.1.self" not in n},
    )
    refused(
        clip_copy,
        "model.safetensors",
        "all 78 tensors",
        "8 missing: vision_model.encoder.layers.1.self_attn.k_proj",
    )


def test_names_that_do_not_match_are_refused(clip_copy, vit_folder, tmp_path):
    rewrite(clip_copy, lambda state: {f"tower.{name}": tensor for name, tensor in state.items()})
    refused(clip_copy, "model.safetensors", "missing")
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    rewrite(folder, lambda state: {f"backbone.{name}": tensor for name, tensor in state.items()})
    refused(folder, "model.safetensors", "missing", load=load_dino)


def test_a_configuration_with_fewer_layers_than_the_weights_is_refused(clip_copy):
    config = json.loads((clip_copy / "config.json").read_text())
    config["vision_config"]["num_hidden_layers"] = 1
    (clip_copy / "config.json").write_text(json.dumps(config))
    refused(clip_copy, "all layers of the weights", "vision_model.encoder.layers.1")


def test_weights_of_another_size_are_refused(clip_copy):
    rewrite(clip_copy, lambda state: {**state, "visual_projection.weight": torch.ones(7, 32)})
    refused(clip_copy, "sizes in config.json", "visual_projection.weight")


def test_unlike_words_with_one_vector_are_refused(clip_copy):
    def blind(state: dict) -> dict:
        return {
            n: torch.zeros_like(t) if n.endswith("token_embedding.weight") else t for n, t in state.items()
        }

    rewrite(clip_copy, blind)
    refused(clip_copy, "unlike words with unlike embeddings", "an apple")


def test_weights_that_are_not_finite_are_refused(clip_copy, vit_folder, tmp_path):
    def spoiled(state: dict) -> dict:
        return {
            **state,
            "visual_projection.weight": torch.full_like(state["visual_projection.weight"], torch.nan),
        }

    rewrite(clip_copy, spoiled)
    encoder = load_clip(str(clip_copy))
    with pytest.raises(ModelError) as caught:
        encoder.encode_images(torch.rand(1, 3, 40, 40))
    assert_reports(caught.value, "finite features")
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    rewrite(folder, lambda state: {name: tensor * torch.inf for name, tensor in state.items()})
    with pytest.raises(ModelError, match="finite features"):
        load_dino(str(folder)).encode_dense(torch.rand(3, 32, 32), short_side=32)


def test_an_overflow_in_half_precision_is_computed_again_in_full(clip_folder, monkeypatch):
    from contextlib import contextmanager

    monkeypatch.setattr("lexsplat.features.pretrained.bfloat16_is_faster", lambda: False)
    encoder, images = load_clip(str(clip_folder)), torch.rand(2, 3, 40, 40)
    expected = encoder.encode_images(images)
    halves = []

    @contextmanager
    def overflowing(device, *, crops=False):
        scale = encoder._model.visual_projection.weight
        halves.append(scale.clone())
        scale.fill_(torch.inf)
        yield
        scale.copy_(halves[0])

    monkeypatch.setattr("lexsplat.features.pretrained.precision", overflowing)
    for _ in range(2):
        torch.testing.assert_close(encoder.encode_images(images), expected)
    assert len(halves) == 1, "after an overflow, half precision is not tried again"


@pytest.mark.parametrize("content", ["damaged", "empty", "missing", "a list"])
def test_a_damaged_folder_is_refused(clip_copy, content):
    weights, config = clip_copy / "model.safetensors", clip_copy / "config.json"
    if content == "damaged":
        weights.write_bytes(weights.read_bytes()[: weights.stat().st_size // 2])
        refused(clip_copy, "model.safetensors", "expected safetensors", "fetch it again")
    elif content == "missing":
        weights.unlink()
        refused(clip_copy, "a model folder with model.safetensors", "config.json", "--clip bundled")
    elif content == "a list":
        config.write_text("[]")
        refused(clip_copy, "a model configuration")
    else:
        shutil.rmtree(clip_copy)
        clip_copy.mkdir()
        refused(clip_copy, "an empty folder")


def test_a_clone_without_its_large_files_is_reported(clip_copy):
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 598641023\n"
    (clip_copy / "model.safetensors").write_text(pointer)
    refused(clip_copy, "model.safetensors", "a pointer of Git LFS", f"git -C {clip_copy} lfs pull")


def test_an_empty_name_is_not_the_working_directory(clip_folder, monkeypatch):
    monkeypatch.chdir(clip_folder)
    for name in ("", " "):
        refused(name, "a folder or a model name", "nothing", "--clip bundled")


def test_a_model_of_the_other_kind_is_refused(clip_folder):
    refused(clip_folder, "vision transformer", load=load_dino)
    refused(hub.BUNDLED_ENCODERS / "dino", "image-text model", "a 'vit' model without a text tower")


def test_siglip_loads_with_its_tokenizer_of_sentencepiece(tmp_path):
    pytest.importorskip("sentencepiece", reason="needs the extra `siglip`")
    reference = siglip_folder(tmp_path)
    encoder = load_clip(str(tmp_path))
    ids = encoder._text_inputs(["A Car!"])["input_ids"][0].tolist()
    expected = reference.encode("a car")  # lower case, without punctuation
    assert ids == (expected + [1] * 9)[:9], "then the end of the text, as padding"


@pytest.mark.parametrize("text", ["A Car!", "the  wooden-table", "ﬁne blue books, red", "Ünknown 42", "mug"])
def test_the_tokenizer_of_siglip_is_exported_with_its_tokens(tmp_path, text):
    pytest.importorskip("sentencepiece", reason="needs the extra `siglip`")
    from tokenizers import Tokenizer

    siglip_folder(tmp_path)
    encoder = load_clip(str(tmp_path))
    exported = Tokenizer.from_str(json.dumps(encoder.text_tower().tokenizer))
    assert exported.encode(text).ids == encoder._tokenizer(text)["input_ids"]


def test_the_tokenizer_of_siglip_needs_an_extra(clip_copy, monkeypatch):
    (clip_copy / "tokenizer.json").unlink()
    (clip_copy / "spiece.model").write_bytes(b"")
    (clip_copy / "tokenizer_config.json").write_text('{"tokenizer_class": "SiglipTokenizer"}')
    monkeypatch.setattr("lexsplat.features.clip._is_installed", lambda module: False)
    refused(clip_copy, "SentencePiece, which is not installed", 'pip install "lexsplat[siglip]"')


def test_the_content_hash_covers_the_loaded_files_alone(clip_folder, clip_copy):
    expected = hub.content_hash(clip_folder, "clip")
    assert hub.content_hash(clip_copy, "clip") == expected
    # What other programs add to a snapshot of the Hub.
    (clip_copy / "README.md").write_text("prose")
    (clip_copy / "open_clip_config.json").write_text("{}")
    (clip_copy / "open_clip_model.safetensors").write_bytes(b"another format")
    (clip_copy / "vocab.txt").write_text("another tokenizer")
    assert hub.content_hash(clip_copy, "clip") == expected
    for name in ("model.safetensors", "config.json", "tokenizer.json", "preprocessor_config.json"):
        content = (clip_copy / name).read_bytes()
        (clip_copy / name).write_bytes(content + b" ")
        assert hub.content_hash(clip_copy, "clip") != expected, name
        (clip_copy / name).write_bytes(content)
