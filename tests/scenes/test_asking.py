"""Plurals, compound words and phrases without grammar, asked of the bundled scene and of libraries."""

from __future__ import annotations

import numpy as np
import pytest

from lexsplat.queries.grammar import understand
from lexsplat.scenes.answers import answer_queries, find_phrase
from lexsplat.scenes.library.bounds import CERTAIN, phrase_bound
from lexsplat.scenes.library.found import Found
from lexsplat.scenes.library.searching import spellings_of
from lexsplat.scenes.scene import Scene, open_scene
from lexsplat.scenes.serving import sentence


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo")


@pytest.mark.parametrize("text", ["leaves", "green leaves", "yellow books", "leaves of the plant"])
def test_a_plural_that_the_scene_holds_only_as_it_is_typed_is_found(demo, text):
    assert demo.find(text).present == "yes"


@pytest.mark.parametrize(("plural", "one"), [("toys", "toy"), ("the apples", "apple"), ("walls", "wall")])
def test_a_plural_that_the_scene_does_not_hold_is_asked_in_the_singular(demo, plural, one):
    answers, expected = demo.ask([plural, one]), demo.select(one)
    assert answers.asked == (one, one)
    assert answers.presences == ("yes", "yes")
    assert answers.prompts[0] == plural
    assert (answers.selection(0).mask == expected.mask).all()
    assert answers.note(0) == f'asked for as "{one}"'
    assert (demo.ask(plural, 0.5).scores == answers.scores[0]).all()
    assert (demo.relevancy(plural, "view_033") == demo.relevancy(one, "view_033")).all()


@pytest.mark.parametrize("text", ["dogs", "two toys", '"toys"', "toys on the table", "red toys"])
def test_what_has_no_singular_here_or_has_grammar_is_asked_as_it_is_written(demo, text):
    answers = demo.ask(text)
    assert (answers.asked, answers.presences) == ((text,), ("no",))


def test_a_query_says_that_a_plural_is_asked_in_the_singular(demo):
    found = answer_queries(demo, ["toys", "mug"], ["view_033"], None, None)["prompts"]
    assert [each["note"] for each in found] == ['asked for as "toy"', ""]
    assert found[0]["gaussians"] == len(demo.select("toy"))


@pytest.mark.parametrize(
    ("word", "words"), [("lampshade", "lamp shade"), ("flowerpot", "flower pot"), ("teddybear", "teddy bear")]
)
def test_a_compound_word_is_asked_for_as_two_words_and_said(demo, word, words):
    found = find_phrase(demo, word)
    assert (found["present"], found["understood"]) == ("yes", f'"{words}"')
    assert f'"{word}" is asked for as "{words}"' in found["note"]
    assert demo.ask(word).asked == (words,)
    assert demo.ask(word).presences == ("yes",)


@pytest.mark.parametrize("word", ["cupboard", "carpet", "bookcase", "eggplant", "newspaper"])
def test_a_compound_word_is_none_of_what_is_here_because_of_its_parts(demo, word):
    assert (demo.find(word).present, demo.ask(word).presences) == ("no", ("no",))


def test_what_is_not_understood_is_unsure_without_instances_and_says_so(demo):
    answer = find_phrase(demo, "How far is the duck from me?")
    assert (answer["present"], answer["count"], answer["gaussians"]) == ("unsure", 0, 0)
    assert 'not understood ("How")' in answer["note"]
    assert sentence(answer).startswith("Unsure: nothing certain is found")
    assert demo.ask("is the apple far from the lamp?").presences == ("unsure",)


@pytest.mark.parametrize(
    ("text", "present", "count"),
    [("Is the plant the largest object?", "yes", 1), ("Is the mug the tallest object?", "no", 0),
     ("Is there no violin?", "yes", 0), ("Is there no mug?", "no", 0), ("fewer than three apples", "yes", 1)],
)  # fmt: skip
def test_statements_are_checked(demo, text, present, count):
    answer = find_phrase(demo, text)
    assert (answer["present"], answer["count"]) == (present, count)


@pytest.mark.parametrize(
    ("text", "start"),
    [("Is there no violin?", 'It is so: no "violin".'), ("Is there no mug?", 'It is not so: no "mug".'),
     ("at most two violins", 'It is so: at most 2 "violin".'), ("at most two mugs", "1 found for")],
)  # fmt: skip
def test_a_sentence_on_few_things_says_whether_it_is_so(demo, text, start):
    assert sentence(find_phrase(demo, text)).startswith(start)


@pytest.mark.parametrize(
    ("text", "present", "count", "told"),
    [("the two yellow things", "yes", 3, "3 found, not 2"), ("two yellow things", "yes", 3, ""),
     ("the thing with a handle", "unsure", 1, "the handle of the mug"), ("containers", "yes", 3, ""),
     ("how many legs does the table have?", "unsure", 0, "may not show"),
     ("how many handles does the mug have?", "yes", 1, ""), ("what is in the mug?", "no", 0, "no object is listed")],
)  # fmt: skip
def test_what_may_not_be_seen_or_counted_is_said(demo, text, present, count, told):
    answer = find_phrase(demo, text)
    assert (answer["present"], answer["count"]) == (present, count)
    assert told in answer["note"]


def test_a_library_compares_the_words_that_a_scene_may_hold_instead():
    compared = spellings_of(understand("green leaves").phrase, "bundled")["green leaf"]
    assert {"green leaf", "green leaves", "leaves"} <= set(compared)
    assert "lamp shade" in spellings_of(understand("lampshade").phrase, "bundled")["lampshade"]


def test_a_library_rules_no_scene_out_for_what_it_should_lack():
    nothing = {"violin": np.zeros(3)}
    assert phrase_bound(understand("no violins").phrase, nothing) == CERTAIN
    assert (phrase_bound(understand("violins").phrase, nothing) < CERTAIN).all()


def test_a_library_is_unsure_of_what_is_not_understood():
    facts = {"hits": (), "scenes": 2, "opened": 0, "unopened": 0, "skipped": {}}
    assert Found("the first toy", "", "", **facts, unread=True).present == "unsure"
    assert Found("violin", "", "", **facts).present == "no"
