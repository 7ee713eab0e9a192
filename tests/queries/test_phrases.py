"""Phrases: what they ask for, written out by hand."""

import re

import pytest
from support.phrases import parse

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.grammar import understand
from lexsplat.queries.leftovers import left_over
from lexsplat.queries.phrases import (
    Anything,
    AtLeast,
    Between,
    Both,
    Colored,
    Every,
    Except,
    InCorner,
    InPart,
    Pick,
    Related,
    Thing,
    Together,
    Understood,
    Viewer,
)
from lexsplat.queries.spelling import corrected, spellings, strange
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.errors import QueryError

MUG, CLOTH, DUCK = Thing("mug"), Thing("cloth"), Thing("duck")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mug", MUG),
        ("The mug", MUG),
        ("  a   red  mug ", Thing("red mug")),
        ("mug on the cloth", Related("on", MUG, CLOTH)),
        ("mug that is on the cloth", Related("on", MUG, CLOTH)),
        ("mug to the left of the duck", Related("left of", MUG, DUCK)),
        ("mug left of duck", Related("left of", MUG, DUCK)),
        ("mug on the right of the duck", Related("right of", MUG, DUCK)),
        ("mug in front of the duck", Related("in front of", MUG, DUCK)),
        ("mug on top of the cloth", Related("on", MUG, CLOTH)),
        ("mug beside the duck", Related("next to", MUG, DUCK)),
        ("mug next to the duck on the cloth", Related("next to", MUG, Related("on", DUCK, CLOTH))),
        ("nearest mug to the duck", Related("nearest to", MUG, DUCK)),
        ("mug closest to the duck", Related("nearest to", MUG, DUCK)),
        ("mug and duck", Both(MUG, DUCK)),
        ("mug, duck or cloth", Both(MUG, Both(DUCK, Thing("cloth")))),
        ("mug but not the duck", Except(MUG, DUCK)),
        ("largest mug on the cloth", Pick("largest", Related("on", MUG, CLOTH))),
        ("the smallest mug", Pick("smallest", MUG)),
        ("How many mugs?", MUG),
        ("how many mugs on the cloth", Related("on", MUG, CLOTH)),
        ("count the stacks of books", Thing("stack of books")),
        ("number of red boxes and berries", Both(Thing("red box"), Thing("berry"))),
        ("how many glasses", Thing("glass")),
        ("how many glass", Thing("glass")),
        ("how many people", Thing("people")),
        ('how many "jeans"', Thing("jeans")),
        ("mugs", MUG),
        ('"something on wheels" behind the duck', Related("behind", Thing("something on wheels"), DUCK)),
        ('"salt and pepper"', Thing("salt and pepper")),
        ("something to drink from", Thing("something to drink from")),
        ("something to sit on", Thing("something to sit on")),
        ("a vase to put flowers in", Thing("vase to put flowers in")),
        ("how many apples are there?", Thing("apple")),
        ("how many apples are on the cloth", Related("on", Thing("apple"), CLOTH)),
        ("How many red apples are there on the cloth?", Related("on", Thing("red apple"), CLOTH)),
        ("is there a mug?", MUG),
        ("is there a mug on the cloth?", Related("on", MUG, CLOTH)),
        ("are there any mugs", MUG),
        ("where is the mug?", MUG),
        ("Where are the mug and the duck", Both(MUG, DUCK)),
        ("Mug On The Cloth", Related("on", Thing("mug"), Thing("Cloth"))),
        ("how many MUGS", Thing("MUG")),
        ("mug not on the cloth", Except(MUG, Related("on", MUG, CLOTH))),
        ("mug that is not on the cloth", Except(MUG, Related("on", MUG, CLOTH))),
        (
            "how many apples are not on the cloth",
            Except(Thing("apple"), Related("on", Thing("apple"), CLOTH)),
        ),
        ("theremin", Thing("theremin")),
        ("wooden table", Thing("wooden table")),
        ("onion", Thing("onion")),
        ("something made of metal", Thing("something made of metal")),
    ],
)
def test_phrases_are_understood(text, expected):
    assert parse(text) == expected


@pytest.mark.parametrize("text", ["", "   ", 'the "mug', '"" on the cloth'])
def test_empty_phrases_and_single_quotation_marks_are_refused(text):
    with pytest.raises(QueryError):
        parse(text)


