"""Other words for the same thing: plurals as they were typed, and compound words."""

import pytest

from lexsplat.queries.grammar import understand
from lexsplat.queries.meaning import compounds, in_known_words, known_words
from lexsplat.queries.phrases import Thing, own_words_of
from lexsplat.queries.selection import Presence

KNOWN = frozenset({"lamp", "shade", "flower", "pot", "cup", "board", "table", "cloth", "tablecloth", "red"})


def asked(text: str, here: set[str], own: str = "", exact: bool = False, unsure: str = "") -> str:
    def presence_of(words: str) -> Presence:
        return "yes" if words in here else "unsure" if words == unsure else "no"

    return in_known_words(Thing(text, own=own, exact=exact), presence_of, KNOWN)


def test_a_plural_counts_as_it_was_typed_where_only_that_is_here():
    assert asked("leaf", {"leaves"}, own="leaves") == "leaves"
    assert asked("leaf", {"leaf", "leaves"}, own="leaves") == "leaf"
    assert asked("leaf", set(), own="leaves") == "leaf"
    assert asked("leaf", {"leaves"}, own="leaves", unsure="leaf") == "leaf"


@pytest.mark.parametrize(
    ("text", "singular", "own"),
    [("green leaves", "green leaf", "green leaves"), ("where are the books?", "book", "books"), ("mug", "mug", "")],
)  # fmt: skip
def test_a_thing_keeps_the_words_that_were_typed(text, singular, own):
    thing = understand(text).phrase
    assert isinstance(thing, Thing)
    assert (thing.text, thing.own) == (singular, own)


def test_the_typed_words_are_known_of_each_thing_of_a_phrase():
    assert own_words_of(understand("two mugs on the books").phrase) == {"mug": "mugs", "book": "books"}


def test_a_compound_word_is_asked_for_as_its_two_words_where_both_and_the_last_are_here():
    assert asked("red lampshade", {"red lamp shade", "shade"}) == "red lamp shade"
    assert asked("cupboard", {"cup board", "cup"}) == "cupboard", "a cup is no board"
    assert asked("lampshade", {"lampshade", "lamp shade", "shade"}) == "lampshade"
    assert asked("lampshade", {"lamp shade", "shade"}, exact=True) == "lampshade"
    assert asked("lampshade", {"lamp shade", "shade"}, unsure="lampshade") == "lamp shade"


def test_two_words_are_asked_for_as_one_that_is_known():
    assert asked("red table cloth", {"red tablecloth"}) == "red tablecloth"
    assert not list(compounds("lamp cloth", KNOWN)), "no word is lampcloth"


def test_a_word_is_only_split_into_known_words():
    assert not list(compounds("lampoons", KNOWN))
    assert ("teddy bear", "bear") in list(compounds("teddybear", known_words("bundled")))
