"""The encoders of a build: loaded when used, once, and looked for before the work begins."""

import dataclasses
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from support.color_encoder import ColorClip
from support.experiments import CONFIG

from lexsplat.captures import load_capture
from lexsplat.features import FeatureConfig
from lexsplat.features.estimate import Estimate
from lexsplat.features.hub import content_hash, model_folder
from lexsplat.pipeline import encoding
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders, check_encoders, feature_maps
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.scene import open_scene


def test_an_encoder_is_loaded_when_it_is_first_used_and_only_then(monkeypatch):
    loaded = []
    for kind in ("clip", "dino"):
        monkeypatch.setattr(
            f"lexsplat.features.encoders.load_{kind}", lambda *given: loaded.append(given) or object()
        )
    encoders = Encoders("a", "b", "cpu")
    assert loaded == []
    assert encoders.dino is encoders.dino
    assert encoders.clip is encoders.clip
    assert loaded == [("b", "cpu"), ("a", "cpu")]
    assert Encoders("a", "none", "cpu").dino is None
    assert len(loaded) == 2


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({"clip": "./absent"}, True),
        ({"dino": "./absent", "method": "trained"}, True),
        ({"dino": "./absent", "method": "averaged"}, False),
        ({"dino": "./absent", "method": "trained", "features_from": Path("elsewhere")}, False),
    ],
    ids=["clip", "dino", "dino that takes no part", "dino beside given features"],
)
def test_only_encoders_that_take_part_are_looked_for(changes, missing):
    config = BuildConfig(**{"clip": "bundled", "dino": "bundled", "encoder_device": "cpu", **changes})
    if not missing:
        check_encoders(config)
        return
    with pytest.raises(ModelError, match="absent"):
        check_encoders(config)


def test_encoders_may_be_on_a_gpu_beside_a_rasterizer_on_the_cpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    loaded = []
    for kind in ("clip", "dino"):
        monkeypatch.setattr(f"lexsplat.features.encoders.load_{kind}", lambda *given: loaded.append(given[1]))
    config = BuildConfig(clip="a", dino="b", device="cpu", encoder_device="cuda", method="trained")
    config = config.resolved("cpu", (96, 72))
    encoders = Encoders.of(config)
    assert (encoders.clip, encoders.dino) == (None, None)
    assert loaded == ["cuda", "cuda"]
    assert (
        config.features.tokens == BuildConfig(clip="a", dino="b").resolved("cuda", (96, 72)).features.tokens
    )


@pytest.mark.slow
def test_a_family_of_encoders_in_model_folders_needs_its_loader_alone(tiny_capture, tmp_path, monkeypatch):
    folder = tmp_path / "toy"
    folder.mkdir()
    for name, content in (("config.json", '{"model_type": "toy"}'), ("tokenizer.json", "{}")):
        (folder / name).write_text(content)
    save_file({"weight": torch.zeros(1)}, folder / "model.safetensors")

    def load(name, *_):
        toy = ColorClip()
        toy.content_hash = content_hash(model_folder(name, "clip"), "clip")
        return toy

    monkeypatch.setattr("lexsplat.features.encoders.load_clip", load)
    config = replace(CONFIG, clip=str(folder), dino="none", method="averaged", iterations=4)
    build(tiny_capture, tmp_path / "scene", config)
    moved = shutil.copytree(folder, tmp_path / "moved")
    scene = open_scene(tmp_path / "scene", device="cpu", clip=str(moved))
    assert scene.embed("red apple").tolist() == ColorClip().encode_text(["red apple"]).tolist()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_features_of_encoders_on_a_gpu_are_those_of_the_cpu(tiny_capture, tmp_path):
    capture, maps = load_capture(tiny_capture), {}
    small = FeatureConfig(crop_sizes=(0.5,), crop_strides=(0.5,), map_cells=8, max_short_side=24)
    for device in ("cpu", "cuda"):
        config = BuildConfig(encoder_device=device, clip="bundled", dino="bundled", features=small)
        config = config.resolved("cpu", (96, 72))
        maps[device] = feature_maps(capture, config, Encoders.of(config), tmp_path / device)
    for name, expected in maps["cpu"].items():
        assert (expected.clip * maps["cuda"][name].clip).sum(-1).min() > 0.999


@pytest.mark.slow
def test_the_time_of_the_features_is_told_once_if_no_check_has_told_it(
    tiny_capture, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(encoding, "_TOLD_FROM", 1)
    monkeypatch.setattr(encoding, "estimate", lambda *_: Estimate(7, 1.0))
    capture = load_capture(tiny_capture)
    small = FeatureConfig(crop_sizes=(0.5,), crop_strides=(0.5,), map_cells=8, max_short_side=24)
    config = BuildConfig(clip="bundled", dino="none", features=small).resolved("cpu", (96, 72))
    told = f"for {len(capture.views)} training photos"
    for expected in (1, 0):  # then the features are cached
        caplog.clear()
        with caplog.at_level(NOTE, logger="lexsplat"):
            feature_maps(capture, config, Encoders.of(config), tmp_path)
        assert sum(told in message for message in caplog.messages) == expected


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "expected"), [(1.9, 0), (2.0, 1)])
def test_a_forecast_of_less_than_two_seconds_is_left_out(
    clip_folder, tmp_path, monkeypatch, caplog, seconds, expected
):
    monkeypatch.setattr(encoding, "estimate", lambda *_: Estimate(7, seconds / 3))
    config = BuildConfig(clip=str(clip_folder), dino="none").resolved("cpu", (96, 72))
    with caplog.at_level(NOTE, logger="lexsplat"):
        encoders = check_encoders(config, tmp_path, 3)
    assert (
        sum("at most" in message and "for 3 training photos" in message for message in caplog.messages)
        == expected
    )
    assert encoders.told, "the extraction does not measure it again"


@pytest.mark.slow
def test_the_time_is_told_again_when_fewer_photos_are_chosen(tiny_capture, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(encoding, "estimate", lambda *_: pytest.fail("it is measured"))
    capture = load_capture(tiny_capture)
    small = FeatureConfig(crop_sizes=(0.5,), crop_strides=(0.5,), map_cells=8, max_short_side=24)
    config = BuildConfig(clip="bundled", dino="none", features=small).resolved("cpu", (96, 72))
    encoders = Encoders.of(config)
    encoders.estimate, encoders.told = Estimate(7, 2.0), 100
    few = dataclasses.replace(
        capture, views=dict(list(capture.views.items())[:2]), train_names=(), test_names=()
    )
    with caplog.at_level(NOTE, logger="lexsplat"):
        feature_maps(few, config, encoders, tmp_path)
    assert [message.split("; ")[1] for message in caplog.messages] == ["0:04 min for 2 training photos"]
