"""Things with a part, and with what nothing looks for: how the phrases are understood."""

from __future__ import annotations

import pytest

from lexsplat.queries.grammar import understand
from lexsplat.queries.phrases import AtLeast, Except, Having, Pick, Related, Thing, Understood

MUG = Thing("mug")
HAS_HANDLE = Having(MUG, Thing("mug handle"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mug with handle", HAS_HANDLE),
        ("the mugs with handles", HAS_HANDLE),
        ("mug that has a handle", HAS_HANDLE),
        ("is there a mug with a handle?", HAS_HANDLE),
        ("red mug with a handle", Having(Thing("red mug"), Thing("red mug handle"))),
        ("toy car with wheels", Having(Thing("toy car"), Thing("toy car wheel"))),
        ("toys with wheels", Having(Thing("toy"), Thing("wheel"))),
        ("plant with leaves", Having(Thing("plant"), Thing("plant leaf"))),
        ("mug with a handle on the table", Related("on", HAS_HANDLE, Thing("table"))),
        ("two mugs with handles", AtLeast(2, HAS_HANDLE)),
        ("largest mug with a handle", Pick("largest", HAS_HANDLE)),
        ("mug without handle", Except(MUG, Thing("mug handle"), lacks=True)),
        ("something with leaves", Thing("something with leaves")),
        ("table with four legs", Thing("table with four leg")),
        ("cup of tea", Thing("cup of tea")),
        ("fruit without apples", Except(Thing("fruit"), Thing("apple"))),
        ("table without the lamp", Except(Thing("table"), Thing("lamp"))),
        ('"mug with a handle"', Thing("mug with a handle")),
    ],
)
def test_a_thing_with_a_part_is_the_thing(text, expected):
    assert understand(text) == Understood(expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("vase with flowers", "with flowers"),
        ("where is the vase with red flowers?", "with red flowers"),
        ("vase without flowers", "without flowers"),
        ("apple with a bite", "with a bite"),
        ("rubber duck with buoy", "with buoy"),
        ("vase with flowers on the table", "with flowers"),
    ],
)
def test_an_attribute_that_nothing_looks_for_is_noted_and_leaves_nothing_certain(text, words):
    understood = understand(text)
    assert understood.note == f'"{words}" is not looked for by itself'
    assert understood.limit("yes") == "unsure"
