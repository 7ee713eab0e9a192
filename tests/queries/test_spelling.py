"""Words of the dictionary, without reading it where everybody knows them, and singulars."""

import pytest
import simplemma

from lexsplat.queries import spelling
from lexsplat.queries.everyday import everyday_words


def test_everyday_words_are_in_the_dictionary_that_they_spare():
    assert len(spelling._everyday()) > 1_000
    assert [word for word in spelling._everyday() if not simplemma.is_known(word, lang="en")] == []


def test_an_everyday_word_is_known_without_the_dictionary_and_others_are_looked_up(monkeypatch):
    asked = []
    monkeypatch.setattr(simplemma, "is_known", lambda word, lang: asked.append(word) or word == "ibex")
    assert [spelling.is_word(word) for word in ("Shoe", "blue", "ibex", "shoo")] == [True, True, True, False]
    assert asked == ["ibex", "shoo"]
    assert "shoe" in everyday_words()


@pytest.mark.parametrize(
    ("plural", "one"),
    [("loaves", "loaf"), ("loaves of bread", "loaf of bread"), ("calves", "calf"), ("thieves", "thief"),
     ("knives", "knife"), ("gloves", "glove"), ("olives", "olive"), ("stoves", "stove")],
)  # fmt: skip
def test_plurals_of_f_have_their_singular(plural, one):
    assert spelling.singular(plural) == one
