"""Questions whose words turn an answer round: negatives, places alone, exceptions from superlatives, commands."""

import re

import pytest
from support.phrases import parse

from lexsplat.queries.grammar import understand
from lexsplat.queries.phrases import (
    Anything,
    AtLeast,
    Both,
    Colored,
    Except,
    InCorner,
    Pick,
    Related,
    Thing,
    Together,
    Understood,
    Viewer,
)
from lexsplat.queries.questions import says_more

ANY, ME = Anything(), Viewer()
MUG, DUCK, TABLE, CLOTH = Thing("mug"), Thing("duck"), Thing("table"), Thing("cloth")
LAMP, TOY, APPLE, BEAR = Thing("lamp"), Thing("toy"), Thing("apple"), Thing("bear")
NOT_LAMP, ON_CLOTH = Except(ANY, LAMP), Related("on", MUG, CLOTH)


@pytest.mark.parametrize(
    ("negative", "positive"),
    [
        ("isn't the duck on the table?", "is the duck on the table?"),
        ("isn't the mug on the cloth", "is the mug on the cloth"),
        ("aren't the books on the table", "are the books on the table"),
        ("doesn't the lamp stand on the table", "does the lamp stand on the table"),
        ("wasn't the mug on the table", "was the mug on the table"),
        ("is not the mug on the table?", "is the mug on the table?"),
        ("isn't there a cat", "is there a cat"),
        ("aren't there two ducks", "are there two ducks"),
        ("wasn't there a mug here?", "was there a mug here?"),
        ("isn't the mug blue?", "is the mug blue?"),
        ("can't you see the mug on the table", "can you see the mug on the table"),
        ("don't you see the mug on the table", "do you see the mug on the table"),
        ("please, isn't the mug on the cloth?", "please, is the mug on the cloth?"),
        ("Isn\u2019t the duck on the table?", "is the duck on the table?"),
        ("aren't all toys on the table", "are all toys on the table"),
    ],
)
def test_a_negative_question_asks_the_positive_statement(negative, positive):
    assert understand(negative) == understand(positive)
    assert "minus" not in str(parse(negative))
    assert not understand(negative).note


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("is the mug not on the table?", Except(MUG, Related("on", MUG, TABLE))),
        ("the duck isn't on the table, is it?", Except(DUCK, Related("on", DUCK, TABLE))),
        ("is the mug not blue", Except(MUG, Thing("blue mug"))),
        ("what isn't on the table", Except(ANY, Related("on", ANY, TABLE))),
        ("what isn't red", Except(ANY, Colored("red", ANY))),
        ("not on the table", Except(ANY, Related("on", ANY, TABLE))),
    ],
)
def test_a_denial_leaves_out_of_what_it_names(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("on the table", Related("on", ANY, TABLE)),
        ("left of the mug", Related("left of", ANY, MUG)),
        ("next to the lamp", Related("next to", ANY, LAMP)),
        ("around the apple", Related("next to", ANY, APPLE)),
        ("beside the duck", Related("next to", ANY, DUCK)),
        ("left of me", Related("left of", ANY, ME)),
        ("in front of the camera", Related("in front of", ANY, ME)),
        ("closest to the duck", Related("nearest to", ANY, DUCK)),
        ("farthest from the duck", Related("farthest from", ANY, DUCK)),
        ("look under the table", Related("under", ANY, TABLE)),
        ("without the duck", Except(ANY, DUCK)),
        ("all but the mug", Except(ANY, MUG)),
        ("where's the mug at?", MUG),
        ("where is mug at", MUG),
        ("which corner is the lamp in", LAMP),
        ("what does the lamp stand next to", Related("next to", ANY, LAMP)),
        ("what does the lamp stand on", Related("under", ANY, LAMP)),
        ("a mug on the cloth and left of the duck", Related("left of", Related("on", MUG, CLOTH), DUCK)),
        ("mug that is on the cloth and next to the duck", Related("next to", Related("on", MUG, CLOTH), DUCK)),
        ("mug near lamp or near duck", Both(Related("next to", MUG, LAMP), Related("next to", MUG, DUCK))),
        ("mug on the cloth and not next to the duck", Except(ON_CLOTH, Related("next to", ON_CLOTH, DUCK))),
        ("mug, left of the duck", Related("left of", MUG, DUCK)),
        ("on the left", Pick("leftmost", ANY)),
    ],
)  # fmt: skip
def test_a_place_alone_is_any_object_there_and_two_places_hold_for_one_thing(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    "text",
    [
        "TOYS on the table that are not on the cloth",
        "TOYS on the table which aren't on the cloth",
        "TOYS on the table not on the cloth",
        "which TOYS on the table are not on the cloth?",
        "how many TOYS on the table are not on the cloth?",
        "TOY on the table that is not on the cloth",
        "what is on the table that is not on the cloth",
        "what on the table is not on the cloth?",
        "is there anything on the table that isn't on the cloth?",
    ],
)
def test_a_clause_behind_a_surface_is_said_of_the_things_on_it(text):
    things = Related("on", TOY if "TOY" in text else ANY, TABLE)
    assert understand(text.lower()) == Understood(Except(things, Related("on", things, CLOTH)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("toys on the table that are next to the mug", Related("next to", Related("on", TOY, TABLE), MUG)),
        ("toys on the table that are on the left", Pick("leftmost", Related("on", TOY, TABLE))),
        ("largest toy on the table that is not on the cloth", parse("largest toy on the table not on the cloth")),
        ("toy next to the mugs that is on the cloth", Related("on", Related("next to", TOY, MUG), CLOTH)),
        ("toys next to the mugs that are on the cloth", Related("next to", TOY, ON_CLOTH)),
        ("toy next to the mug that is on the cloth", Related("next to", TOY, ON_CLOTH)),
        ("toy next to the mug that is not on the cloth", Related("next to", TOY, Except(MUG, ON_CLOTH))),
        ("toy on the mug that is not on the cloth", Related("on", TOY, Except(MUG, ON_CLOTH))),
        ("mug on the cloth and on the left", Pick("leftmost", ON_CLOTH)),
    ],
)  # fmt: skip
def test_a_clause_is_said_of_what_its_verb_agrees_with_and_else_of_the_nearest_noun(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("what is on?", "is"),
        ("mug on", "on"),
        ("mug and", "and"),
        ("and", "and"),
        ("left of", "left of"),
        ("when was the lamp turned on", "on"),
        ("is there something in front of me that I could trip over", "over"),
        ("left of what is the mug", "what"),
        ("is near the mug something?", "is"),
        ("mug on me", "me"),
        ("mug and me", "me"),
        ("...", "..."),
        ("?", "?"),
    ],
)
def test_what_stays_incomplete_is_one_plain_phrase_and_never_an_error(text, named):
    understood = understand(text)
    assert understood.phrase == Thing(text.rstrip("?") or text)
    assert understood.unknown
    assert understood.note.startswith(f'not understood ("{named}"')


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the closest thing to the mug except the duck", Related("nearest to", Except(ANY, DUCK), MUG)),
        ("the nearest toy to the duck other than the bear", Related("nearest to", Except(TOY, BEAR), DUCK)),
        ("biggest thing other than the lamp", Pick("largest", NOT_LAMP)),
        ("the biggest toy but the bear", Pick("largest", Except(TOY, BEAR))),
        ("the tallest thing that is not the lamp", Pick("tallest", NOT_LAMP)),
        ("the leftmost thing that isn't the lamp", Pick("leftmost", NOT_LAMP)),
        ("the two biggest things except the lamp", Pick("largest", NOT_LAMP, 2)),
        ("the tallest thing on the table except the lamp", Pick("tallest", Except(Related("on", ANY, TABLE), LAMP))),
        ("the tallest thing that is not red", Pick("tallest", Except(ANY, Colored("red", ANY)))),
        ("the tallest thing that is red", Pick("tallest", Colored("red", ANY))),
        ("two things except the lamp", AtLeast(2, NOT_LAMP)),
    ],
)  # fmt: skip
def test_an_exception_is_taken_off_before_the_superlative_picks(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("duck, mug and not the apple", Except(Both(DUCK, MUG), APPLE)),
        ("toys, but not the duck and not the bear", Except(TOY, Both(DUCK, BEAR))),
        ("is there a thing on the mug and a duck?", Together(Related("on", ANY, MUG), DUCK)),
        ("plz find mug", MUG),
        ("the mug of red color", Thing("red mug")),
        ("everything red", Colored("red", ANY)),
        ("everything green", Colored("green", ANY)),
        ("how many things are yellow?", Colored("yellow", ANY)),
        ("how many mugs are red?", Thing("red mug")),
        ("how many toys are not yellow", Except(TOY, Colored("yellow", TOY))),
        ("is the mug made of metal?", Thing("metal mug")),
        ("does the mug have a handle?", Thing("mug handle")),
        ("Has the red mug got a handle", Thing("red mug handle")),
        ("does the bear have ears?", Thing("bear ear")),
        ("are the mugs made out of glass?", Thing("glass mug")),
        ("is anything made of metal?", Thing("something made of metal")),
        ("was my table made of wood?", Thing("wooden table")),
        ("the largest two toys", Pick("largest", TOY, 2)),
        ("two largest toys", Pick("largest", TOY, 2)),
        ("the leftmost 3 things", Pick("leftmost", ANY, 3)),
        ("the largest one", Pick("largest", ANY)),
        ("robot, find the mug", MUG),
        ("where is the mug, robot?", MUG),
        ("Alexa, where is the mug", MUG),
        ("sorry, where is the mug", MUG),
        ("could you possibly tell me where the yellow duck might be?", Thing("yellow duck")),
        ("where could the mug be", MUG),
        ("where did the duck go", DUCK),
        ("where has the duck gone", DUCK),
        ("the object at the far left", Pick("leftmost", ANY)),
        ("toy that is closest to the left", Pick("leftmost", TOY)),
        ("things at the right", Pick("rightmost", ANY)),
        ("everything besides the lamp", NOT_LAMP),
        ("mug besides the duck", Related("next to", MUG, DUCK)),
        ("what is next to the mug and the duck", Related("next to", Related("next to", ANY, MUG), DUCK)),
        ("things next to the mug or the duck", Both(Related("next to", ANY, MUG), Related("next to", ANY, DUCK))),
        ("what is near both the mug and the duck", Related("next to", Related("next to", ANY, MUG), DUCK)),
        ("the widest thing", Pick("widest", ANY)),
        ("the longest thing on the table", Pick("longest", Related("on", ANY, TABLE))),
        ("where do I put flowers", Thing("something to put flowers in")),
        ("3 or more toys", AtLeast(3, TOY)),
        ("are there two or more mugs on the table?", AtLeast(2, Related("on", MUG, TABLE))),
        ("how many wheels does the toy car have?", Thing("toy car wheel")),
        ("what can be seen behind the mug?", Related("behind", ANY, MUG)),
        ("what supports the apple?", Related("under", ANY, APPLE)),
        ("where is the duck standing?", DUCK),
        ("are the apple and the mug next to each other?", Related("next to", APPLE, MUG)),
        ("toys that are not apples", Except(TOY, APPLE)),
        ("how many toys are not apples?", Except(TOY, APPLE)),
        ("how many mugs are not on the table?", Except(MUG, Related("on", MUG, TABLE))),
        ("the handle on the mug", Thing("mug handle")),
        ("where is the nose on the brown bear?", Thing("brown bear nose")),
        ("leaf on the table", Related("on", Thing("leaf"), TABLE)),
        ("head on the table", Related("on", Thing("head"), TABLE)),
        ("things that are not toys", Except(ANY, TOY)),
        ("red things that are not mugs", Except(Colored("red", ANY), MUG)),
        ("things on the table that are not red mugs", Except(Related("on", ANY, TABLE), Thing("red mug"))),
        ("which things are toys?", TOY),
        ("things that are animals", Thing("animal")),
        ("toys that are animals", Except(TOY, Except(TOY, Thing("animal")))),
        ("vases that are glass", Thing("glass vase")),
        ("mug without handle", Except(MUG, Thing("mug handle"), lacks=True)),
        ("flowers that are not roses", Except(Thing("flower"), Thing("rose"))),
        ("mug that has no handle", Except(MUG, Thing("mug handle"), lacks=True)),
        ("mugs with no handles", Except(MUG, Thing("mug handle"), lacks=True)),
        ("things without a handle", Except(ANY, Thing("handle"), lacks=True)),
        ("red things without wheels", Except(Colored("red", ANY), Thing("wheel"), lacks=True)),
        ("red", Colored("red", ANY)),
        ("the red", Colored("red", ANY)),
        ("orange", Thing("orange")),
        ("toys without wheels", Except(TOY, Thing("wheel"), lacks=True)),
        ("the largest mug without a handle", Pick("largest", Except(MUG, Thing("mug handle"), lacks=True))),
        ("mug without a handle on the table", Related("on", Except(MUG, Thing("mug handle"), lacks=True), TABLE)),
        ("mug without handle or lid", Except(Except(MUG, Thing("mug handle"), lacks=True), Thing("lid"), lacks=True)),
        ("how many wheels do cars have?", Thing("car wheel")),
        ("how many wheels are on the toy car?", Thing("toy car wheel")),
        ("is the book in the safe?", Related("inside", Thing("book"), Thing("safe"))),
        ("is there a mug without a handle?", Except(MUG, Thing("mug handle"), lacks=True)),
        ("mug except the handle", Except(MUG, Thing("handle"))),
        ("toys without the duck", Except(TOY, DUCK)),
        ("exactly two mugs", AtLeast(2, MUG, 2)),
        ("is there only one duck?", AtLeast(1, DUCK, 1)),
        ("is there exactly one mug?", AtLeast(1, MUG, 1)),
        ("is there just one lamp", AtLeast(1, LAMP, 1)),
    ],
)  # fmt: skip
def test_what_people_say_around_a_thing_is_understood(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "expected", "told"),
    [
        ("how tall is the mug", MUG, "size"),
        ("how big is the mug?", MUG, "size"),
        ("how tall is the mug in cm?", MUG, "size"),
        ("how many centimeters tall is the mug?", MUG, "size"),
        ("what is the size of the mug in meters", MUG, "size"),
        ("how far is the mug from the lamp in feet?", Both(MUG, LAMP), "lexsplat measure"),
        ("what is the height of the mug?", MUG, "size"),
        ("what is the color of the mug?", MUG, "lexsplat list"),
        ("how far is the mug from the lamp?", Both(MUG, LAMP), "lexsplat measure"),
        ("how far apart are the mug and the lamp?", Both(MUG, LAMP), "lexsplat measure"),
        ("what's the distance between the mug and the lamp?", Both(MUG, LAMP), "lexsplat measure"),
        ("distance from the mug to the lamp", Both(MUG, LAMP), "lexsplat measure"),
        ("where can I grasp the mug?", MUG, "mug handle"),
        ("move the mug to the left", Pick("leftmost", MUG), '"move"'),
        ("Go to the mug", MUG, '"Go"'),
        ("hey robot, bring me the mug", MUG, '"bring"'),
        ("hand me the mug", MUG, '"hand"'),
        ("pick up the mug", MUG, '"pick up"'),
        ("delete the mug", MUG, '"delete"'),
        ("what is the mug made of?", MUG, "material"),
        ("turn to the mug", MUG, '"turn"'),
        ("drive around the mug", MUG, '"drive"'),
        ("can you please navigate to the mug", MUG, '"navigate"'),
        ("what is in the corner of the table", InCorner(ANY), '"of the table"'),
    ],
)
def test_what_a_question_asks_beside_the_thing_is_reported(text, expected, told):
    understood = understand(text)
    assert understood.phrase == expected
    assert told in understood.note
    assert not understood.unknown


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("where should I put the mug?", "where"),
        ("where do I put the mug?", "where"),
        ("don't show me the mug", "don't"),
        ("do not touch the mug", "do"),
        ("turn left", "turn"),
        ("where isn't the mug", "where"),
        ("is on the table", "is"),
        ("hasn't the duck a beak", "hasn't"),
        ("turn on the lamp", "turn"),
        ("Half of the mugs", "Half"),
        ("WHY is it red", "WHY"),
        ("0 toys", "0"),
        ("at least 0 toys", "0"),
        ("fewer than zero apples", "fewer"),
    ],
)
def test_a_note_on_what_is_not_understood_names_a_word_in_its_own_letters(text, told):
    note = understand(text).note
    assert note.startswith(f'not understood ("{told}"')
    assert all(quoted in text for quoted in re.findall('"([^"]*)"', note))


