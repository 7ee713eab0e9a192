"""What the viewer keeps of a scene between visits."""

import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.viewer.history import MAX_PHRASES, MAX_PROMPTS, History, clean_phrases


def test_the_history_is_stored_with_the_latest_prompt_first(tmp_path):
    history = History.load(tmp_path)
    assert history.vocabulary == default_vocabulary()
    for phrase in ("mug", "red apple", "mug"):
        history.add(phrase)
    history.set_vocabulary([" pear ", "", "Pear", "plum"])
    again = History.load(tmp_path)
    assert again.prompts == ["mug", "red apple"]
    assert again.vocabulary == ["pear", "plum"]
    again.set_vocabulary([])
    assert History.load(tmp_path).vocabulary == default_vocabulary()
    again.prompts = [f"thing {number}" for number in range(2 * MAX_PROMPTS)]
    again.add("the last")
    assert History.load(tmp_path).prompts == ["the last", *(f"thing {n}" for n in range(MAX_PROMPTS - 1))]


def test_files_of_earlier_versions_are_read_and_rewritten_unchanged(tmp_path):
    content = {"history": ["mug", "red apple"], "vocabulary": ["pear", "plum"]}
    (tmp_path / "viewer.json").write_text(json.dumps(content))
    history = History.load(tmp_path)
    assert history.prompts == content["history"]
    assert history.vocabulary == content["vocabulary"]
    history.add("mug")
    assert json.loads((tmp_path / "viewer.json").read_text()) == content


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"history": 3}', '{"history": [1]}', '{"vocabulary": null}']
)
def test_a_damaged_history_is_reported_and_ignored(tmp_path, content, caplog):
    (tmp_path / "viewer.json").write_text(content)
    history = History.load(tmp_path)
    assert history.prompts == []
    assert history.vocabulary == default_vocabulary()
    assert "viewer.json" in caplog.text
    history.add("mug")
    assert json.loads((tmp_path / "viewer.json").read_text())["history"] == ["mug"]


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_nothing_is_written_to_a_read_only_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    history = History.load(tmp_path)
    history.add("mug")
    assert history.prompts == ["mug"]
    assert list(tmp_path.iterdir()) == []


def test_scenes_of_the_bundled_encoder_start_with_its_own_vocabulary(tmp_path):
    known = History.load(tmp_path, "bundled").vocabulary
    assert {"teddy bear", "rubber duck", "traffic cone"} <= set(known)
    assert len(known) == 22
    History.load(tmp_path, "bundled").add("duck")  # does not store the default vocabulary
    assert History.load(tmp_path, "openai/clip-vit-base-patch16").vocabulary == default_vocabulary()


@given(st.lists(st.text(max_size=12) | st.just("long " * 60), max_size=8))
def test_cleaning_phrases_is_idempotent_and_removes_duplicates(phrases):
    cleaned = clean_phrases(phrases)
    assert len(cleaned) <= MAX_PHRASES
    assert all(phrase and phrase == " ".join(phrase.split()) and len(phrase) <= 120 for phrase in cleaned)
    assert len({phrase.lower() for phrase in cleaned}) == len(cleaned)
    assert clean_phrases(cleaned) == cleaned
