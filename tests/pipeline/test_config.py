"""Settings of a build: sizes as text, and what is chosen for open settings."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureConfig
from lexsplat.language.methods.averaged import AveragedConfig
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.pipeline.config import BLOCKS_ITERATIONS, CPU_ITERATIONS, CPU_PIXELS, BuildConfig
from lexsplat.reconstruction import ReconstructionConfig
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.errors import BackendError
from lexsplat.runtime.memory import parse_bytes


@pytest.mark.parametrize(
    ("text", "count"),
    [("4GB", 4 << 30), ("512 MiB", 512 << 20), ("1.5g", 3 << 29), ("1000", 1000), ("2tb", 2 << 40)],
)
def test_sizes_are_read_with_their_units(text, count):
    assert parse_bytes(text) == count


@pytest.mark.parametrize("text", ["", "0", "GB", "-1GB", "4 GBs", "1e9", "lots"])
def test_invalid_sizes_are_refused(text):
    with pytest.raises(ValueError, match="like 4GB"):
        parse_bytes(text)


@given(width=st.integers(1, 20_000), height=st.integers(1, 20_000))
def test_photos_are_never_enlarged_and_suit_the_device(width, height):
    resolved = BuildConfig(clip="bundled").resolved("cpu", (width, height))
    assert resolved.downscale >= 1
    pixels = width * height / resolved.downscale**2
    assert pixels <= CPU_PIXELS * 1.8  # factors are whole halves


def test_given_settings_are_kept():
    config = BuildConfig(downscale=3.0, iterations=77, features=FeatureConfig(map_cells=9))
    resolved = config.resolved("cpu", (4000, 3000))
    assert (resolved.downscale, resolved.iterations, resolved.reconstruction.iterations) == (3.0, 77, 77)
    assert resolved.features.map_cells == 9


def test_the_number_of_steps_suits_the_device():
    assert BuildConfig().resolved("cpu", (10, 10)).reconstruction.iterations == CPU_ITERATIONS
    assert BuildConfig(blocks="4").resolved("cpu", (10, 10)).reconstruction.iterations == BLOCKS_ITERATIONS
    assert BuildConfig().resolved("cuda", (10, 10)).reconstruction.iterations == 30_000


def test_features_suit_the_encoder_and_the_device():
    bundled = BuildConfig(clip="bundled").resolved("cpu", (10, 10))
    assert bundled.features == FeatureConfig.bundled()
    assert BuildConfig().resolved("cuda", (10, 10)).features == FeatureConfig()


def _folder_of(path, kind, **vision):
    path.mkdir()
    (path / "config.json").write_text(json.dumps({"model_type": kind, "vision_config": vision}))
    return str(path)


def test_features_suit_the_patches_of_the_encoder(tmp_path):
    def features(clip, device="cpu", **changes):
        config = BuildConfig(clip=clip, features=FeatureConfig(**changes))
        resolved = config.resolved(device, (10, 10))
        assert device == "cuda" or resolved.resolved(device, (10, 10)) == resolved
        return resolved.features

    base = _folder_of(
        tmp_path / "b16", "clip", patch_size=16
    )  # transformers leaves out the default of 224 pixels
    assert features(base).crop_sizes == pytest.approx((0.36,))
    assert features(base).tokens == "both"
    assert features(base, "cuda") == replace(features(base), dino_stride=FeatureConfig.dino_stride)
    assert features(base, "cuda", crop_tokens="class") == FeatureConfig(crop_tokens="class")
    small = features(_folder_of(tmp_path / "b32", "clip", image_size=224, patch_size=32))
    assert small.crop_sizes == pytest.approx((0.18,)), "a patch covers as much of the photo as with B/16"
    large = features(_folder_of(tmp_path / "l336", "clip", image_size=336, patch_size=14))
    assert large.crop_sizes == (0.5,)
    other = features(_folder_of(tmp_path / "siglip", "siglip", image_size=224, patch_size=16))
    assert other == FeatureConfig.suited()
    assert other.tokens == "class"
    assert features(str(tmp_path / "siglip"), "cuda") == FeatureConfig()
    assert features(base, crop_tokens="class") == replace(FeatureConfig.suited(), crop_tokens="class")
    assert features(base, mode="random") == replace(FeatureConfig.suited(), mode="random")
    assert features(str(tmp_path / "nothing")) == FeatureConfig.suited()


@pytest.mark.parametrize(("clip", "suited"), [("bundled", "bundled"), ("some/clip", "suited")])
def test_one_given_feature_setting_leaves_the_others_as_they_suit(clip, suited):
    suited = getattr(FeatureConfig, suited)()
    random = {"mode": "random", "crop_tokens": None}  # random crops have no patch tokens
    for change in ({"dino_facet": "token"}, random, {"map_cells": 9}, {"seed": 3}, {"crop_tokens": "class"}):
        config = BuildConfig(clip=clip, features=FeatureConfig(**change)).resolved("cpu", (10, 10))
        assert config.features == replace(suited, **change)
        assert config.resolved("cpu", (10, 10)) == config
    sizes = (0.1,) * len(FeatureConfig().crop_sizes)  # with the default strides
    config = BuildConfig(clip=clip, features=FeatureConfig(crop_sizes=sizes)).resolved("cpu", (10, 10))
    strides = FeatureConfig().crop_strides
    assert config.features == replace(suited, crop_sizes=sizes, crop_strides=strides)


def test_iterations_of_the_reconstruction_settings_are_taken():
    given = BuildConfig(reconstruction=ReconstructionConfig(iterations=50))
    assert given.resolved("cpu", (10, 10)).reconstruction.iterations == 50
    both = replace(given, iterations=60)
    assert both.resolved("cpu", (10, 10)).reconstruction.iterations == 60


def test_result_settings_ignore_everything_that_does_not_affect_the_result():
    config = BuildConfig()
    idle = [
        replace(config, memory="1GB"),
        replace(config, checkpoint_seconds=1.0),
        replace(config, features=FeatureConfig(random_crops=9)),
        replace(config, trained=TrainedConfig(iterations=9)),
        replace(config, features=FeatureConfig(dino_stride=9)),
        replace(config, features=FeatureConfig(crop_tokens="class")),
    ]
    assert all(other.result_settings() == config.result_settings() for other in idle)
    touched = [
        replace(config, features=FeatureConfig(map_cells=9)),
        replace(config, features=FeatureConfig(crop_tokens="both")),
        replace(config, features=FeatureConfig(mode="random")),
        replace(config, averaged=AveragedConfig(top=3)),
        replace(config, method="trained"),
    ]
    assert all(other.result_settings() != config.result_settings() for other in touched)


def test_result_settings_keep_the_features_that_take_part():
    random = BuildConfig(features=FeatureConfig(mode="random", random_crops=9))
    other = replace(random, features=FeatureConfig(mode="random"))
    assert random.result_settings() != other.result_settings()
    trained = BuildConfig(method="trained")
    coarse = replace(trained, features=FeatureConfig(dino_stride=9))
    assert coarse.result_settings() != trained.result_settings(), (
        "the codebook is fitted to DINO features too"
    )
    without = replace(trained, dino="none")
    coarse = replace(without, features=FeatureConfig(dino_stride=9))
    assert coarse.result_settings() == without.result_settings()


def test_dino_is_loaded_where_it_takes_part():
    assert not BuildConfig().uses_dino
    assert BuildConfig(method="trained").uses_dino
    asked = BuildConfig(averaged=AveragedConfig(dino=True))
    assert asked.uses_dino
    assert not replace(asked, dino="none").uses_dino


def test_averaging_takes_dino_for_class_tokens_and_not_for_patches():
    def used(**settings: object) -> bool:
        return BuildConfig(**settings).resolved("cpu", (10, 10)).uses_dino  # type: ignore[arg-type]

    classes = FeatureConfig(crop_tokens="class")
    assert not used(clip="bundled"), "the bundled encoder is read at its patches, too"
    assert used(clip="bundled", features=classes)
    assert used(clip="bundled", features=FeatureConfig(mode="random")), "random crops have no patches"
    assert used(clip="bundled", averaged=AveragedConfig(dino=True))
    assert not used(clip="bundled", features=classes, averaged=AveragedConfig(dino=False))
    assert not used(clip="bundled", features=classes, dino="none")
    assert not used(clip="bundled", features=classes, features_from=Path("features"))
    assert used(clip="some/siglip"), "no patches are known of it"


def test_result_settings_keep_those_of_the_chosen_method_only():
    trained = BuildConfig(method="trained")
    assert replace(trained, averaged=AveragedConfig(top=3)).result_settings() == trained.result_settings()
    longer = replace(trained, trained=TrainedConfig(iterations=9))
    assert longer.result_settings() != trained.result_settings()


def test_as_in_paper_stands_for_the_settings_of_the_paper_and_keeps_those_that_are_given():
    paper = BuildConfig(as_in_paper=True, dino="none").spelled_out()
    assert paper.spelled_out() == paper
    assert (paper.method, paper.joint, paper.iterations) == ("trained", True, 30_000)
    assert (paper.codebook.num_codes, paper.codebook.init, paper.features.mode) == (128, "uniform", "random")
    assert (paper.trained.iterations, paper.trained.pixel_sample) == (30_000, 0)
    assert not paper.reconstruction.antialiased, "the rasterization of 3DGS has no mip filter"
    resolved = replace(paper, clip="bundled").resolved("cpu", (800, 600))
    assert (resolved.iterations, resolved.features.tokens) == (30_000, "class")
    codebook, trained = CodebookConfig(num_codes=64), TrainedConfig(iterations=9)
    short = BuildConfig(as_in_paper=True, iterations=50, codebook=codebook, trained=trained).spelled_out()
    assert (short.iterations, short.codebook.num_codes, short.trained.iterations) == (50, 64, 9)
    codebook, trained = (
        CodebookConfig(learning_rate=0.3, steps=7),
        TrainedConfig(semantics_lr=0.2, pixel_sample=5),
    )
    kept = BuildConfig(as_in_paper=True, codebook=codebook, trained=trained).spelled_out()
    assert (kept.codebook.learning_rate, kept.codebook.steps, kept.codebook.batch_size) == (0.3, 7, 16_384)
    assert (kept.trained.semantics_lr, kept.trained.pixel_sample, kept.trained.decoder_lr) == (0.2, 5, 0.001)
    with pytest.raises(ValueError, match="random crops have no patches"):
        BuildConfig(as_in_paper=True, features=FeatureConfig(crop_tokens="both"))
    with pytest.raises(ValueError, match="leave --blocks out"):
        BuildConfig(as_in_paper=True, blocks="2")
    assert BuildConfig().spelled_out() == BuildConfig()


def test_unknown_methods_and_impossible_joint_training_are_refused():
    with pytest.raises(ValueError, match="averaged, trained"):
        BuildConfig(method="lifted")
    with pytest.raises(ValueError, match="needs method trained, got 'averaged'"):
        BuildConfig(joint=True)


def test_resolving_twice_changes_nothing():
    once = BuildConfig(clip="bundled").resolved("cpu", (800, 600))
    assert once.resolved("cpu", (800, 600)) == once
    assert replace(once, seed=1) != once


def test_a_missing_cuda_device_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == "cpu"
    with pytest.raises(BackendError, match="use --device cpu"):
        choose_device("cuda")