def test_typing_errors_and_sizes_are_quoted_in_their_own_letters():
    assert understand("Whre is the mug").note.startswith('"Whre"')
    assert understand("Small mug").note.startswith('"Small"')


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        ("is the largest toy on the cloth?", Related("on", Pick("largest", TOY), CLOTH)),
        ("isn't the largest toy on the cloth?", Related("on", Pick("largest", TOY), CLOTH)),
        ("which is the largest toy on the cloth?", Pick("largest", Related("on", TOY, CLOTH))),
        ("does the biggest toy lie next to the apple?", Related("next to", Pick("largest", TOY), APPLE)),
        ("is the rightmost toy left of the duck?", Related("left of", Pick("rightmost", TOY), DUCK)),
        ("toys on the table but left of the mug", Related("left of", Related("on", TOY, TABLE), MUG)),
    ],
)  # fmt: skip
def test_a_statement_is_about_the_one_that_is_picked_and_but_adds_a_place(question, expected):
    assert parse(question) == expected
    assert not understand(question).unknown


@pytest.mark.parametrize(
    ("question", "word"),
    [
        ("is everything on the table green?", "green"),
        ("are all the toys on the table red?", "red"),
        ("is the fruit nearest to the mug yellow?", "yellow"),
        ("is only the duck on the table?", "only"),
        ("is just the mug on the cloth?", "just"),
        ("show me the toys but only the red ones", "only"),
    ],
)
def test_a_statement_that_the_grammar_cannot_check_is_said(question, word):
    understood = understand(question)
    assert understood.unknown
    assert f'not understood ("{word}")' in understood.note