@pytest.mark.parametrize("joint", [" on ", " and ", " but not ", ", "])
def test_phrases_of_very_many_parts_are_refused(joint):
    assert str(parse(joint.join(["cup"] * 30)))
    with pytest.raises(QueryError, match="parts"):
        parse(joint.join(["x"] * 45))
    with pytest.raises(QueryError, match="parts"):
        parse("largest " * 45 + "cup")


@pytest.mark.parametrize(
    "text", ["cup and " * 12_500, "why is the sky blue", "is the mug closer to the duck than to the lamp"]
)
def test_what_is_not_understood_is_one_thing_in_its_own_words_and_said(text):
    understood = understand(text)
    assert isinstance(understood.phrase, Thing)
    assert understood.phrase.text == text.strip()
    assert understood.note


ANY, ME = Anything(), Viewer()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("where can I find the mug?", MUG),
        ("Could you please show me where the mug is?", MUG),
        ("I've lost my mug, where is it?", MUG),
        ("hand on the cloth", Related("on", Thing("hand"), CLOTH)),
        ("what can I drink from?", Thing("something to drink from")),
        ("where can I put flowers?", Thing("something to put flowers in")),
        ("what gives light?", Thing("something that gives light")),
        ("what is on the cloth?", Related("on", ANY, CLOTH)),
        ("what is the mug on?", Related("under", ANY, MUG)),
        ("list everything", ANY),
        ("what is in the room", ANY),
        ("red things", Colored("red", ANY)),
        ("the mug that is red", Thing("red mug")),
        ("mug, red", Thing("red mug")),
        ("is the mug red?", Thing("red mug")),
        ("which mug is red?", Thing("red mug")),
        ("a ring made of silver", Thing("silver ring")),
        ("which objects are made of wood", Thing("something made of wood")),
        ("two mugs", AtLeast(2, MUG)),
        ("more than two mugs", AtLeast(3, MUG)),
        ("one mug", MUG),
        ("mug between the duck and the cloth", Between(MUG, DUCK, CLOTH)),
        ("is the mug between the duck and the cloth", Between(MUG, DUCK, CLOTH)),
        ("which thing is closest to the duck?", Related("nearest to", ANY, DUCK)),
        ("the mug furthest away from the duck", Related("farthest from", MUG, DUCK)),
        ("what is closest to me", Related("nearest to", ANY, ME)),
        ("the closest mug", Related("nearest to", MUG, ME)),
        ("mugs in front of me", Related("in front of", MUG, ME)),
        ("what is on my left?", Related("left of", ANY, ME)),
        ("the mug on the left", Pick("leftmost", MUG)),
        ("which mug is the tallest?", Pick("tallest", MUG)),
        ("the biggest thing here", Pick("largest", ANY)),
        ("mug in the corner", InCorner(MUG)),
        ("what is in the far left corner of the room", InCorner(ANY, "back left")),
        ("mugs that are not the duck", Except(MUG, DUCK)),
        ("everything except the mug", Except(ANY, MUG)),
        ("not the mug", Except(ANY, MUG)),
        ("what is not the mug?", Except(ANY, MUG)),
        ("children", Thing("child")),
        ("glasses", Thing("glass")),
        ("the yellow object", Colored("yellow", ANY)),
        ("is there anything grey?", Colored("gray", ANY)),
        ("red mug", Thing("red mug")),
        ('"red toy"', Thing("red toy")),
        ("which toys can you see?", Thing("toy")),
        ("which toys are there?", Thing("toy")),
        ("the two largest toys", Pick("largest", Thing("toy"), 2)),
        ("what kinds of fruit are there?", Thing("fruit")),
        ("which red toys can you see?", Colored("red", Thing("toy"))),
        ("what toys are on the table?", Related("on", Thing("toy"), Thing("table"))),
        ("what objects are visible?", ANY),
        ("what do you see next to the mug?", Related("next to", ANY, MUG)),
        ("what can I find behind the mug?", Related("behind", ANY, MUG)),
        ("what else do you have on the mug?", Related("on", ANY, MUG)),
        ("what is there to see on the mug?", Related("on", ANY, MUG)),
        ("what can I see through?", Thing("something to see through")),
        ("what is the thing next to the mug?", Related("next to", ANY, MUG)),
        ("what's the thing between the mug and the duck?", Between(ANY, MUG, DUCK)),
        ("what is the name of the object on the mug?", Related("on", ANY, MUG)),
        ("what's that blue thing?", Colored("blue", ANY)),
        ("what is that on the mug?", Related("on", ANY, MUG)),
        ("what are those red things on the mug?", Related("on", Colored("red", ANY), MUG)),
        ("which one can I eat?", Thing("something to eat")),
        ("have I left my mug on the duck?", Related("on", MUG, DUCK)),
        ("has anyone seen my mug?", MUG),
        ("has the mug been left on the duck?", Related("on", MUG, DUCK)),
    ],
)
def test_questions_as_people_ask_them_are_understood(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("something that is the mug", "is"),
        ("something to see", "something to see"),
        ("something thing with a handle", "thing with a handle"),
        ("what can hold water?", "what"),
        ("the first toy", "first"),
        ("the last toy on the left", "last"),
        ("how many legs has the table?", "has"),
        ("the mug in front of it", "it"),
        ("something heavier than the mug", "heavier"),
        ("half of the mugs", "half"),
        ("are there more mugs than ducks?", "more"),
        ("what is 30 cm left of the mug?", "30"),
        ("anything within one meter of the mug", "one"),
        ("big toys", "big"),
        ("small red mugs", "small"),
        ("which shelf holds the mugs?", "holds the"),
        ("the largest but one", "largest"),
        ("tiny things on the table", "tiny"),
        ("the middle toy", "middle"),
        ("left side of the mug", "left"),
        ("the top of the mug", "top of"),
        ("across from the mug", "across"),
        ("the same toy", "same"),
        ("pick up the mug and put it on the cloth", "it"),
        ("go to the mug then turn left", "then"),
        ("is it safe to lift the mug?", "it"),
        ("mugs next to each other", "each"),
        ("all the other mugs", "other"),
        ("are all mugs red?", "are"),
        ("mug diagonally behind the duck", "diagonally"),
    ],
)
def test_words_that_name_no_thing_are_reported_as_they_were_written_and_the_whole_is_one_thing(text, left):
    assert left in text
    understood = understand(text)
    assert understood.note == f'not understood ("{left}"): asked for as one thing, in these words'
    assert understood.phrase == Thing(text.rstrip("?"))
    assert understood.unknown


