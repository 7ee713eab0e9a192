"""``lexsplat encoders``: encoders are checked and timed before a long build."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import pytest
import torch
from jsonschema import Draft202012Validator

from lexsplat import cli
from lexsplat.captures import load_capture
from lexsplat.features import checks
from lexsplat.features.encoders import load_clip, load_dino
from lexsplat.features.estimate import Estimate, count_crops, estimate
from lexsplat.features.settings import FeatureConfig
from lexsplat.runtime.errors import ModelError

pytestmark = pytest.mark.slow

SCHEMA = Path(__file__).parents[2] / "docs" / "schemas" / "encoders.json"


@pytest.fixture(autouse=True)
def one_measurement(monkeypatch):
    monkeypatch.setattr("lexsplat.features.estimate._SHORT", 0.0)


def test_the_answer_has_its_schema_and_the_time_of_the_capture(tiny_capture, capsys):
    words = ["encoders", "--clip", "bundled", "--dino", "bundled", "--capture", str(tiny_capture), "--json"]
    assert cli.main(words) == 0
    document = json.loads(capsys.readouterr().out)
    Draft202012Validator(json.loads(SCHEMA.read_text())).validate(document)
    assert document["clip"]["words_ranked"] > 0.9
    assert document["clip"]["dimensions"] == load_clip("bundled").dim
    photos = len(load_capture(tiny_capture).train_names)
    assert document["time"]["photos"] == photos < 12
    assert document["time"]["seconds"] == pytest.approx(photos * document["time"]["seconds_per_photo"])


@pytest.fixture
def towers(monkeypatch) -> dict[str, int]:
    """How often DINO is loaded, checked, and counted in a time."""
    from lexsplat.features import encoders, estimate

    counts = dict.fromkeys(("loaded", "checked", "counted"), 0)
    load, check, measure = encoders.load_dino, checks.check_dense, estimate.estimate

    def loaded(*arguments):
        counts["loaded"] += 1
        return load("bundled")  # for the default, which is not on this machine

    def checked(dino):
        counts["checked"] += 1
        check(dino)

    def counted(clip, dino, *arguments):
        counts["counted"] += dino is not None
        return measure(clip, dino, *arguments)

    monkeypatch.setattr(encoders, "load_dino", loaded)
    monkeypatch.setattr(checks, "check_dense", checked)
    monkeypatch.setattr(estimate, "estimate", counted)
    return counts


def at_class_tokens(monkeypatch) -> None:
    """The bundled CLIP is read at class tokens alone, as models of other architectures are."""
    settings = dataclasses.replace(FeatureConfig.bundled(), crop_tokens="class")
    monkeypatch.setattr(FeatureConfig, "bundled", lambda: settings)


def test_with_patch_tokens_the_default_dino_is_neither_loaded_nor_counted(towers):
    assert cli.main(["encoders", "--clip", "bundled"]) == 0
    assert towers == {"loaded": 0, "checked": 0, "counted": 0}


def test_with_class_tokens_the_default_dino_is_checked_and_counted(towers, monkeypatch, capsys):
    at_class_tokens(monkeypatch)
    assert cli.main(["encoders", "--clip", "bundled"]) == 0
    assert towers == {"loaded": 1, "checked": 1, "counted": 1}


def test_a_dino_that_the_build_leaves_out_is_checked_and_not_counted(towers, capsys):
    assert cli.main(["encoders", "--clip", "bundled", "--dino", "bundled", "--json"]) == 0
    assert towers == {"loaded": 1, "checked": 1, "counted": 0}
    assert "dino" in json.loads(capsys.readouterr().out)


def test_random_weights_are_refused_with_status_1(clip_folder, capsys):
    assert cli.main(["encoders", "--clip", str(clip_folder)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"error: model {clip_folder}: expected words that match the bundled images")
    assert "where chance is 0.50; choose another model" in error


def test_the_rank_of_words_is_that_of_a_loop(clip_folder):
    for name in ("bundled", str(clip_folder)):
        clip = load_clip(name)
        images, texts = (
            clip.encode_images(checks.bundled_images(clip.image_size)),
            clip.encode_text(checks.WORDS),
        )
        below = [
            float(images[i] @ texts[j]) < float(images[i] @ texts[i])
            for i in range(len(texts)) for j in range(len(texts)) if i != j
        ]  # fmt: skip
        assert checks.rank_words(clip) == pytest.approx(sum(below) / len(below), abs=0.01)


def test_towers_of_different_sizes_and_blind_towers_are_refused(monkeypatch):
    clip, dino = load_clip("bundled"), load_dino("bundled")
    monkeypatch.setattr(clip, "encode_images", lambda images: torch.eye(12, 64))
    with pytest.raises(ModelError, match="of one size, found 64 and 128 numbers"):
        checks.check_words(clip)
    monkeypatch.setattr(clip, "encode_images", lambda images: torch.full((12, 128), 128**-0.5))
    with pytest.raises(ModelError, match="different features for different images"):
        checks.check_words(clip)
    checks.check_dense(dino)
    monkeypatch.setattr(dino, "encode_dense", lambda image, **_: torch.full((12, 12, 128), 128**-0.5))
    with pytest.raises(ModelError, match="different features for different images"):
        checks.check_dense(dino)


def test_the_estimate_counts_the_crops_that_extraction_encodes(tiny_capture, tmp_path):
    from lexsplat.features import extract_features

    clip, config = load_clip("bundled"), FeatureConfig.suited()
    capture, encoded = load_capture(tiny_capture), []
    capture = dataclasses.replace(capture, views=dict(itertools.islice(capture.views.items(), 2)))
    inner = clip.encode_images
    clip.encode_images = lambda images: encoded.append(len(images)) or inner(images)
    extract_features(capture, clip, None, config, cache_dir=tmp_path)
    size = next(iter(capture.views.values())).capture_size
    assert sum(encoded) == len(capture.views) * count_crops(config, size)
    assert estimate(clip, None, config, size).crops == count_crops(config, size)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_estimate_is_of_as_many_photos_at_once_as_the_extraction_takes(threads, monkeypatch):
    clip, config, ticks, seen = load_clip("bundled"), FeatureConfig.suited(), itertools.count(), []
    inner = clip.encode_images
    monkeypatch.setattr(
        clip, "encode_images", lambda crops: seen.append(torch.get_num_threads()) or inner(crops)
    )
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = estimate(clip, None, config, (96, 72))
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1}, "each photo has one thread"
    assert found.seconds == pytest.approx(found.crops / 64 / threads), "64 crops took one tick"


def test_times_are_reported_in_their_unit():
    assert (
        Estimate(141, 12.3).describe(10)
        == "141 crops and about 12.3 s a photo; 2:03 min for 10 training photos"
    )
    assert (
        Estimate(1359, 90)
        .describe(100)
        .endswith("about 1.5 min a photo; 2:30:00 hours for 100 training photos")
    )
    assert Estimate(9, 0.04).describe(3).endswith("about 0.0 s a photo; 0.1 s for 3 training photos")
    assert Estimate(9, 1.44).describe(1).endswith("about 1.4 s a photo; 1.4 s for 1 training photo")
