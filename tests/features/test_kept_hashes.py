"""Hashes of models are kept: a question need not read a gigabyte to know its encoder."""

from __future__ import annotations

import json
import os
import shutil
import time

import pytest

from lexsplat.features import hub
from lexsplat.features.hub import content_hash
from lexsplat.features.same_encoder import check_encoder, under_hash_of_features
from lexsplat.features.text import TextCache, load_text
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.user_cache import user_cache


@pytest.fixture
def model(clip_folder, tmp_path, monkeypatch):
    """A copy of the tiny CLIP, a minute old, whose hash is worth keeping; the cache is this test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(hub, "KEPT_FROM", 1)
    folder = shutil.copytree(clip_folder, tmp_path / "copy")
    age(folder, 60)
    return folder


def age(folder, seconds: float) -> None:
    for path in folder.iterdir():
        os.utime(path, (time.time() - seconds,) * 2)


def kept() -> list:
    folder = user_cache() / "hashes"
    return list(folder.iterdir()) if folder.exists() else []


@pytest.fixture
def forget(monkeypatch):
    """Forgets the hashes that the process knows, as a new process does not know them."""
    return lambda: monkeypatch.setattr(hub, "_hashes", {})


def test_a_kept_hash_is_the_hash_and_the_weights_are_not_read_again(model, clip_folder, monkeypatch, forget):
    first = hub.content_hash(model, "clip")
    forget()
    monkeypatch.setattr(hub, "KEPT_FROM", 1 << 60)
    assert first == hub.content_hash(clip_folder, "clip")
    monkeypatch.setattr(hub, "KEPT_FROM", 1)
    assert len(kept()) == 1
    monkeypatch.setattr(hub, "blocks", lambda path: pytest.fail("the files are read again"))
    assert hub.content_hash(model, "clip") == first


def test_a_process_reads_a_small_model_once_and_again_when_it_is_changed(model, monkeypatch):
    monkeypatch.setattr(hub, "KEPT_FROM", 1 << 26)
    reads, read = [], hub.blocks
    monkeypatch.setattr(hub, "blocks", lambda path: reads.append(path) or read(path))
    first = hub.content_hash(model, "clip")
    once = len(reads)
    assert (hub.content_hash(model, "clip"), len(reads)) == (first, once)
    with (model / "config.json").open("a") as file:
        file.write(" ")
    assert hub.content_hash(model, "clip") != first
    assert len(reads) == 2 * once
    assert not kept()


@pytest.mark.skipif(
    os.name == "nt", reason="the system keeps no time of the last change beside that of writing"
)
def test_a_changed_file_has_a_hash_of_its_own_even_where_its_size_and_time_are_set_back(model):
    first = hub.content_hash(model, "clip")
    path = model / "model.safetensors"
    before, weights = path.stat(), bytearray(path.read_bytes())
    weights[-1] ^= 1
    path.write_bytes(weights)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert hub.content_hash(model, "clip") != first


def test_links_to_the_same_files_under_other_names_have_a_hash_of_their_own(model, tmp_path):
    """As in the cache of the Hugging Face Hub, whose snapshots are links to files named by their content."""
    folders = []
    for number, target in enumerate(("tokenizer_config.json", "special_tokens_map.json")):
        folder = tmp_path / f"links_{number}"
        folder.mkdir()
        for path in model.iterdir():
            if path.name not in ("tokenizer_config.json", "special_tokens_map.json"):
                (folder / path.name).symlink_to(path)
        (model / "blob").write_text("{}")
        (folder / target).symlink_to(model / "blob")
        folders.append(folder)
    age(model, 60)
    kept_hashes = [hub.content_hash(folder, "clip") for folder in folders]
    assert kept_hashes[0] != kept_hashes[1]
    assert len(kept()) == 2


def test_hashes_of_fresh_files_and_of_small_models_are_not_kept(model, monkeypatch):
    age(model, 0)
    hub.content_hash(model, "clip")
    assert not kept()
    age(model, 60)
    monkeypatch.setattr(hub, "KEPT_FROM", 1 << 26)
    hub.content_hash(model, "clip")
    assert not kept()


@pytest.mark.parametrize("damage", [b"", b"\xff\xfe", b"0" * 31, b"../" * 10])
def test_a_damaged_kept_hash_is_computed_again(model, damage, forget):
    first = hub.content_hash(model, "clip")
    forget()
    (path,) = kept()
    path.write_bytes(damage)
    assert hub.content_hash(model, "clip") == first
    assert path.read_text() == first


def test_a_cache_that_cannot_be_written_does_no_harm(model, tmp_path, forget):
    (tmp_path / "cache").write_text("a file where the folder should be")
    first = hub.content_hash(model, "clip")
    forget()
    assert hub.content_hash(model, "clip") == first


@pytest.mark.slow
def test_settings_of_a_tokenizer_that_come_after_the_features_make_no_other_encoder(clip_folder, tmp_path):
    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    for name in ("tokenizer_config.json", "special_tokens_map.json"):
        (folder / name).unlink(missing_ok=True)
    built_with = content_hash(folder, "clip")
    (folder / "special_tokens_map.json").write_text("{}")
    assert content_hash(folder, "clip") != built_with
    check_encoder(str(folder), content_hash(folder, "clip"), built_with)
    with open(folder / "tokenizer.json", "a") as file:
        file.write(" ")
    with pytest.raises(ModelError, match="another one"):
        check_encoder(str(folder), content_hash(folder, "clip"), built_with)


@pytest.mark.slow
def test_a_second_file_of_settings_makes_no_other_encoder_and_new_words_are_answered(clip_folder, tmp_path):
    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    assert (folder / "tokenizer_config.json").is_file(), "the first one"
    built_with = content_hash(folder, "clip")
    for name in ("special_tokens_map.json", "added_tokens.json"):
        (folder / name).write_text("{}")
        check_encoder(str(folder), content_hash(folder, "clip"), built_with)
    tower = load_text(str(folder))
    answering = under_hash_of_features(str(folder), tower, built_with)
    found = TextCache(tmp_path / "texts").encode(built_with, ["a word"], lambda: answering)
    assert found.tolist() == tower.encode_text(["a word"]).tolist()
    assert tower.content_hash != built_with, "the tower itself may serve another scene"
    settings = json.loads((folder / "tokenizer_config.json").read_text())
    (folder / "tokenizer_config.json").write_text(json.dumps(settings | {"unk_token": "a"}))
    with pytest.raises(ModelError, match="another one"):
        under_hash_of_features(str(folder), load_text(str(folder)), built_with)