@pytest.mark.parametrize("text", ["the last object on the left"])
def test_a_note_quotes_no_words_that_nobody_wrote(text):
    note = understand(text).note
    assert "not understood" in note
    assert all(quoted in text for quoted in re.findall('"([^"]*)"', note))


@pytest.mark.parametrize(
    "text",
    [
        "mug with no handles", "cup of tea", "bottle of water", "something to sit on", "something to drink from",
        "vase to put flowers in", "something that has wheels", "something that gives light", "table with four legs",
        "stack of three books", "bottle with no label", "no smoking sign", "first aid kit", "can of soda", "can",
        "trash can", "can opener", "a bear wearing a hat", "front door", "top shelf", "side table", "top hat",
        "bottom drawer", "chest of drawers", "forest", "poster", "lighter", "pair of scissors", "a pair of scissors",
        "salt shaker", "loudspeaker", "vacuum cleaner", "wavy noodles",
        "short sleeved shirt",
        "box without a lid", "room 101", "two-seater sofa", "one-way sign", "red and white ball", "map of the world",
        "high chair", "ally", "ear of the bear", "bear's nose", "T-shirt", "something made out of wood",
        '"the first toy"', '"all of it"',
    ],
)  # fmt: skip
def test_names_of_things_keep_their_function_words(text):
    assert understand(text).note == ""
    assert not understand(text).unknown


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("the nose of the bear", "bear nose"), ("handle of the red mug", "red mug handle"),
        ("wheels of my toy car", "toy car wheels"), ("where is the shade of the table lamp?", "table lamp shade"),
        ("leaves of the vase", "vase leaves"), ("how many leaves does the vase have?", "vase leaves"),
        ("the cup of tea", "cup of tea"), ("nose of clay", "nose of clay"),
    ],
)  # fmt: skip
def test_a_part_of_a_thing_is_named_behind_the_thing(text, part):
    assert understand(text).phrase == understand(part).phrase


def test_the_place_of_a_thing_is_not_that_of_its_part():
    assert understand("nose of the bear on the table").phrase == understand("bear nose on the table").phrase


