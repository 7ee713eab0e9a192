"""Settings and tokenizers that fit no model, or not this one: one line names the file and the setting."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from support.damaged_models import HUGE, change_json, refused, with_setting

from lexsplat.features.encoders import load_clip, load_dino
from lexsplat.features.text import load_text

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


# -- config.json


@pytest.mark.parametrize("value", [0, -4, "4", 2.5, True, [], [40, 0], HUGE, 1_000_000_000])
def test_a_size_that_is_not_a_number_from_1_is_refused_by_its_place(clip_copy, value):
    path = with_setting(clip_copy, "vision_config.num_attention_heads", value)
    expected = (
        f"{path}: vision_config.num_attention_heads: expected a whole number from 1 to 1,048,576, found "
    )
    refused(clip_copy, f"{expected}{json.dumps(value)}"[:200], "; fetch config.json again")


@pytest.mark.parametrize("value", [0, -1, 1_000_000])
@pytest.mark.parametrize("place", ["text_config.num_hidden_layers", "vision_config.num_hidden_layers"])
def test_no_layers_and_a_million_layers_are_refused_before_they_are_built(clip_copy, place, value):
    path = with_setting(clip_copy, place, value)
    refused(clip_copy, f"{path}: {place}: expected a whole number from 1 to 256, found {value};")


@pytest.mark.parametrize(
    "place",
    [
        "text_config.hidden_size", "text_config.vocab_size", "text_config.max_position_embeddings",
        "text_config.intermediate_size", "text_config.num_attention_heads", "vision_config.hidden_size",
        "vision_config.patch_size", "vision_config.image_size", "vision_config.num_channels", "projection_dim",
    ],
)  # fmt: skip
def test_sizes_of_every_kind_are_refused_at_0_and_below(clip_copy, place):
    for value in (0, -8):
        path = with_setting(clip_copy, place, value)
        refused(clip_copy, f"{path}: {place}: expected a whole number from 1 to", f", found {value};")


@pytest.mark.parametrize("key", ["patch_size", "image_size", "num_hidden_layers", "num_attention_heads"])
def test_sizes_of_a_vision_transformer_are_refused_at_0(vit_folder, tmp_path, key):
    path = with_setting(shutil.copytree(vit_folder, tmp_path / "vit"), key, 0)
    refused(path.parent, f"{path}: {key}: expected a whole number from 1", "found 0;", load=load_dino)


@pytest.mark.parametrize("value", [-1.0, float("nan"), 1e9, "1e-5", HUGE])
def test_an_epsilon_that_norms_cannot_have_is_refused(clip_copy, value):
    path = with_setting(clip_copy, "text_config.layer_norm_eps", value)
    refused(clip_copy, f"{path}: text_config.layer_norm_eps: expected a number from 0 to 1, found ")


def test_an_unknown_activation_is_refused_by_its_place(clip_copy):
    path = with_setting(clip_copy, "vision_config.hidden_act", "swish9")
    expected = f"{path}: vision_config.hidden_act: expected an activation of transformers, such as quick_gelu"
    refused(clip_copy, expected, 'found "swish9"; fetch config.json again')


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("vision_config.num_attention_heads", 7),
        ("vision_config.image_size", [40, 40]),
        ("text_config", "none"),
        ("model_type", "nonsense"),
        ("model_type", "clap"),
    ],
)
def test_a_configuration_of_which_transformers_builds_nothing_is_named(clip_copy, place, value):
    with_setting(clip_copy, place, value)
    refused(clip_copy, f"model {clip_copy}: config.json: expected a model that transformers can load")


@pytest.mark.parametrize(
    ("end", "found"),
    [
        ([1637], "[1637]"),
        (10**9, "1000000000"),
        (-1, "-1"),
        (None, "49407, as it is where the file gives none"),
    ],
)
def test_an_end_token_that_the_model_does_not_have_is_an_error_of_its_configuration(clip_copy, end, found):
    path = with_setting(clip_copy, "text_config.eos_token_id", end)
    expected = (
        f"{path}: text_config.eos_token_id: expected the number of the token that ends prompts (1637 by"
    )
    for load in (load_clip, load_text):
        refused(clip_copy, expected, f", found {found}; fetch config.json again", load=load)


def test_another_end_token_of_the_model_is_told_with_the_file_that_names_it(clip_copy):
    with_setting(clip_copy, "text_config.eos_token_id", 5)
    refused(clip_copy, "ends prompts with the model's end token (5 in config.json), found token 1637")


# -- the numbers of tokens


@pytest.mark.parametrize(
    ("number", "found"),
    [
        (99_999, "token 'banknote</w>' with the number 99999"),
        (1638, "token 'banknote</w>' with the number 1638"),
        (7, "the number 7 for both "),
        (-1, "-1"),
    ],
)
def test_a_token_without_a_row_of_its_own_in_the_model_is_refused_by_every_loader(clip_copy, number, found):
    """The model would be built with, and the first question with that word would fail."""
    path = clip_copy / "tokenizer.json"

    def moved(content: dict) -> None:
        content["model"]["vocab"]["banknote</w>"] = number

    change_json(path, moved)
    for load in (load_clip, load_text):
        refused(clip_copy, f"{path}: expected ", found, "; fetch the model again", load=load)


def test_a_start_of_prompts_without_a_row_in_the_model_is_not_taken_as_it_is(clip_copy, clip_folder):
    change_json(
        clip_copy / "tokenizer.json",
        lambda content: content["post_processor"].update(cls=["<|startoftext|>", 99_999]),
    )
    for load in (load_clip, load_text):  # transformers adds the start itself
        found, expected = (load(str(each)).encode_text(["a car"]) for each in (clip_copy, clip_folder))
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