@pytest.mark.parametrize(
    ("text", "thing", "state"),
    [
        ("is the mug dead?", MUG, "dead"),
        ("is the mug lit", MUG, "lit"),
        ("is the mug not heavy?", MUG, "heavy"),
        ("is the mug empty or full?", MUG, "empty"),
        ("is the mug full of tea?", MUG, "full of tea"),
        ("is the lamp on?", LAMP, "on"),
        ("is the lamp still on?", LAMP, "on"),
        ("isn't the lamp switched off?", LAMP, "switched off"),
        ("is there a lamp that is on?", LAMP, "on"),
        ("which lamp is on?", LAMP, "on"),
        ("are the mugs closed?", MUG, "closed"),
        ("is the mug on the cloth clean?", Related("on", MUG, CLOTH), "clean"),
    ],
)
def test_the_state_of_a_thing_is_not_told_and_the_thing_is_the_answer(text, thing, state):
    found = understand(text)
    assert (found.phrase, found.unknown, found.unread) == (thing, True, False)
    assert f'the answer is the thing: "{state}" is a state, which photos may not tell' in found.note


@pytest.mark.parametrize(
    "text", ["what is the mug standing on?", "is the mug on the table?", "which table is the mug on?"]
)
def test_what_a_thing_stands_on_is_no_state(text):
    assert "state" not in understand(text).note


def test_a_scene_is_one_moment():
    now = understand("is the duck still on the table?")
    assert now.phrase == parse("is the duck on the table?")
    assert now.note == '"still" is left out: a scene is one moment'
    assert understand("is there still a mug").phrase == MUG
    assert parse("is there a still life?") == Thing("still life")
    assert not understand("are all toys red?").unknown
    assert not understand("is there only one mug?").unknown


@pytest.mark.parametrize("question", ["is the mug just behind the duck?", "is the only mug on the table?"])
def test_a_statement_that_the_grammar_can_check_is_checked(question):
    assert (understand(question).note, understand(question).unknown) == ("", False)


def test_a_place_is_a_word_of_its_own():
    assert says_more("is the largest toy on the table yellow") == "yellow"
    assert says_more("is the largest lemon yellow") == "", "its end is no place"