def test_every_word_of_the_vocabulary_names_a_thing_but_those_of_places():
    words = [*everyday_words(), *default_vocabulary(), *default_vocabulary("bundled")]
    assert {word for word in words if left_over(word)} == {"back", "edge"}


TOY, TABLE, BEAR = Thing("toy"), Thing("table"), Thing("bear")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the second largest toy", Pick("largest", TOY, rank=2)),
        ("2nd-biggest toy", Pick("largest", TOY, rank=2)),
        ("third object from the left", Pick("leftmost", ANY, rank=3)),
        ("which toy is second from the right?", Pick("rightmost", TOY, rank=2)),
        ("the second one from left", Pick("leftmost", ANY, rank=2)),
        ("first two mugs from the left", Pick("leftmost", MUG, 2)),
        ("two toys on the right", Pick("rightmost", TOY, 2)),
        ("the second toy from the left on the table", Related("on", Pick("leftmost", TOY, rank=2), TABLE)),
        ("3 nearest things to the mug", Related("nearest to", ANY, MUG, count=3)),
        ("two toys closest to the duck", Related("nearest to", TOY, DUCK, count=2)),
        ("the second closest mug to me", Related("nearest to", MUG, ME, rank=2)),
        ("two things next to the largest mug", AtLeast(2, Related("next to", ANY, Pick("largest", MUG)))),
        ("which is bigger, the bear or the duck?", Pick("largest", Together(BEAR, DUCK))),
        ("what's taller: the bear or the duck?", Pick("tallest", Together(BEAR, DUCK))),
        ("which is closer to the mug, the bear or the duck", Related("nearest to", Together(BEAR, DUCK), MUG)),
        ("is the bear bigger than the duck?", Related("larger than", BEAR, DUCK)),
        ("things taller than the mug", Related("taller than", ANY, MUG)),
        ("toys not smaller than the mug", Except(TOY, Related("smaller than", TOY, MUG))),
        ("the smaller mug", Pick("smallest", MUG)),
        ("the bigger of the two toys", Pick("largest", TOY)),
        ("toys but not the largest", Except(TOY, Pick("largest", TOY))),
        ("toys but not the largest thing", Except(TOY, Pick("largest", ANY))),
        ("is there a mug and a duck?", Together(MUG, DUCK)),
        ("do you see a mug, a duck and a bear?", Together(MUG, Together(DUCK, BEAR))),
        ("is there a mug, a duck or a bear?", Both(MUG, Both(DUCK, BEAR))),
        ("can you show me the mug and the duck?", Both(MUG, DUCK)),
        ("are there both a mug and a duck?", Together(MUG, DUCK)),
        ("is there anything but the mug and the duck?", Except(ANY, Both(MUG, DUCK))),
        ("are the mug and the duck on the table?", Together(Related("on", MUG, TABLE), Related("on", DUCK, TABLE))),
        ("is the mug on the table or the cloth?", Both(Related("on", MUG, TABLE), Related("on", MUG, CLOTH))),
        (
            "is the mug smaller than the duck and the bear",
            Together(Related("smaller than", MUG, DUCK), Related("smaller than", MUG, BEAR)),
        ),
        ("is everything on the table?", Every(Related("on", ANY, TABLE))),
        ("are all the toys yellow?", Every(Colored("yellow", TOY))),
        ("what is in the middle of the table?", InPart(ANY, "middle", TABLE)),
        ("toys at the back", InPart(TOY, "back")),
        ("things in the background", InPart(ANY, "back")),
        ("at the edge of the table", InPart(ANY, "edge", TABLE)),
        ("what is on the far side of the table", InPart(ANY, "back", TABLE)),
        ("the thing at the front of the room", InPart(ANY, "front")),
        ("toys on the left side of the table", InPart(TOY, "left", TABLE)),
        ("mug on the left side of the duck", Related("left of", MUG, DUCK)),
        ("mug on the left side", Pick("leftmost", MUG)),
        ("the mug furthest to the left", Pick("leftmost", MUG)),
        ("mug at the back of the duck", Related("behind", MUG, DUCK)),
        ("mug in front of the table", Related("in front of", MUG, TABLE)),
        ("on my right", Related("right of", ANY, ME)),
        ("the one on the table", Related("on", ANY, TABLE)),
        ("what is the mug next to?", Related("next to", ANY, MUG)),
        ("what is the mug behind?", Related("in front of", ANY, MUG)),
        ("the red or the yellow toy", Both(Colored("red", TOY), Colored("yellow", TOY))),
        ("toys that are not red", Except(TOY, Colored("red", TOY))),
        ("is the mug blue or green?", Both(Thing("blue mug"), Thing("green mug"))),
        ("the mug's handle", Thing("mug handle")),
    ],
)  # fmt: skip
def test_orders_comparisons_parts_and_statements_are_understood(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("third largest toy", '(3rd largest "toy")'),
        ("3 nearest things to the mug", '(any object 3 nearest to "mug")'),
        ("is there a mug and a duck", '("mug" and "duck")'),
        ("are all toys on the table", '(all "toy" are ("toy" on "table"))'),
        ("toys in the middle of the table", '("toy" in the middle of "table")'),
        ("toys at the back", '("toy" at the back)'),
        ("the 21st largest mug", '(21st largest "mug")'),
        ("the eleventh largest mug", '(11th largest "mug")'),
    ],
)
def test_orders_parts_and_statements_can_be_read(text, read):
    assert str(parse(text)) == read


