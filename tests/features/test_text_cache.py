"""Embeddings of texts are kept: each is encoded once, whatever folder, order or model."""

from __future__ import annotations

import json

import pytest
import torch
from support.counting_encoders import ColorEncoder

from lexsplat.features import TextCache, text
from lexsplat.runtime.files import read_tensors, write_tensors


def test_a_prompt_is_encoded_once_and_cached_on_disk(tmp_path):
    encoder = ColorEncoder()
    cache = TextCache(tmp_path)
    prompts = ["red apple", 'äpfel\n"quoted"', "red apple", "__metadata__"]
    found = cache.encode("color", prompts, lambda: encoder)
    assert encoder.texts == 3
    torch.testing.assert_close(found, ColorEncoder().encode_text(prompts))

    def never():
        raise AssertionError("the encoder is not needed")

    torch.testing.assert_close(TextCache(tmp_path).encode("color", prompts, never), found)
    more = TextCache(tmp_path).encode("color", ["new", "red apple"], lambda: encoder)
    assert encoder.texts == 4
    torch.testing.assert_close(more[1], found[0])
    torch.testing.assert_close(TextCache(tmp_path).encode("color", prompts, never), found)


def test_the_file_of_a_scene_does_not_depend_on_what_the_users_cache_knew(tmp_path):
    TextCache(tmp_path / "user").encode("color", ["blue vase"], ColorEncoder)
    for scene, user in (("a", "user"), ("b", "empty")):
        cache = TextCache(tmp_path / scene, tmp_path / user)
        cache.encode("color", ["red apple", "blue vase", "green box"], ColorEncoder)
    one, other = (next((tmp_path / scene).iterdir()).read_bytes() for scene in "ab")
    assert one == other


def test_texts_are_encoded_one_by_one_and_the_cache_is_written_once(tmp_path, monkeypatch):
    """In a batch, the last bits of an embedding depend on the other texts."""
    batches, written = [], []

    class Watched(ColorEncoder):
        def encode_text(self, prompts):
            batches.append(list(prompts))
            return super().encode_text(prompts)

    from lexsplat.features import text

    def write(path, tensors, metadata, lasting):
        assert not lasting, "a cache may be lost with the power"
        written.append(len(tensors["embeddings"]))

    monkeypatch.setattr(text, "write_tensors", write)
    TextCache(tmp_path).encode("color", ["apple", "pear", "apple"], Watched)
    assert batches == [["apple"], ["pear"]]
    assert written == [2]


def test_a_cache_that_cannot_be_written_is_reported_and_the_embedding_returned(tmp_path, caplog):
    in_the_way = tmp_path / "texts"
    in_the_way.write_text("no folder")
    found = TextCache(in_the_way).encode("color", ["apple"], ColorEncoder)
    assert found.shape == (1, 4)
    assert "not cached" in caplog.text


def test_a_truncated_prompt_is_reported(caplog):
    from lexsplat.features.encoders import load_clip

    clip = load_clip("bundled")
    clip.encode_text(["something that one could drink from"])
    assert not caplog.records
    clip.encode_text(["a very " * 200 + "red apple"])
    assert "prompt truncated: 804 tokens, the model's limit is 24" in caplog.text


def test_text_of_another_model_is_never_used(tmp_path):
    TextCache(tmp_path).encode("color", ["apple"], ColorEncoder)
    other = ColorEncoder("other")
    TextCache(tmp_path).encode("other", ["apple"], lambda: other)
    assert other.texts == 1
    with pytest.raises(ValueError, match="not the model"):
        TextCache(tmp_path).encode("third", ["apple"], ColorEncoder)


