"""Phrases: what they ask for, written out by hand."""

import pytest

from lexsplat.queries.phrases import Both, Except, Pick, Related, Thing, parse
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
        ("mugs", Thing("mugs")),
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
        ("are there any mugs", Thing("mugs")),
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


@pytest.mark.parametrize("text", ["", "   ", "on the cloth", "mug on", "mug and", 'the "mug'])
def test_phrases_with_an_empty_part_are_refused(text):
    with pytest.raises(QueryError):
        parse(text)


@pytest.mark.parametrize("joint", [" on ", " and ", " but not ", ", "])
def test_phrases_of_very_many_parts_are_refused(joint):
    assert str(parse(joint.join(["cup"] * 30)))
    with pytest.raises(QueryError, match="parts"):
        parse(joint.join(["cup"] * 3000))
    with pytest.raises(QueryError, match="parts"):
        parse("largest " * 3000 + "cup")


def test_what_was_understood_can_be_read():
    assert (
        str(parse("largest mug on the cloth but not the duck"))
        == '((largest ("mug" on "cloth")) minus "duck")'
    )


def test_an_empty_part_is_refused_with_a_valid_example():
    with pytest.raises(QueryError, match=r"left of the mug.*such as"):
        parse("left of the mug")