@pytest.mark.parametrize(
    ("text", "told"),
    [("is the mug full?", "full"), ("is the mug big?", "big"), ("what color is the mug?", "colors")],
)
def test_what_an_answer_does_not_report_is_said(text, told):
    assert told in understand(text).note


def test_words_in_quotation_marks_keep_their_form():
    assert parse('"apples"') == Thing("apples")
    assert parse('"apples"').exact
    assert not parse("apples").exact
    assert parse("“salt and pepper” on the table") == parse('"salt and pepper" on the table')
    assert parse("„apples“") == parse("«apples»") == parse('"apples"')


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("rubber dukc", "rubber duck"), ("bananna", "banana"), ("stripped ball", "striped ball"),
        ("mgu", "mug"), ("canlde", "candle"), ("hosue", "house"), ("candl", "candle"), ("rubber duk", "rubber duck"),
        ("LCD", "LCD"), ("lego", "lego"), ("rubber", "rubber"), ("bug", "bug"), ("mouse", "mouse"),
        ("cadle", "candle"), ("mgus", "mug"), ("dukcs", "duck"), ("candels", "candle"),
        ("horse", "horse"), ("theremin", "theremin"), ("mugs", "mugs"), ("日本", "日本"),
    ],
)  # fmt: skip
def test_typing_errors_are_corrected_and_other_words_are_not(typed, meant):
    assert corrected(typed, ["rubber duck", "banana", "house", "mug", "striped ball", "candle"]) == meant


def test_a_word_with_several_possible_meanings_has_them_all_the_likeliest_first():
    assert spellings("gren mug", ["grey", "green", "mug"]) == ("green mug", "grey mug")
    assert spellings("appel", ["apple"]) == ("apple",), "a rare word with two letters in the other order"
    assert spellings("orang", ["orange"]) == ("orange",)
    assert spellings("range", ["orange"]) == ("range",)


def test_numbers_are_words_that_only_a_vocabulary_knows():
    assert strange("mug 3", ["mug"]) == ["3"]
    assert strange("mug 3", ["mug 3"]) == []


@pytest.mark.parametrize(
    ("text", "expected", "right"),
    [
        ("teh mug", MUG, "the"),
        ("whre is the mug?", MUG, "where"),
        ("hwo mnay mugs are there?", MUG, "many"),
        ("waht is on teh mug", Related("on", ANY, MUG), "what"),
        ("whcih toys can you see?", Thing("toy"), "which"),
        ("mug nxet to the duck", Related("next to", MUG, DUCK), "next"),
        ("blu thing", Colored("blue", ANY), "blue"),
        ("yelow mug", Thing("yellow mug"), "yellow"),
    ],
)
def test_typing_errors_in_the_words_of_a_question_are_corrected_and_noted(text, expected, right):
    understood = understand(text)
    assert understood.phrase == expected
    assert f'asked for "{right}"' in understood.note


@pytest.mark.parametrize(
    "text",
    ["led lamp", "lego", "TV", "mat", "tan shoes", "bred", '"teh mug"', "don't I have a mug", "bow", "whale"],
)
def test_other_words_are_not_taken_for_those_of_a_question(text):
    assert "typing error" not in understand(text).note


def test_what_was_understood_can_be_read():
    found = parse("largest mug on the cloth but not the duck")
    assert str(found) == '(largest (("mug" on "cloth") minus "duck"))'
