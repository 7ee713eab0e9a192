"""Kinds of things, answered by the names of objects."""

import pytest

from lexsplat.queries.kinds import is_kind, is_of_kind


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("toy car", "toy"),
        ("teddy bear", "toy"),
        ("Teddy bear", "Animal"),
        ("striped ball", "toy"),
        ("apple", "something to eat"),
        ("vase", "container"),
        ("wooden crate", "container"),
        ("mug", "tableware"),
        ("table lamp", "electrical appliance"),
        ("toy car", "something to pick up"),
        ("stack of books", "something graspable"),
    ],
)
def test_a_name_that_holds_a_kind_or_ends_with_a_member_is_of_it(name, kind):
    assert is_of_kind(name, kind)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("table", "something to pick up"),
        ("sofa", "something to grab"),
        ("vase", "tableware"),
        ("car", "toy"),
        ("bear rug", "animal"),
        ("mug", "toy"),
        ("mug", "mug"),
        ("", "toy"),
        ("toy car", ""),
    ],
)
def test_other_names_and_words_that_are_no_kinds_are_not(name, kind):
    assert not is_of_kind(name, kind)


def test_a_phrase_that_only_holds_a_kind_is_no_kind():
    assert is_kind("toy")
    assert not is_kind("toy box")