def test_words_are_shared_by_folders_and_a_read_only_one_is_never_written(tmp_path, monkeypatch):
    def never():
        raise AssertionError("the encoder is not needed")

    shipped, user, scene = tmp_path / "shipped", tmp_path / "user", tmp_path / "scene"
    TextCache(shipped).encode("color", ["red apple"], ColorEncoder)
    before = {path: path.read_bytes() for path in shipped.iterdir()}
    first = TextCache(user, read_only=shipped).encode("color", ["red apple", "pear"], ColorEncoder)
    assert {path: path.read_bytes() for path in shipped.iterdir()} == before
    again = TextCache(user).encode("color", ["red apple", "pear"], never)
    assert torch.equal(first, again)
    # Another scene of the same encoder needs none either, and carries what it was asked.
    TextCache(scene, user).encode("color", ["pear"], never)
    TextCache(scene).encode("color", ["pear"], never)
    with pytest.raises(AssertionError, match="not needed"):
        TextCache(scene).encode("color", ["red apple"], never)


def test_a_text_cache_is_bounded_and_forgets_what_came_first(tmp_path, monkeypatch):
    monkeypatch.setattr("lexsplat.features.text._MAX_STORED", 3)
    for word in ("a", "b", "c", "d", "x" * 2000):
        TextCache(tmp_path).encode("color", [word], ColorEncoder)
    counter = ColorEncoder()
    TextCache(tmp_path).encode("color", ["b", "c", "d"], lambda: counter)
    assert counter.texts == 0
    TextCache(tmp_path).encode("color", ["a"], lambda: counter)
    assert counter.texts == 1


def test_vectors_of_another_size_in_a_cache_are_not_mixed_with_the_models(tmp_path):
    write_tensors(
        tmp_path / "text-color.safetensors", {"embeddings": torch.ones(1, 9)}, {"texts": '["pear"]'}
    )
    found = TextCache(tmp_path).encode("color", ["apple", "pear"], ColorEncoder)
    torch.testing.assert_close(found, ColorEncoder().encode_text(["apple", "pear"]))
    torch.testing.assert_close(TextCache(tmp_path).encode("color", ["pear"], ColorEncoder), found[1:])


def test_a_damaged_text_cache_is_replaced_and_empty_prompts_are_refused(tmp_path):
    TextCache(tmp_path).encode("color", ["apple"], ColorEncoder)
    (file,) = tmp_path.iterdir()
    file.write_bytes(b"nonsense")
    assert TextCache(tmp_path).encode("color", ["apple"], ColorEncoder).shape == (1, 4)
    for prompts in ([], [" "]):
        with pytest.raises(ValueError, match="not empty"):
            TextCache(tmp_path).encode("color", prompts, ColorEncoder)


def test_texts_that_follow_at_once_are_written_together_when_the_cache_is_let_go(tmp_path, monkeypatch):
    writes = []
    write = text.write_tensors
    monkeypatch.setattr(
        text, "write_tensors", lambda *given, **more: (writes.append(given), write(*given, **more))
    )
    cache = TextCache(tmp_path)
    for word in ("a", "b", "c"):
        cache.encode("color", [word], ColorEncoder)
    assert len(writes) == 1
    counter = ColorEncoder()
    TextCache(tmp_path).encode("color", ["b"], lambda: counter)
    assert counter.texts == 0, "another cache of the process knows what waits"
    del cache
    assert len(writes) == 2
    TextCache(tmp_path).encode("color", ["a", "b", "c"], lambda: counter)
    assert counter.texts == 0, "all is on the disk"


def test_texts_that_another_thread_adds_while_the_file_is_written_do_not_spoil_it(tmp_path, monkeypatch):
    cache, stack, added = TextCache(tmp_path), torch.stack, []

    def slow_stack(vectors):
        stacked = stack(vectors)
        with monkeypatch.context() as patch:  # the moment at which the other thread asks
            patch.setattr(torch, "stack", stack)
            added.append(f"pear {len(added)}")
            cache.encode("color", [added[-1]], ColorEncoder)
        return stacked

    monkeypatch.setattr(torch, "stack", slow_stack)
    cache.encode("color", ["apple", "red apple"], ColorEncoder)
    assert added
    tensors, facts = read_tensors(tmp_path / "text-color.safetensors")
    texts = json.loads(facts["texts"])
    assert {"apple", "red apple"} <= set(texts)
    torch.testing.assert_close(tensors["embeddings"], ColorEncoder().encode_text(texts))
