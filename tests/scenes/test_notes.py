"""Notes of answers of the bundled scene, and questions that must not be turned round."""

import pytest

from lexsplat.scenes.answers import find_phrases
from lexsplat.scenes.scene import Scene, open_scene


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo", device="cpu")


def test_a_phrase_that_the_encoder_cuts_is_reported_in_the_note(demo):
    assert "tokens" not in demo.understand("a mug with a blue handle").note
    long = "a mug " + "that my brother and I have painted with very small flowers " * 5
    assert "tokens are left out" in demo.understand(long).note
    assert "tokens are left out" in demo.understand("mug " * 200).note


@pytest.mark.parametrize(
    ("question", "present", "names"),
    [
        ("isn't the duck on the table?", "yes", ["duck"]),
        ("isn't the cat on the table", "no", []),
        ("is the apple red or green?", "yes", ["apple"]),
        ("the closest thing to the mug except the duck", "yes", ["apple"]),
        ("the tallest thing that is not the lamp", "yes", ["teddy bear"]),
        ("is there exactly one mug?", "yes", ["mug"]),
        ("are there exactly two mugs?", "no", []),
    ],
)
def test_negatives_exceptions_and_exact_numbers_are_answered_rightly(demo, question, present, names):
    (answer,) = find_phrases(demo, question)["phrases"]
    assert answer["present"] == present
    assert [thing["name"].split()[-1] for thing in answer["instances"]] == [
        name.split()[-1] for name in names
    ]


@pytest.mark.parametrize(
    ("phrase", "told"),
    [
        ("half of the toys", "not understood"),
        ("roter Apfel", "knows English words alone"),
        ("is the mug empty?", "photos may not tell"),
        ("what color is the mug?", "the answer is the thing"),
        ("bananna", "may be a typing error"),
    ],
)
def test_python_is_told_what_the_command_line_is_told(demo, phrase, told):
    found = demo.find(phrase)
    (answer,) = find_phrases(demo, phrase)["phrases"]
    assert told in found.note
    assert found.note == answer["note"] == found.to_dict()["note"]


@pytest.mark.parametrize(
    ("question", "thing"),
    [("is the lamp on?", "table lamp"), ("is the mug empty?", "mug"), ("is the mug full?", "mug")],
)
def test_a_state_is_unsure_and_never_the_place_of_another_thing(demo, question, thing):
    found = demo.find(question)
    (one,) = found.instances
    listed = next(each for each in demo.objects if each.phrase == thing)
    assert found.present == "unsure"
    assert int(listed.mask[one.indices].sum()) > 0.9 * len(listed)


def test_the_same_phrase_in_other_words_has_a_note_of_its_own(demo):
    assert not demo.find("banana").note
    assert "typing error" in demo.find("bananna").note
    assert not demo.find("banana").note


def test_one_phrase_that_is_no_words_leaves_the_others_of_a_batch_answered(demo):
    mug, nothing, place, duck = find_phrases(demo, ["mug", "...", "when was the lamp on?", "duck"])["phrases"]
    assert (mug["present"], duck["present"]) == ("yes", "yes")
    for answer in (nothing, place):
        assert answer["present"] != "yes"
        assert "not understood" in answer["note"]


@pytest.mark.parametrize(
    "phrase", ["leftmost toy", "mug at the back", "toy in the back left corner", "toy closest to me"]
)
def test_where_somebody_stands_is_reported_where_the_answer_depends_on_it(demo, phrase):
    name = next(iter(demo.cameras))
    assert demo.find(phrase, view=name).note == f"as seen from {name}"
    assert demo.find(phrase).note.startswith("as seen from view_")
    assert demo.find("largest toy").note == ""


@pytest.mark.parametrize(
    ("question", "present"),
    [
        ("is the ring on the table?", "yes"),
        ("is the ring under the table?", "no"),
        ("is the table on the ring?", "no"),
        ("is the cloth on the table?", "yes"),
        ("is the table on the cloth?", "no"),
        ("is the cloth under the table?", "no"),
        ("is the banana under the cloth?", "no"),
        ("is the bottle on the table?", "yes"),
        ("is the lamp on the wall?", "no"),
        ("isn't the duck on the table?", "yes"),
        ("isn't the cat on the table?", "no"),
        ("is the largest toy on the cloth?", "no"),
        ("is there an apple and a cat?", "no"),
    ],
)
def test_what_carries_what_is_answered_in_one_direction(demo, question, present):
    found = demo.find(question)
    assert found.present == present
    assert bool(found.count) == (present != "no")


def test_everything_on_the_table_is_on_it_and_the_floor_is_under_it(demo):
    assert demo.find("is everything on the table?").count == 14
    assert [each.phrase for each in demo.find("what is under the table?").instances] == ["floor"]
