"""Questions as people ask them (tests/data/questions.json), of the bundled scene."""

import json

import pytest
from questions import FILE, is_right, questions

from lexsplat.queries.grammar import understand
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.scene import open_scene


def test_the_halves_of_the_questions_are_disjoint_and_each_is_large():
    tune, kept = ([(q["scene"], q["ask"]) for q in questions(half)] for half in ("tune", "kept"))
    assert not set(tune) & set(kept)
    assert min(len(tune), len(kept)) >= 100
    assert {scene for scene, _ in tune} == {scene for scene, _ in kept} == {"demo", "second"}


@pytest.mark.parametrize("question", questions("tune"), ids=lambda question: question["ask"])
def test_questions_are_parsed_without_a_rest(question):
    assert "not understood" not in understand(question["ask"]).note


@pytest.mark.slow
def test_most_questions_that_the_grammar_was_made_with_are_answered_rightly():
    things, scene = json.loads(FILE.read_text())["things"]["demo"], open_scene("demo")
    asked = [question for question in questions("tune") if question["scene"] == "demo"]
    right = sum(is_right(question, find_phrase(scene, question["ask"]), things) for question in asked)
    assert right >= 0.7 * len(asked)


def test_an_answer_is_right_only_if_its_places_are_those_of_the_layout():
    things = {"apple": [0.0, 0.0], "mug": [1.0, 0.0]}
    instance = {"center": [0.05, 0.0, 0.2], "size": [0.3, 0.3, 0.3]}
    question = {"names": ["apple"]}
    assert is_right(question, {"present": "yes", "count": 1, "instances": [instance]}, things)
    assert not is_right(question, {"present": "no", "count": 0, "instances": []}, things)
    assert not is_right({"names": ["mug"]}, {"present": "yes", "count": 1, "instances": [instance]}, things)
    assert not is_right({"names": []}, {"present": "yes", "count": 1, "instances": [instance]}, things)
    assert is_right({"names": []}, {"present": "no", "count": 0, "instances": []}, things)
    assert not is_right({"count": 2}, {"present": "yes", "count": 1, "instances": [instance]}, things)
    far = {"center": [0.5, 0.5, 0.2], "size": [0.3, 0.3, 0.3]}
    assert not is_right(question, {"present": "yes", "count": 1, "instances": [far]}, things)
