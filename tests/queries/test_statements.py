"""Statements on what a thing is, on which is closer, on little or nothing of it, and what stays not understood."""

import pytest
from support.phrases import parse

from lexsplat.queries.grammar import understand
from lexsplat.queries.phrases import (
    Anything,
    AtLeast,
    Both,
    Colored,
    Except,
    Pick,
    Related,
    Thing,
    Understood,
    Viewer,
)

ANY, ME = Anything(), Viewer()
MUG, DUCK, LAMP, TOY, APPLE = Thing("mug"), Thing("duck"), Thing("lamp"), Thing("toy"), Thing("apple")
CLOTH, TABLE = Thing("cloth"), Thing("table")
ON_CLOTH = Related("on", MUG, CLOTH)


def shared(one, other):
    """What both phrases name."""
    return Except(one, Except(one, other))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Is the lamp the tallest object?", shared(LAMP, Pick("tallest", ANY))),
        ("is the lamp the tallest?", shared(LAMP, Pick("tallest", ANY))),
        ("is the apple the leftmost toy", shared(APPLE, Pick("leftmost", TOY))),
        ("is the mug on the cloth the largest mug?", shared(Related("on", MUG, CLOTH), Pick("largest", MUG))),
        (
            "is the duck the largest thing on the table?",
            shared(DUCK, Pick("largest", Related("on", ANY, TABLE))),
        ),
        ("is the duck the second largest toy?", shared(DUCK, Pick("largest", TOY, rank=2))),
        ("is the ring the closest thing to the mug", shared(Thing("ring"), Related("nearest to", ANY, MUG))),
        ("is the tallest object the lamp?", shared(Pick("tallest", ANY), LAMP)),
        ("is the duck a toy?", shared(DUCK, TOY)),
        ("is the mug on the left a toy?", shared(Pick("leftmost", MUG), TOY)),
        ("isn't the duck a toy?", shared(DUCK, TOY)),
        ("is the duck not the largest toy?", Except(DUCK, Pick("largest", TOY))),
        ("is the duck closer than the mug?", shared(DUCK, Related("nearest to", Both(DUCK, MUG), ME))),
        ("is the duck closer to me than the mug?", shared(DUCK, Related("nearest to", Both(DUCK, MUG), ME))),
        (
            "is the duck farther away from the lamp than the mug is?",
            shared(DUCK, Related("farthest from", Both(DUCK, MUG), LAMP)),
        ),
        ("is the mug longer than the duck?", Related("longer than", MUG, DUCK)),
        ("things wider than the mug", Related("wider than", ANY, MUG)),
        ("which is longer, the mug or the duck?", parse("which is the longest, the mug or the duck?")),
    ],
)
def test_a_statement_asks_for_what_both_of_its_phrases_name(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("is this a mug?", "mug"),
        ("is there a mug?", "mug"),
        ("is the bear wearing a hat?", "bear wearing a hat"),
        ("is the mug next to the duck?", "mug next to the duck"),
        ("is the mug without a handle on the table?", "mug without a handle on the table"),
    ],
)
def test_an_article_behind_a_word_that_joins_makes_no_second_thing(text, same):
    assert understand(text) == understand(same)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("at most two mugs", AtLeast(0, MUG, 2)),
        ("no more than two mugs on the cloth", AtLeast(0, Related("on", MUG, CLOTH), 2)),
        ("fewer than three apples", AtLeast(0, APPLE, 2)),
        ("are there less than 3 apples?", AtLeast(0, APPLE, 2)),
        ("two or fewer apples", AtLeast(0, APPLE, 2)),
        ("are there no more than two mugs?", AtLeast(0, MUG, 2)),
        ("is there no mug?", AtLeast(0, MUG, 0)),
        ("There are no mugs", AtLeast(0, MUG, 0)),
        ("there isn't any mug on the cloth", AtLeast(0, Related("on", MUG, CLOTH), 0)),
        ("no mugs", AtLeast(0, MUG, 0)),
        ("are there no mugs or ducks?", AtLeast(0, Both(MUG, DUCK), 0)),
        ("is there nothing on the cloth?", AtLeast(0, Related("on", ANY, CLOTH), 0)),
        ("is there neither a mug nor a duck?", AtLeast(0, Both(MUG, DUCK), 0)),
        ("isn't there a mug?", MUG),
        ("is there not a mug?", MUG),
    ],
)
def test_little_or_nothing_of_a_thing_is_understood(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("objects that are neither red nor yellow", Except(ANY, Both(Colored("red", ANY), Colored("yellow", ANY)))),
        ("neither red nor yellow toys", Except(TOY, Both(Colored("red", TOY), Colored("yellow", TOY)))),
        ("is the mug neither red nor blue?", Except(MUG, Both(Thing("red mug"), Thing("blue mug")))),
        ("mugs neither on the cloth nor on the table", Except(MUG, Both(ON_CLOTH, Related("on", MUG, TABLE)))),
        ("neither the mug nor the duck", Except(ANY, Both(MUG, DUCK))),
        ("which toys are neither ducks nor apples?", Except(TOY, Both(shared(TOY, DUCK), shared(TOY, APPLE)))),
    ],
)  # fmt: skip
def test_neither_nor_leaves_out_both(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("is the apple far from the lamp?", "from"),
        ("How far is the duck from me?", "How"),
        ("which object is the heaviest?", "is"),
        ("is the mug closer to the duck than the lamp?", "closer"),
        ("no entry sign", "no"),
        ("what touches the cloth?", "touches"),
        ("the apple touching a banana", "touching"),
        ("the mug containing my spoon", "containing"),
        ("what holds the candle?", "holds"),
        ("is it a mug?", "it"),
        ("cup " * 200, ""),
    ],
)
def test_what_is_not_understood_is_neither_certainly_here_nor_certainly_absent(text, told):
    found = understand(text)
    assert f'not understood ("{told}")' in found.note or not told
    assert [found.limit(present) for present in ("yes", "unsure", "no")] == ["unsure"] * 3


@pytest.mark.parametrize(
    "text", ["bear wearing a hat", "touch lamp", "something that gives light", "ceiling"]
)
def test_what_is_understood_may_be_certainly_absent(text):
    assert understand(text).limit("no") == "no"
    assert understand(text).note == ""
