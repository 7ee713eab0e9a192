"""Training of the bundled encoders: ground truth of phrases, held-out pairs, losses."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.training_frames import frames_with_a_handle, labels

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("training_tools")]

CAPTURES = Path(str(resources.files("lexsplat"))) / "demo" / "captures"
CLIP = Path(str(resources.files("lexsplat"))) / "demo" / "encoders" / "clip"


@given(seed=st.integers(0, 2**32 - 1))
def test_a_phrase_made_for_a_label_is_true_of_it(seed):
    from words import TRUE, phrase_for

    rng = np.random.default_rng(seed)
    everything = labels()
    label = everything[int(rng.integers(len(everything)))]
    assert phrase_for(label, rng).of(label) == TRUE


@pytest.mark.parametrize(
    ("words", "wanted", "truth"),
    [
        ("red mug", {"kind": "mug", "color": "red"}, {"red mug": 1, "blue mug": 0, "red apple": 0}),
        ("mug handle", {"kind": "mug", "part": "handle"}, {"red mug": 0, "red mug handle": 1}),
        ("something red", {"color": "red"}, {"red apple": 1, "red apple stalk": -1, "blue mug": 0}),
        ("fruit", {"quality": "fruit"}, {"red apple": 1, "red apple stalk": 1, "orange pumpkin": 0}),
        ("metal", {"quality": "metal"}, {"gold ring": 1, "white candle saucer": 1, "white candle": 0}),
        ("yellow thing", {"color": "yellow"}, {"gold ring": -1}),
    ],
)  # fmt: skip
def test_phrases_are_true_false_or_open_for_each_label(words, wanted, truth):
    from words import Label, Phrase

    phrase = Phrase(words, **wanted)
    for thing, expected in truth.items():
        color, kind, *part = thing.split()
        assert phrase.of(Label(kind, color, part=part[0] if part else None)) == expected, thing


def test_words_of_things_that_no_scene_holds_are_true_of_nothing():
    from vocabulary import NAMES, UNKNOWN_TESTED, UNKNOWN_TRAINED
    from words import FALSE, Phrase

    assert not set(UNKNOWN_TESTED) & set(UNKNOWN_TRAINED)
    known = {name for names in NAMES.values() for name in names}
    assert not known & {*UNKNOWN_TESTED, *UNKNOWN_TRAINED}
    assert all(Phrase("zebra", unknown=True).of(label) == FALSE for label in labels())


def test_bundled_scenes_contain_no_held_out_pair():
    from layouts import LAYOUTS
    from vocabulary import HELD_OUT_PAIRS

    for layout in LAYOUTS.values():
        assert not HELD_OUT_PAIRS & {(place.kind, place.color) for place in layout.placements}


def test_the_scene_for_choosing_shares_no_thing_place_or_camera_with_the_demo():
    from layouts import SECOND, TABLETOP

    for what in (
        lambda scene: {(place.kind, place.color) for place in scene.placements},
        lambda scene: {(place.x, place.y) for place in scene.placements},
        lambda scene: {scene.cloth[0], scene.wall, scene.key_light, scene.seed},
        lambda scene: {pose.tobytes() for pose in scene.path.poses(scene.views)},
    ):
        assert not what(TABLETOP) & what(SECOND)
    # Words for one thing alone are of that scene alone; those of both mean other things in each.
    both = TABLETOP.prompts.keys() & SECOND.prompts.keys()
    assert all(TABLETOP.prompts[words].kind not in ("name", "color") for words in both)


@pytest.mark.parametrize("scene", ["tabletop", "second"])
def test_the_language_covers_every_prompt_of_the_scenes_that_ship(scene):
    from vocabulary import COLORS, NAMES, PARTS, QUALITIES

    single = {
        w
        for group in (NAMES, PARTS, COLORS)
        for names in group.values()
        for name in names
        for w in name.split()
    }
    qualities = {
        w for q in QUALITIES.values() for phrase in (*q.phrases, *q.adjectives) for w in phrase.split()
    }
    for prompt in json.loads((CAPTURES / scene / "prompts.json").read_text()):
        assert set(prompt.split()) <= single | qualities, prompt


@given(seed=st.integers(0, 2**32 - 1))
def test_no_training_phrase_names_a_held_out_pair(seed):
    # It could only be wrong, and would be learnt as the name of nothing.
    from vocabulary import HELD_OUT_PAIRS
    from words import any_phrase, near_miss

    rng = np.random.default_rng(seed)
    shown = [label for label in labels() if (label.kind, label.color) not in HELD_OUT_PAIRS]
    label = shown[int(rng.integers(len(shown)))]
    for phrase in (near_miss(label, rng), any_phrase(rng)):
        assert (phrase.kind, phrase.color) not in HELD_OUT_PAIRS, phrase


def test_a_made_up_word_is_none_that_means_something():
    from words import _KNOWN_WORDS, _made_up_word

    rng = np.random.default_rng(0)
    words = {_made_up_word(rng) for _ in range(500)}
    assert len(words) > 300
    assert not words & _KNOWN_WORDS
    assert {"metal", "paper", "fur", "wooden"} <= _KNOWN_WORDS, "the syllables can form some of these"


def test_rotated_hues_map_red_to_green_and_keep_gray():
    from clip_batches import turned_hues

    colors = np.array([[[200, 0, 0], [90, 90, 90], [0, 200, 0]]], np.uint8)
    turned = turned_hues(colors, 120.0).astype(int)
    assert np.abs(turned - [[[0, 200, 0], [90, 90, 90], [0, 0, 200]]]).max() <= 1


def test_rotated_hues_never_produce_a_held_out_pair():
    from clip_batches import fair_angle
    from words import Label

    rng = np.random.default_rng(0)
    # Held out: the blue bear, at 220 degrees; a red one starts at 0.
    angles = [fair_angle([Label("teddy", "red")], rng) for _ in range(300)]
    assert all(abs(angle - 220) >= 25 for angle in angles)
    assert max(angles) > 250
    assert min(angles) < 60


def test_the_composition_loss_of_additive_colors_is_zero():
    import torch
    from clip_losses import composition_loss

    kinds, colors = torch.randn(2, 8), torch.randn(2, 8)
    corners = torch.stack([kinds[k] + colors[c] for k in (0, 1) for c in (0, 1)])
    assert float(composition_loss(corners)) == pytest.approx(0, abs=1e-10)
    corners[3] += torch.eye(8)[0]
    assert float(composition_loss(corners)) == pytest.approx(1, abs=1e-5)


def small_training(**settings):
    from clip_settings import ClipTraining

    return ClipTraining(batch=12, width=64, layers=2, text_width=64, text_layers=1, dim=32, **settings)


def batch_of(config, seed=0):
    from clip_batches import make_batch
    from truth import TruthTable

    frames = frames_with_a_handle(scale=4)
    return make_batch(frames, TruthTable(frames.labels), config, np.random.default_rng(seed))


def trainer_of(config, start=None):
    from train_clip import Trainer
    from transformers import CLIPTokenizer

    return Trainer(CLIPTokenizer.from_pretrained(CLIP), config, start)


def test_labels_of_patches_follow_a_mirrored_crop():
    import torch
    from clip_batches import Batch, mirrored

    config = small_training(dense=1.0)
    # Each patch is of one brightness, which all that belongs to it repeats.
    marks = torch.arange(8 * 36).reshape(8, 36) % 100
    pixels = (
        marks.unflatten(1, (1, 6, 6)).expand(-1, 3, -1, -1).repeat_interleave(8, 2).repeat_interleave(8, 3)
    )
    batch = Batch(
        pixels=pixels.byte(),
        texts=[],
        corners=[],
        truth=torch.empty(8, 0),
        patches=marks[..., None].expand(-1, -1, 3),
        left_out=marks[..., None].expand(-1, -1, 22) % 2 == 1,
        places=marks[..., None].expand(-1, -1, 5).to(torch.int8),
    )
    seen, patches, left_out, places = mirrored(batch, config, torch.Generator().manual_seed(0))
    now = seen[:, 0, 4::8, 4::8].flatten(1)
    turned = (now != marks).any(1)
    assert turned.any()
    assert not turned.all()
    assert torch.equal(patches, now[..., None].expand(-1, -1, 3).long())
    assert torch.equal(left_out, now[..., None].expand(-1, -1, 22) % 2 == 1)
    assert torch.equal(places, now[..., None].expand(-1, -1, 5).to(torch.int8))


def test_only_the_last_phase_of_the_weights_that_ship_asks_patches():
    from clip_settings import PHASES, ClipTraining

    assert ClipTraining().dense == 0
    assert [name for name, config in PHASES.items() if config.dense] == ["dense"]
    config = small_training()
    batch = batch_of(config)
    assert batch.places.shape == (12, 36, 0)
    assert "dense" not in trainer_of(config).losses(batch)


def test_the_dense_loss_trains_the_image_tower_except_its_last_attention_weights():
    config = small_training(dense=1.0)
    trainer = trainer_of(config)
    trainer.losses(batch_of(config))["dense"].backward()
    tower = trainer.model.vision_model
    first, last = tower.encoder.layers[0].self_attn, tower.encoder.layers[-1].self_attn
    for module in (tower.embeddings.patch_embedding, first.q_proj, first.v_proj, last.v_proj, last.out_proj):
        assert module.weight.grad.abs().max() > 0
    assert trainer.model.text_model.embeddings.token_embedding.weight.grad.abs().max() > 0
    # A patch is read by its own value: neither queries nor keys of the last attention have a part in that.
    assert last.q_proj.weight.grad is None
    assert last.k_proj.weight.grad is None
    assert trainer.patch_heads.weight.grad is None


def test_the_dense_loss_ignores_open_patches_and_prefers_correct_answers():
    import torch
    from clip_losses import dense_loss
    from vocabulary import CANONICAL
    from words import FALSE, OPEN, TRUE

    axes = torch.eye(8)
    texts = torch.cat([axes[:2], axes[2].expand(len(CANONICAL), -1)])  # two phrases, all canonical ones equal
    places = torch.full((1, 3, 2), OPEN)
    places[0, 0], places[0, 1] = torch.tensor([TRUE, FALSE]), torch.tensor([FALSE, TRUE])

    def cost(*patches):
        return float(dense_loss(torch.stack(patches)[None], texts, places, torch.tensor(20.0), 10.0))

    right = cost(axes[0], 3 * axes[1], axes[4])
    assert right == cost(axes[0], axes[1], -axes[0]), "lengths and the third patch do not matter"
    assert right < 0.01 + 2 * np.log(2) < cost(axes[1], axes[0], axes[4])
    # By hand: contrast is as good as 0; relevancy is 10 for the right phrase, 0 for the wrong one.
    assert right == pytest.approx(np.log1p(np.exp(-10)) + np.log(2), abs=1e-6)


def test_training_and_encoder_compute_the_same_patch_embeddings(tmp_path, monkeypatch):
    import torch
    from clip_batches import MEAN, STD
    from train_clip import save

    from lexsplat.features import pretrained
    from lexsplat.features.clip import ClipEncoder

    monkeypatch.setattr(pretrained, "bfloat16_is_faster", lambda: False)
    trainer = trainer_of(small_training(seed=3))
    save(trainer, tmp_path)
    images = torch.rand(4, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    order = torch.randperm(36, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        whole, _, said = trainer.see((images - MEAN) / STD, order.expand(4, -1))
    wholes, patches = ClipEncoder(tmp_path, "made").encode_patches(images)
    unit = torch.nn.functional.normalize
    torch.testing.assert_close(unit(whole, dim=-1), wholes, atol=1e-5, rtol=0)
    torch.testing.assert_close(unit(said, dim=-1), patches.flatten(1, 2)[:, order], atol=1e-5, rtol=0)
    assert (patches.flatten(1, 2)[:, :1] - patches.flatten(1, 2)[:, 1:]).abs().amax(-1).min() > 1e-3, (
        "they differ"
    )


def test_the_model_may_see_between_two_steps_without_a_trace():
    import torch

    config = small_training(dense=1.0, gray=0.0, turned=0.0)
    batch = batch_of(config)

    def dense(before):
        trainer = trainer_of(config)
        with torch.no_grad():
            before(trainer.model)
        return trainer.losses(batch)["dense"].item()

    expected = dense(lambda model: None)
    images = torch.zeros(2, 3, 48, 48)
    assert dense(lambda model: model.get_image_features(pixel_values=images)) == expected
    trainer = trainer_of(config)
    trainer.losses(batch)
    assert not trainer.model.vision_model.encoder.layers[-1].layer_norm1._forward_hooks
