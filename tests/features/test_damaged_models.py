"""Model folders with a damaged file: one line names the file, and nothing is left behind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from support.damaged_models import HUGE, change_json, refused

from lexsplat import cli
from lexsplat.features.encoders import load_clip, load_dino
from lexsplat.features.text import load_text

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


# -- the image preprocessor


@pytest.mark.parametrize(
    ("mean", "found"),
    [
        (None, "found null"),
        (0.5, "found 0.5"),
        ("0.5", 'found "0.5"'),
        ([0.5, 0.5], "found [0.5, 0.5]"),
        ([0.5, None, 0.5], "found [0.5, null, 0.5]"),
        ([True, True, True], "found [true, true, true]"),
        ([0.5, 0.5, float("nan")], "found [0.5, 0.5, NaN]"),
        ([[0.5, 0.5, 0.5]], "found [[0.5, 0.5, 0.5]]"),
        ([0.5, 0.5, HUGE], "found [0.5, 0.5, 999"),
        ([0.5, 0.5, 1e300], "found [0.5, 0.5, 1e+300]"),
        ([0.5] * 1000, "..."),
    ],
)
def test_an_image_mean_that_is_not_three_numbers_is_refused(vit_folder, tmp_path, mean, found):
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    path = folder / "preprocessor_config.json"
    path.write_text(json.dumps({"image_mean": mean, "image_std": [0.5, 0.5, 0.5]}))
    expected = f"{path}: image_mean: expected three finite numbers, "
    message = refused(folder, expected, found, "fetch the model again", load=load_dino)
    assert len(message) < len(expected) + 250


@pytest.mark.parametrize("std", [None, 1, [0.5, 0.5, 0], [0.5, 0.5, -0.5], [0.5, 0.5, 1e-300]])
def test_an_image_deviation_that_is_not_three_positive_numbers_is_refused(vit_folder, tmp_path, std):
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    (folder / "preprocessor_config.json").unlink()
    content = {"image_processor": {"image_mean": [0.5, 0.5, 0.5], "image_std": std}}
    (folder / "processor_config.json").write_text(json.dumps(content))
    expected = "processor_config.json: image_std: expected three finite numbers above 0"
    refused(folder, expected, f"found {json.dumps(std)}", load=load_dino)


def test_an_image_mean_of_another_range_than_the_file_says_is_refused(vit_folder, tmp_path):
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    path, content = folder / "preprocessor_config.json", {"image_mean": [122.8, 116.7, 104.1]}
    path.write_text(json.dumps(content | {"image_std": [68.5, 66.6, 70.3]}))
    refused(
        folder, f"{path}: image_mean", "means within the colors 0 to 1", "122.8", "do_rescale", load=load_dino
    )


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("image_mean", [-100] * 3, "means within the colors 0 to 1 of its images, found [-100, -100, -100];"),
        ("image_std", [1e-30] * 3, "deviations within the colors 0.0001 to 1 of its images, found [1e-30, "),
        (
            "image_std",
            [68.5, 66.6, 70.3],
            "deviations within the colors 0.0001 to 1 of its images, found [68.5",
        ),
    ],
)
def test_means_and_deviations_that_colors_cannot_have_are_refused(
    clip_copy, vit_folder, tmp_path, key, value, expected
):
    for folder, load in ((clip_copy, load_clip), (shutil.copytree(vit_folder, tmp_path / "vit"), load_dino)):
        path = folder / "preprocessor_config.json"
        change_json(path, lambda content: content.update({key: value}))
        refused(folder, f"{path}: {key}: expected {expected}", "fetch the model again", load=load)


@pytest.mark.parametrize(
    "content",
    [
        {"image_mean": [127.5] * 3, "image_std": [51.0] * 3, "do_rescale": False},
        {"image_mean": [1.0] * 3, "image_std": [0.4] * 3, "rescale_factor": 2 / 255},
    ],
    ids=["colors to 255", "colors to 2"],
)
def test_colors_are_scaled_as_the_preprocessor_says(vit_folder, tmp_path, content):
    usual, other = (shutil.copytree(vit_folder, tmp_path / name) for name in ("usual", "other"))
    (usual / "preprocessor_config.json").write_text(
        json.dumps({"image_mean": [0.5] * 3, "image_std": [0.2] * 3})
    )
    (other / "preprocessor_config.json").write_text(json.dumps(content))
    image = torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(0))
    first, second = (load_dino(str(each)).encode_dense(image, short_side=32) for each in (usual, other))
    torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-5)


def test_a_preprocessor_that_does_not_normalize_leaves_colors_as_they_are(vit_folder, tmp_path):
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    content = {"image_mean": [0.5] * 3, "image_std": [0.2] * 3, "do_normalize": False}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    encoder = load_dino(str(folder))
    assert (encoder._mean.flatten().tolist(), encoder._std.flatten().tolist()) == ([0, 0, 0], [1, 1, 1])


def test_whole_numbers_are_numbers_and_other_entries_are_not_read(vit_folder, tmp_path):
    folder = shutil.copytree(vit_folder, tmp_path / "vit")
    content = {"image_mean": [0, 0, 0], "image_std": [1, 1, 1]}
    content |= {"size": None, "crop_size": "large", "rescale_factor": 1 / 255, "resample": {}}
    (folder / "preprocessor_config.json").write_text(json.dumps(content))
    encoder = load_dino(str(folder))
    assert encoder._mean.flatten().tolist() == [0, 0, 0]
    assert encoder._std.flatten().tolist() == [1, 1, 1]
    assert encoder.encode_dense(torch.rand(3, 32, 32), short_side=32).isfinite().all()


def test_a_damaged_preprocessor_is_refused_by_each_command_and_leaves_no_folder(
    clip_copy, vit_folder, tiny_capture, tmp_path, capsys
):
    dino, output = shutil.copytree(vit_folder, tmp_path / "vit"), tmp_path / "new" / "scene"
    for folder in (clip_copy, dino):
        (folder / "preprocessor_config.json").write_text('{"image_mean": null, "image_std": null}')
    build = ["build", str(tiny_capture), "--output", str(output), "--device", "cpu"]
    for words in (
        ["encoders", "--clip", str(clip_copy)],
        ["encoders", "--clip", "bundled", "--dino", str(dino)],
        [*build, "--clip", str(clip_copy), "--dino", "none"],
    ):
        assert cli.main(words) == 1
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith("error: ")
        assert "preprocessor_config.json: image_mean: expected three finite numbers, found null" in error
    assert not output.parent.exists()


# -- pickled weights


def pickled(folder: Path, content: bytes | dict) -> Path:
    """Replace the weights of a folder by a pickled file."""
    (folder / "model.safetensors").unlink()
    path = folder / "pytorch_model.bin"
    if isinstance(content, dict):
        torch.save(content, path)
    else:
        path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"\x80\x04\x95" + b"garbage" * 9, "a damaged file"),
        (b"\x80\x02" + b"\xff" * 50, "a damaged file"),
        (b"hello world", "a damaged file"),
        (b"PK\x03\x04" + b"x" * 90, "a damaged file"),
        (b"cposix\nsystem\n(S'true'\ntR.", "other objects"),
        (b"", "an empty file"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 598641023\n", "a pointer of Git LFS"),
        ({"weight": Path("a")}, "other objects"),
        ({"weight": 3}, "other objects"),
        ({1: torch.ones(3)}, "other objects"),
    ],
)  # fmt: skip
def test_pickled_weights_that_are_not_tensors_are_refused_in_words_of_lexsplat(
    clip_copy, content, found, recwarn
):
    path = pickled(clip_copy, content)
    expected = "pytorch_model.bin: expected a pickled dictionary of tensors only, "
    message = refused(clip_copy, f"{expected}found {found}; ", str(path.parent))
    assert "PyTorch" not in message
    assert not [one for one in recwarn if "pickle" in str(one.message)]


# -- weights that are not there


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "tokenizer.json"])
def test_a_broken_link_or_a_folder_in_place_of_a_file_is_told(clip_copy, name):
    """As a copy of a part of the Hub's cache leaves them."""
    path = clip_copy / name
    path.unlink()
    path.symlink_to("../../blobs/4d7a")
    refused(clip_copy, "expected a model folder with ", f"{name}", f", found {name} (a broken link), ")
    path.unlink()
    path.mkdir()
    refused(clip_copy, "expected a model folder with ", f"{name}", f", found {name} (a folder), ")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("{", " that is no JSON (Expecting property name"),
        ("[]", " without tensors in its weight_map"),
        ('{"weight_map": {}}', " without tensors in its weight_map"),
        (
            '{"weight_map": {"a": "../b/model.safetensors"}}',
            ' with "../b/model.safetensors" in place of the name',
        ),
        ('{"weight_map": {"a": 3}}', " with 3 in place of the name of a file"),
    ],
)
def test_a_damaged_index_of_shards_is_told_with_what_is_wrong(clip_copy, content, found):
    (clip_copy / "model.safetensors").rename(clip_copy / "model-00001-of-00001.safetensors")
    (clip_copy / "model.safetensors.index.json").write_text(content)
    refused(clip_copy, f"all shards of model.safetensors, found model.safetensors.index.json{found}")


def test_a_missing_shard_is_told_by_its_name(clip_copy):
    (clip_copy / "model.safetensors").unlink()
    table = {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}
    (clip_copy / table["a"]).touch()
    (clip_copy / "model.safetensors.index.json").write_text(json.dumps({"weight_map": table}))
    refused(clip_copy, f"found no {table['b']}, which model.safetensors.index.json lists")


# -- weights that are not plain floats

WEIGHT = "vision_model.encoder.layers.0.mlp.fc1.weight"


def rewritten(folder: Path, change) -> Path:
    """The folder with ``change`` of its tensors."""
    path = folder / "model.safetensors"
    save_file(change(load_file(path)), path, {"format": "pt"})
    return folder


@pytest.mark.parametrize(
    "dtype",
    [torch.int8, torch.uint8, torch.int32, torch.bool, torch.float8_e4m3fn, torch.complex64],
    ids=lambda dtype: str(dtype).removeprefix("torch."),
)
def test_quantized_weights_are_refused_with_their_type_and_name(clip_copy, vit_folder, tmp_path, dtype):
    """Their scales are not read, so that they would be other weights."""
    found = f"model.safetensors: expected weights in float16, bfloat16, float32 or float64, found {dtype}"
    found, remedy = found.replace("torch.", ""), "; fetch the float version of the model"
    rewritten(clip_copy, lambda state: state | {WEIGHT: (state[WEIGHT] * 99).to(dtype)})
    for load in (load_clip, load_text):
        refused(clip_copy, f"{found} in {WEIGHT}{remedy}", load=load)
    vit = shutil.copytree(vit_folder, tmp_path / "vit")
    rewritten(vit, lambda state: {key: value.to(dtype) for key, value in state.items()})
    refused(vit, f"{found} in ", remedy, load=load_dino)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_weights_in_other_floats_and_places_in_whole_numbers_load(clip_copy, clip_folder, dtype):
    places = {
        f"{tower}_model.embeddings.position_ids": torch.arange(26)[None] for tower in ("text", "vision")
    }
    rewritten(clip_copy, lambda state: {key: value.to(dtype) for key, value in state.items()} | places)
    found, expected = (load_clip(str(each)).encode_text(["a car"]) for each in (clip_copy, clip_folder))
    assert float((found * expected).sum()) > 0.99


def test_sparse_weights_are_refused_by_the_name_of_a_tensor(clip_copy):
    state = load_file(clip_copy / "model.safetensors")
    pickled(clip_copy, state | {WEIGHT: state[WEIGHT].to_sparse()})
    found = f"or float64, found sparse_coo in {WEIGHT};"
    for load in (load_clip, load_text):
        refused(clip_copy, "pytorch_model.bin: expected weights", found, "dense", load=load)


# -- configuration and tokenizer


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "Expecting value"),
        ("[]", "a list"),
        ("null", "null"),
        ("{}", "no model_type"),
        ('{"model_type": 3}', "no model_type"),
    ],
)
def test_a_damaged_configuration_is_refused_by_its_name(clip_copy, vit_folder, tmp_path, content, found):
    vit = shutil.copytree(vit_folder, tmp_path / "vit")
    for folder, load in ((clip_copy, load_clip), (clip_copy, load_text), (vit, load_dino)):
        path = folder / "config.json"
        path.write_text(content)
        expected = f"{path}: expected a model configuration in JSON, found {found}"
        refused(folder, expected, "fetch the model again", load=load)


@pytest.mark.parametrize("name", ["tokenizer.json", "tokenizer_config.json", "special_tokens_map.json"])
@pytest.mark.parametrize(("content", "found"), [("", "Expecting value"), ("[]", "a list"), ("null", "null")])
def test_a_damaged_file_of_the_tokenizer_is_refused_by_its_name(clip_copy, name, content, found):
    (clip_copy / name).write_text(content)
    expected = f"{clip_copy / name}: expected a tokenizer in JSON, found {found}"
    refused(clip_copy, expected, "fetch the model again")


@pytest.mark.parametrize("content", ["{}", '{"added_tokens": 3}', '{"model": []}'])
def test_json_that_is_no_tokenizer_is_refused_by_its_name(clip_copy, content):
    (clip_copy / "tokenizer.json").write_text(content)
    message = refused(clip_copy, f"{clip_copy / 'tokenizer.json'}: expected a tokenizer, found other content")
    assert "added_tokens'" not in message


# -- the text tower


def test_a_word_whose_numbers_are_not_finite_is_refused_though_no_check_reads_it(clip_copy):
    weights = load_file(clip_copy / "model.safetensors")
    weights["text_model.embeddings.token_embedding.weight"][77] = float("nan")
    save_file(weights, clip_copy / "model.safetensors", {"format": "pt"})
    for load in (load_clip, load_text):
        refused(clip_copy, "finite", "NaN or infinity", load=load)


def test_a_tokenizer_file_that_does_not_end_prompts_is_not_taken_as_it_is(clip_copy, tmp_path):
    """The tower without transformers would read an embedding at some word; transformers adds the end itself."""
    config = json.loads((clip_copy / "config.json").read_text())
    config["text_config"]["eos_token_id"] = 2  # as OpenAI's: the largest number of a prompt is its end
    (clip_copy / "config.json").write_text(json.dumps(config))
    clip_folder = shutil.copytree(clip_copy, tmp_path / "whole")
    path = clip_copy / "tokenizer.json"
    content = json.loads(path.read_text())
    assert content["post_processor"]
    path.write_text(json.dumps(content | {"post_processor": None}))
    for load in (load_clip, load_text):
        found, expected = (
            load(str(each)).encode_text(["a car", "blue sky"]) for each in (clip_copy, clip_folder)
        )
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
